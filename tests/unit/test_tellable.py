"""A preview tells beforehand what a diagnosis finds afterwards."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import option

from actuators import open_loop
from actuators.models.lag import FirstOrderLag
from actuators.recordings.preview import EffectLimit, PreviewResult
from actuators.recordings.preview_report import run_preview
from actuators.scales import choose_horizon_s
from brokk_rl import record
from brokk_rl.errors import RecordingError
from brokk_rl.extensions import load_part
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import effect_library
from diagnosis.engine.decide import JOINT_NATS, LEAST_NATS
from diagnosis.rivals import to_increments
from diagnosis.simulator_runs import SimulatorRuns, cut_simulator_runs
from diagnosis.simulator_search import SimulatorSearch
from diagnosis.tellable import ExpectedError, MotionView, TellableEffects

torch.set_num_threads(1)
PLANT = FirstOrderLag(
    dead_time_s=0.2, dead_band_extend=0.0, dead_band_retract=0.0, gain=1.0, time_constant_s=0.0
)
NOISY = ExpectedError(sensor=0.03, change=0.0, wander=0.02, reading=0.0)
"""Noise that keeps every smallest size above the least size that is ever named."""
EFFECTS = ("backlash", "dead_band", "flow_gain", "lag", "saturation")


@pytest.fixture(scope="module")
def axis(machine: Machine) -> Machine:
    joint = replace(machine.joints[2], body=None)
    return replace(
        machine, name="axis", mjcf=None, tool_m=None, joints=(joint,), exclusive=(), levers=()
    )


def preview(effects: Sequence[str] | None = EFFECTS, **changes: Any) -> TellableEffects:
    fields = {
        "actuator": PLANT,
        "effects": None if effects is None else tuple(effects),
        "error": NOISY,
        "num_windows": 400,
    }
    return TellableEffects(**fields | changes)


def motions(machine: Machine, seconds: float, seed: int, name: str = "levels") -> list[Recording]:
    """Returns the programs of an excitation as a machine with the nominal speed follows them."""
    excitation, generator = option("excitation", name), np.random.default_rng(seed)
    before = open_loop.count_samples_before(machine)
    late = round(machine.dead_time_s / machine.period_s) + 1
    full = machine.max_speed * machine.period_s
    found = []
    for number, segment in enumerate(excitation.segments(machine, seconds, generator)):
        u = np.pad(segment.u, ((before, 0), (0, 0)))
        margin = max(segment.stop_margin, 0.05) * (machine.upper - machine.lower)
        heading = segment.start.astype(float)
        for row in u:  # a joint that comes near its stop waits until its program turns around
            ahead = heading + row * full
            is_over = (ahead > machine.upper - margin) & (row > 0.0)
            is_under = (ahead < machine.lower + margin) & (row < 0.0)
            row *= ~(is_over | is_under)
            heading = heading + row * full
        q = segment.start + np.cumsum(np.pad(u, ((late, 0), (0, 0)))[: len(u)] * full, 0)
        t_s = np.arange(len(u)) * machine.period_s
        found.append(record.make_motion(machine, f"{number}", t_s, u, q))
    return found


def assess(
    one: TellableEffects, machine: Machine, some: Sequence[Recording], are_measured: bool = False
) -> PreviewResult:
    return one.assess(some, machine, lambda doing, done: None, are_measured)


def limit(result: PreviewResult, effect: str, joint: str, number: str = "") -> EffectLimit:
    (found,) = [
        one
        for one in result.limits
        if one.effect == effect and joint in one.joints and number in ("", one.number)
    ]
    return found


def play(
    machine: Machine, some: Sequence[Recording], effect: str, number: str, size: float, seed: int
) -> SimulatorRuns:
    """Returns the plant without an effect held against the plant with it, both with errors as expected."""
    runs = cut_simulator_runs(PLANT, some, machine, 0)
    view = MotionView(runs, NOISY, np.zeros(1), 1.0)
    (kind,) = effect_library.load_effects(machine, [effect])
    values = {name: np.full((1, 1), kind.numbers[name].none) for name in kind.fitted}
    values[number] = kind.clipped(number, values[number] + size * kind.size(number))
    changed = to_increments(runs.simulator.simulate([(kind, values)])[0], view.start)
    random = np.random.default_rng(seed)
    error = view.deviation * random.standard_normal(changed.shape)
    error += NOISY.wander * random.standard_normal((len(changed), 1, 1)) * view.plain
    ends = view.start[:, None] + np.cumsum(changed + error, 1)
    q = runs.cut.q.copy()
    q[:, runs.cut.num_before :] = np.repeat(ends, 5, 1)
    simulator = replace(runs.simulator, cut=replace(runs.cut, q=q))
    return replace(runs, simulator=simulator)


def search(runs: SimulatorRuns, machine: Machine) -> set[str]:
    """Returns the names that the search of a diagnosis chooses."""
    kinds = effect_library.load_effects(machine, EFFECTS)
    found = SimulatorSearch(runs, None, kinds).run(lambda done: None)
    return {one.kind.name for one in found}


@pytest.mark.parametrize(
    ("effect", "number"),
    [
        ("backlash", "gap_rad"),
        pytest.param("dead_band", "extend", marks=pytest.mark.slow),
        pytest.param("flow_gain", "gain", marks=pytest.mark.slow),
        ("lag", "time_constant_s"),
    ],
)
def test_an_effect_is_found_at_twice_the_foretold_size_and_not_at_a_fifth(
    effect: str, number: str, axis: Machine
) -> None:
    some = motions(axis, 300.0, 1)
    foretold = limit(assess(preview(), axis, some), effect, "q3", number)
    assert foretold.smallest is not None and foretold.is_told
    size = foretold.smallest / foretold.typical
    for seed in (1, 2, 3):
        assert effect in search(play(axis, some, effect, number, 2.0 * size, seed), axis)
        assert not search(play(axis, some, effect, number, 0.2 * size, seed), axis)


@pytest.mark.parametrize(("effect", "sensor"), [("backlash", 0.06), ("creep", 0.015)])
def test_four_times_the_data_halve_the_smallest_size(
    effect: str, sensor: float, axis: Machine
) -> None:
    """Up to Occam's factor, which is a logarithm; the responses to both grow with the size."""
    once = motions(axis, 150.0, 1)
    often = [replace(one, metadata={"run": f"{n}"}) for n in range(4) for one in once]
    loud = preview([effect], error=replace(NOISY, sensor=sensor))
    first, then = (limit(assess(loud, axis, some), effect, "q3") for some in (once, often))
    assert first.smallest and then.smallest
    assert then.smallest > 0.12 * then.typical * 1.05, "above the least size that is named"
    assert first.smallest / then.smallest == pytest.approx(2.0, rel=0.12)


