"""Findings of a diagnosis as changes of an MJCF file, and as ranges."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from arm import ARM, NOISE_RAD, make_machine, record_arm, rub

from brokk_rl.errors import ConfigError
from brokk_rl.session import Session
from diagnosis import api, effect_library
from diagnosis.answer import ANSWER_FILE, Answer, Selected
from diagnosis.closure import Estimate
from diagnosis.mjcf.changes import write_changed_mjcf
from diagnosis.mjcf.plant import MjcfPlant
from diagnosis.modes.change_simulator import ChangeRequest, ChangeSimulator
from diagnosis.simulator_runs import cut_simulator_runs

DELAY_S, FRICTION_NM = 0.06, 0.5


def estimate(value: float, half: float) -> Estimate:
    """Returns a number with its interval."""
    return Estimate(value, (value - half, value + half))


def name_effect(name: str, sizes: dict[str, dict[str, Estimate]]) -> Selected:
    """Returns an effect on the joints that its numbers name."""
    joints = tuple(next(iter(sizes.values())))
    return Selected(effect=name, joints=joints, probability=0.9, parameters=sizes, gap_closed=None)


def name_effects() -> Answer:
    """Returns a diagnosis that names a delay, friction at the elbow, and play at the shoulder."""
    part = FRICTION_NM / (30 * 0.05 * 3.0)  # of kp times 5 % of the travel
    delays = {name: estimate(DELAY_S, 0.004) for name in ("shoulder", "elbow")}
    parameters: dict[str, Any] = {
        "dead_time": {"dead_time_s": delays},
        "joint_friction": {"part": {"elbow": estimate(part, 0.01)}},
        "backlash": {"gap_rad": {"shoulder": estimate(0.03, 0.01)}},
    }
    closed = {"dead_time": 0.7, "joint_friction": 0.2, "backlash": 0.05}
    selected = []
    for name, numbers in parameters.items():
        part = estimate(closed[name], 0.05)
        selected.append(replace(name_effect(name, numbers), gap_closed=part))
    return replace(NOTHING, verdict="effects", selected=tuple(selected), reason="test")


NOTHING = Answer(verdict="none", selected=(), ranking=(), gap=None)


def build_mode(folder: Path, answer: Answer) -> ChangeSimulator:
    """Returns the mode for the arm and an answer."""
    (folder / "arm.xml").write_text(ARM)
    answer.write(folder / ANSWER_FILE)
    return ChangeSimulator(
        session=Session(out=str(folder / "out"), seed=0, device="cpu"),
        machine=make_machine("shoulder", "elbow"),
        simulator=str(folder / "arm.xml"),
        changes=ChangeRequest(diagnosis=str(folder)),
    )


def measure_error_rad(simulator: Path) -> np.ndarray:
    """Returns the error of a file, `(J,)`, on two recordings of the arm with delay and friction."""
    machine = make_machine("shoulder", "elbow")
    rows = round(DELAY_S / machine.period_s)
    late = [record_arm(machine, rub, rows, seed) for seed in range(2)]
    runs = cut_simulator_runs(api._load_simulator(simulator), late, machine, 0)
    return np.sqrt(np.square(runs.cut.measured - runs.plain_runs).mean((0, 1)))


def test_the_changed_file_is_the_faulty_machine(tmp_path: Path) -> None:
    build_mode(tmp_path, name_effects()).run()
    text = (tmp_path / "out" / "changed.xml").read_text()
    assert "<!-- joint_friction: frictionloss 0 to 0.5 [" in text
    assert "Not in this file: backlash: MJCF has no play on a target" in text
    model = mujoco.MjModel.from_xml_string(text)
    assert model.dof_frictionloss.tolist() == [0.0, pytest.approx(FRICTION_NM)]
    assert model.actuator_delay.tolist() == [DELAY_S, DELAY_S]
    assert measure_error_rad(tmp_path / "arm.xml").min() > 100 * NOISE_RAD
    # MuJoCo begins a run with an empty buffer of commands; the warm-up fills it.
    assert measure_error_rad(tmp_path / "out" / "changed.xml").max() < 8 * NOISE_RAD
    ranges = (tmp_path / "out" / "randomisation.yaml").read_text()
    ranked = re.findall("^# (.*): closes", ranges, re.MULTILINE)
    assert ranked == ["dead_time", "joint_friction", "backlash"]  # by the gap
    nodes = yaml.safe_load(ranges)
    assert nodes["dead_time"]["dead_time_s"]["elbow"] == [0.048, 0.072]
    assert "joint_friction" not in nodes
    path = tmp_path / "alone.yaml"
    path.write_text(yaml.safe_dump(nodes["dead_time"]))
    assert api._load_option("effect", path).joints == ("shoulder", "elbow")


SAG = {"sag_rad": 0.05, "sag_slope": 0.04}
CHANGES: tuple[dict[str, dict[str, float]], ...] = (
    {"dead_time": {"dead_time_s": 0.05}},
    {"lag": {"time_constant_s": 0.08}},
    {"sag": SAG},
    {"drive_gain": {"gain": 0.7}},
    {"joint_damping": {"part": 0.3}},
    # More than the joints have in the file: the drives lose it.
    {"joint_damping": {"part": -0.15}},
    {"joint_armature": {"part": 0.8}},
    {"drive_limit": {"shortage": 2.0}},
    # Both change the gain of the drive.
    {"sag": SAG, "drive_gain": {"gain": 0.7}},
)


def test_a_changed_file_moves_as_the_file_with_the_effect(tmp_path: Path) -> None:
    machine, source = make_machine("shoulder", "elbow"), tmp_path / "arm.xml"
    source.write_text(ARM)
    recording = record_arm(machine, rub, 0, seed=4, seconds=8.0)

    def simulate(path: Path, effects: list[Any]) -> np.ndarray:
        simulator = api._load_simulator(path)
        runs = cut_simulator_runs(simulator, [recording], machine, 0)
        return runs.simulate(effects)[0]

    plain = simulate(source, [])
    known = effect_library.load_effects(machine, None, api._load_simulator(source))
    kinds = {kind.name: kind for kind in known}
    for effects in CHANGES:
        findings, simulated = [], []
        for name, numbers in effects.items():
            sizes: dict[str, Any] = {}
            for number, value in numbers.items():
                sizes[number] = dict.fromkeys(machine.joint_names, estimate(value, 0.0))
            findings.append(name_effect(name, sizes))
            values = {number: np.full((1, 2), value) for number, value in numbers.items()}
            simulated.append((kinds[name], values))
        changed = tmp_path / "changed.xml"
        assert write_changed_mjcf(source, machine, findings, changed)[1] == {}
        with_effect = simulate(source, simulated)
        left = with_effect - simulate(changed, [])
        assert np.square(left).mean() < 0.01 * np.square(with_effect - plain).mean(), effects


def test_nothing_found_changes_nothing(tmp_path: Path) -> None:
    mode = build_mode(tmp_path, NOTHING)
    with pytest.raises(ConfigError, match="its verdict is 'none', so there is nothing to change"):
        mode.run()
    assert not (tmp_path / "out").exists()


def test_a_lower_range_of_the_file_stays(tmp_path: Path) -> None:
    """60 Nm/rad times 5 % of 3 rad are 9 Nm: a shortage of 2 is a limit of 4.5 Nm."""
    machine, source = make_machine("shoulder", "elbow"), tmp_path / "arm.xml"
    source.write_text(ARM.replace('kv="4"', 'kv="4" forcerange="-3 20"'))
    finding = name_effect("drive_limit", {"shortage": {"shoulder": Estimate(2.0, (1.5, 3.0))}})
    changes, left = write_changed_mjcf(source, machine, [finding], tmp_path / "changed.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "changed.xml"))
    assert left == {} and model.actuator_forcerange.tolist() == [[-3.0, 4.5], [0.0, 0.0]]
    assert model.actuator_forcelimited.tolist() == [1, 0]
    assert [one.interval for one in changes] == [(3.0, 6.0)]  # the other side keeps its range
    plant = MjcfPlant(source, machine).change_model({"limit": np.array([2.0, 0.0])})
    assert plant.actuator_forcerange.tolist() == model.actuator_forcerange.tolist()
    assert plant.actuator_forcelimited.tolist() == [1, 0]
