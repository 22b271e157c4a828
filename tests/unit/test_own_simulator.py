"""Simulators from outside: an MJCF file and a function, run on recorded commands."""

from __future__ import annotations

import importlib
import re
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import ARM, NOISE_RAD, damp, keep, limit_force, make_machine, record_arm, rub, weaken
from hydra.core.override_parser.overrides_parser import OverridesParser

from actuators import open_loop
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import Session
from diagnosis import api, effect_library
from diagnosis.modes import why
from diagnosis.simulator_runs import cut_simulator_runs

PAGE = (Path(__file__).parents[2] / "docs/tutorials/your_simulator.md").read_text()
PENDULUM, RECORDER = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)[:2]
(PENDULUM_FILE,) = re.findall(r"^```xml\n(.*?)^```", PAGE, re.M | re.S)
"""Examples of the tutorial."""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """The MJCF file of the arm."""
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return path


@pytest.fixture
def pendulum(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The function of the tutorial in the current folder."""
    (tmp_path / "my_pendulum.py").write_text(PENDULUM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "my_pendulum", raising=False)
    return "my_pendulum:step"


def measure_errors(
    simulator: Any, machine: Machine, recording: Recording, effects: dict[str, dict[str, Any]]
) -> np.ndarray:
    """Returns the RMS error of free runs with effects, `(J,)` rad."""
    kinds = {kind.name: kind for kind in effect_library.load_effects(machine, None, simulator)}
    runs = cut_simulator_runs(simulator, [recording], machine, 0)
    chosen = [(kinds[name], values) for name, values in effects.items()]
    error = runs.cut.measured - runs.simulate(chosen)[0]
    return np.sqrt(np.square(error).mean((0, 1)))


@pytest.mark.parametrize(
    ("change", "delay", "effect"),
    [
        (keep, 0, {}),
        (keep, 3, {"dead_time": {"dead_time_s": np.full((1, 2), 0.06)}}),
        # 0.5 Nm over kp 30 Nm/rad times 5 % of a travel of 3 rad.
        (rub, 0, {"joint_friction": {"part": np.array([[0.0, 0.5 / 4.5]])}}),
        (weaken, 0, {"drive_gain": {"gain": np.array([[0.6, 1.0]])}}),
        # 60 Nm/rad times 5 % of 3 rad over 5 Nm.
        (limit_force, 0, {"drive_limit": {"shortage": np.array([[9.0 / 5.0, 0.0]])}}),
    ],
)
def test_a_file_with_the_fault_as_effect_is_the_faulty_machine(
    arm: Path, change: Callable[[Any], None], delay: int, effect: dict[str, Any]
) -> None:
    machine = make_machine("shoulder", "elbow")
    recording = record_arm(machine, change, delay, seed=1)
    simulator = api._load_simulator(arm)
    # The speed at the start of a run is a difference of two noisy positions: a few times the noise.
    assert measure_errors(simulator, machine, recording, effect).max() < 8 * NOISE_RAD
    if effect:
        assert measure_errors(simulator, machine, recording, {}).max() > 20 * NOISE_RAD


def test_a_function_for_one_state_is_that_for_many(pendulum: str, tmp_path: Path) -> None:
    many, one = "np.stack([angle, speed], axis=-1)", "np.array([float(angle), speed])"
    (tmp_path / "my_single.py").write_text(PENDULUM.replace(many, one))
    machine = make_machine("hinge")
    state, commands = np.array([[0.1, 0.0], [-0.4, 1.0]]), np.full((2, 5, 1), 0.3)
    plants = [api._load_simulator(name).load(machine) for name in (pendulum, "my_single:step")]
    runs = [plant.run(state, commands) for plant in plants]
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-12)
    module = sys.modules["my_pendulum"]
    expected = state[0]
    for _ in range(5):
        expected = module.step(expected, np.array([0.3]))
    np.testing.assert_allclose(runs[0][0, -1], expected, atol=1e-12)


def test_function_and_file_of_the_tutorial_are_the_same_pendulum(
    pendulum: str, tmp_path: Path
) -> None:
    (tmp_path / "pendulum.xml").write_text(PENDULUM_FILE)
    (tmp_path / "record.py").write_text(RECORDER)
    runpy.run_path(str(tmp_path / "record.py"))
    log = np.genfromtxt(tmp_path / "raw/run_0.csv", delimiter=",", names=True)
    targets, q = log["hinge_target_rad"][:, None], log["hinge_position_rad"]
    machine = make_machine("hinge")
    for source in (pendulum, "pendulum.xml"):
        plant = api._load_simulator(source).load(machine)
        state = plant.start(np.zeros((1, 1)), np.zeros((1, 1)))
        path = plant.read(plant.run(state, targets[None]))[0][0, :, 0]
        # The recorder is two periods late, and its noise has 0.5 mrad.
        assert np.sqrt(np.mean(np.square(path[:-3] - q[3:]))) < 1.5e-3
        assert np.sqrt(np.mean(np.square(path[:-1] - q[1:]))) > 2e-2


def test_steps_and_a_planned_run_agree(arm: Path) -> None:
    machine = make_machine("shoulder", "elbow")
    recording = record_arm(machine, keep, 0, seed=3, seconds=5.0)
    simulator: Any = api._load_simulator(arm)
    stepped = api.simulate(simulator, api.RecordingSet((recording,), machine))[0]
    before = open_loop.count_samples_before(machine)
    error = stepped[before:] - recording.q[before:]
    assert np.sqrt(np.square(error).mean()) < 5 * NOISE_RAD


def test_a_file_of_another_machine_is_refused_by_joint_drive_and_time_step(arm: Path) -> None:
    simulator: Any = api._load_simulator(arm)
    with pytest.raises(ConfigError, match="no joint 'wrist'; it has shoulder, elbow"):
        simulator.load(make_machine("wrist"))
    with pytest.raises(ConfigError, match="is no multiple of the time step"):
        simulator.load(replace(make_machine("shoulder"), period_s=0.019))
    other = arm.with_name("other.xml")
    other.write_text(ARM.replace('<position joint="elbow" kp="30" kv="1.5"/>', ""))
    with pytest.raises(ConfigError, match="expected one actuator on joint 'elbow', found 0"):
        api._load_simulator(other).load(make_machine("shoulder", "elbow"))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("def step(state, command): return state[..., :1]", "expected a state of 2 numbers"),
        ("def step(state, command): return state / 0 * 0", "returned NaN or infinity"),
        ("def step(state, command): raise KeyError('arm')", "failed with KeyError: 'arm'"),
        ("calls = []\ndef step(state, command):\n    calls.append(1)\n    return state + len(calls)", "two answers to one state"),
        ("def step(state, command) return state", "cannot be imported.*SyntaxError.*mend it"),
        ("import nothing_here\nstep = 1", "nothing_here.*mend it"),
        ("def move(state, command): return state", "has no function 'step'"),
        ("def step(state, command): return state\nstart = lambda q, v: q", "expected a state of 2 numbers or more"),
        ("def step(state, command): return state\nstart = lambda q: q", r"start\(position, speed\) failed"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
def test_a_function_that_cannot_be_run_is_refused_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, told: str
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "wrong_sim.py").write_text(text)
    importlib.invalidate_caches()
    try:
        with pytest.raises(ConfigError, match=told):
            api._load_simulator("wrong_sim:step").load(make_machine("hinge"))
    finally:
        sys.modules.pop("wrong_sim", None)


def test_a_diagnosis_of_no_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="expected a recording or more"):
        api.diagnose(api.RecordingSet((), make_machine("hinge")), tmp_path, "servo")


def test_effects_inside_are_for_files_only(arm: Path, pendulum: str) -> None:
    machine = make_machine("hinge")
    inside = {"joint_friction", "joint_damping", "joint_armature", "drive_gain", "drive_limit"}
    for source, found in ((pendulum, set()), (arm, inside)):
        kinds = effect_library.load_effects(machine, None, api._load_simulator(source))
        assert {kind.name for kind in kinds} & inside == found
    with pytest.raises(ConfigError, match=r"'joint_friction' .* my_pendulum:step has no numbers"):
        effect_library.load_effects(machine, ["joint_friction"], api._load_simulator(pendulum))


def test_the_whole_question_hands_on_the_simulator(tmp_path: Path) -> None:
    name = str(tmp_path / "my files/arm.xml")
    Path(name).parent.mkdir()
    Path(name).write_text(ARM)
    asked = why.Why(
        session=Session(out=str(tmp_path), seed=0, device="cpu"), machine=make_machine("hinge"),
        evaluation=api.extensions.load_part("evaluation"), log="log.parquet", policy_path="policy", simulator=name,
        sent=True, target_in_base_m=None,
    )  # fmt: skip
    parser = OverridesParser.create()
    for stage in (asked._examine(), asked._diagnose(), asked._evaluate("all", "[library]")):
        overrides = parser.parse_overrides(list(stage.command))
        given = {one.key_or_group: one.value() for one in overrides}
        assert given["actuator"] == "own"
        assert str(given["actuator.source"]) == name
    named = replace(asked, simulator="servo")
    assert "actuator=servo" in named._diagnose().command


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "delay", "effect", "joints"),
    [
        (keep, 0, None, ()),
        (keep, 3, "dead_time", ("shoulder", "elbow")),
        (rub, 0, "joint_friction", ("elbow",)),
        (weaken, 0, "drive_gain", ("shoulder",)),
        (limit_force, 0, "drive_limit", ("shoulder",)),
        (damp, 0, "joint_damping", ("shoulder",)),
    ],
)
def test_a_withheld_fault_is_named_around_the_file(
    arm: Path,
    tmp_path: Path,
    change: Callable[[Any], None],
    delay: int,
    effect: str | None,
    joints: tuple[str, ...],
) -> None:
    machine = make_machine("shoulder", "elbow")
    runs = tuple(record_arm(machine, change, delay, seed, 40.0) for seed in range(4))
    field = api.RecordingSet(runs, machine)
    answer = api.diagnose(field, tmp_path / "run", simulator=arm).answer
    if effect is None:
        assert answer.verdict == "none"
        return
    assert [(one.effect, one.joints) for one in answer.selected] == [(effect, joints)]