def test_some_free_runs_stand_for_all(axis: Machine) -> None:
    some = motions(axis, 600.0, 2)
    whole, part = (
        limit(assess(preview(num_windows=count), axis, some), "lag", "q3") for count in (400, 40)
    )
    assert whole.smallest and part.smallest
    assert part.smallest == pytest.approx(whole.smallest, rel=0.25)


def test_a_joint_that_stands_still_tells_nothing(machine: Machine) -> None:
    steps = 1200
    u = np.zeros((steps, 5))
    u[:, 2] = np.repeat([0.0, 0.5, 0.0, -0.5], 60)[np.arange(steps) % 240]
    q = machine.home + np.cumsum(u * machine.max_speed * machine.period_s, 0)
    still = record.make_motion(machine, "still", np.arange(steps) * machine.period_s, u, q)
    result = assess(preview(("lag", "load_dependence")), machine, [still])
    for one in result.limits:
        assert (one.smallest is None) == (one.joints != ("q3",)), one


def test_a_delay_and_an_offset_of_clocks_look_alike_in_any_motion(machine: Machine) -> None:
    one = preview(("clock_offset", "dead_time", "dead_band"))
    result = assess(
        replace(one, error=load_part("preview").error), machine, motions(machine, 300.0, 3)
    )
    (pair,) = result.pairs
    assert pair.effects == ("clock_offset", "dead_time") and pair.joints == machine.joint_names


def test_noise_that_is_measured_hides_small_effects(axis: Machine) -> None:
    quiet = motions(axis, 150.0, 4)
    draw, told = np.random.default_rng(5), []
    for sigma in (1e-4, 3e-3):
        some = [
            replace(one, q=one.q + sigma * draw.standard_normal(one.q.shape).astype(np.float32))
            for one in quiet
        ]
        error = ExpectedError(sensor=0.001, change=0.0, wander=0.001, reading=0.0)
        result = assess(preview(("backlash", "sensor_noise"), error=error), axis, some, True)
        told.append(limit(result, "backlash", "q3").smallest)
        assert limit(result, "sensor_noise", "q3").smallest == pytest.approx(sigma, rel=0.15)
    assert told[0] and (told[1] is None or told[1] > 1.2 * told[0])


def test_a_coarse_sensor_has_the_noise_of_rounding(axis: Machine) -> None:
    """The root mean square of a rounding error is the step over sqrt(12)."""
    step, error = 0.004, load_part("preview").error
    some = motions(axis, 150.0, 4)
    coarse = [replace(one, q=(np.round(one.q / step) * step).astype(np.float32)) for one in some]
    assert error.measure_reading(coarse, axis) == pytest.approx([step / np.sqrt(12.0)], rel=0.05)
    resting = [replace(one, q=np.zeros_like(one.q)) for one in some]
    expected = 0.00011 * (axis.upper - axis.lower)
    assert error.measure_reading(resting, axis) == pytest.approx(expected), "nothing shows it"


def test_too_short_motions_are_refused(axis: Machine) -> None:
    short = motions(axis, 150.0, 1)[0]
    part = replace(short, t_s=short.t_s[:60], u=short.u[:60], q=short.q[:60])
    assert choose_horizon_s(axis) == 5.0
    with pytest.raises(RecordingError, match="no recording is long enough for a free run of 5 s"):
        assess(preview(), axis, [part])


def test_machines_without_masses_have_a_preview() -> None:
    machine = option("machine", "mini_excavator")
    some = motions(machine, 120.0, 1, "reversals")
    result = assess(load_part("preview"), machine, some)
    joint = machine.joint_names[0]
    assert limit(result, "creep", joint).number == "drift_rad_s"
    assert limit(result, "backlash", joint).unit == "m" and limit(result, "backlash", joint).is_told


@pytest.mark.parametrize("name", ["emps", "so101"])
def test_joints_commanded_by_targets_or_torques_have_no_preview(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    machine = option("machine", name)
    some = motions(machine, 120.0, 1, "reversals")
    assert some, "there is motion: the interface alone is the reason"
    caplog.set_level("INFO")
    assert run_preview(load_part("preview"), some, machine, True) is None
    assert "known for joints commanded by speed only" in caplog.text


FAST = (
    "preview.num_windows=6",
    "preview.effects=[lag,dead_time,clock_offset,link_length,sensor_noise]",
)


def test_collect_says_it_before_anything_moves(brokk: Callable[..., Any]) -> None:
    done = brokk(
        "mode=collect", "collect.only_plan=true", "collect.num_runs=2", "collect.run_minutes=2",
        "collect.file_minutes=2", "excitation=levels", "session.out=plan", *FAST,
    )  # fmt: skip
    assert done.code == 0, done.err
    assert {path.suffix for path in Path("plan").glob("plan.*")} == {".png", ".json"}
    plan = json.loads(Path("plan/plan.json").read_text())
    rows = {(one["effect"], *one["joints"]): one for one in plan["preview"]["effects"]}
    assert rows["lag", "q3"]["told"] and rows["lag", "q3"]["unit"] == "s"
    assert plan["preview"]["minutes"] > 3.0
    assert "these motions would tell" in done.out and "link_length: only measured tool" in done.out
    plain = brokk(
        "mode=collect", "collect.only_plan=true", "collect.num_runs=1", "collect.run_minutes=2",
        "collect.file_minutes=2", "excitation=levels", "session.out=plain", "preview=null",
    )  # fmt: skip
    assert plain.code == 0, plain.err
    assert "preview" not in json.loads(Path("plain/plan.json").read_text())


def test_inspect_says_it_of_recordings(brokk: Callable[..., Any], machine: Machine) -> None:
    (some, *_) = motions(machine, 120.0, 1)
    noisy = some.q + 3e-4 * np.random.default_rng(0).standard_normal(some.q.shape)
    record.write_recording(replace(some, q=noisy.astype(np.float32)), Path("a.parquet"))
    done = brokk("mode=inspect", "inspect.recordings=*.parquet", "session.out=out", *FAST)
    assert done.code == 0, done.err
    result = json.loads(Path("out/inspection.json").read_text())["preview"]
    noise = result["assumed"]["noise"]["q3"]
    assert result["assumed"]["noise_is_measured"]
    assert noise["reading"] == pytest.approx(3e-4, rel=0.15)
    page = Path("out/inspection.html").read_text()
    assert "Effects that these recordings could tell" in page and "sensor_noise" in page


def test_a_gain_within_what_simulators_repeat_is_never_told(axis: Machine) -> None:
    """Speeds of both sides are off by a hundredth each, so that a gain of g earns (g / 0.01)² nats at most."""
    some = motions(axis, 300.0, 2)
    often = [replace(one, metadata={"run": f"{n}"}) for n in range(20) for one in some]
    quiet = ExpectedError(sensor=1e-3, change=0.0, wander=0.0, reading=0.0)
    found = limit(assess(preview(["flow_gain"], error=quiet), axis, often), "flow_gain", "q3")
    assert found.smallest == pytest.approx(0.01 * np.sqrt(LEAST_NATS + JOINT_NATS), rel=0.05)
