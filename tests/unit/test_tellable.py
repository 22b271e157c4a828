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
from hydra import compose, initialize_config_module
from hydra.utils import instantiate

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
from diagnosis import effect_library, tellable
from diagnosis.detection import choose_by_penalties
from diagnosis.residuals import Residuals, build_rays, to_increments
from diagnosis.responses import Response, add_responses, choose_rays, fit_joint_faults
from diagnosis.search import SubsetTable
from diagnosis.tellable import ExpectedError, ResponseInformation, TellableEffects

torch.set_num_threads(1)
PLANT = FirstOrderLag(
    dead_time_s=0.2,
    dead_band_extend=0.0,
    dead_band_retract=0.0,
    gain=1.0,
    time_constant_s=0.0,
    spread={},
)
NOISY = ExpectedError(sensor=0.03, change=0.0, wander=0.02, memory=17.0, reading=0.0)
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
        "prices": load_part("prices"),
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
    for number, segment in enumerate(excitation.segments(machine, seconds, generator, [])):
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
) -> Residuals:
    """Returns the plant without an effect held against the plant with it, both with errors as expected."""
    one = preview()
    cut, running_s, _ = tellable.cut_motions(some, machine, 400)
    noise = one.error.expect_noise(machine)
    plain = one._hold(machine, cut, running_s, noise)
    (kind,) = effect_library.load_effects(machine, [effect])
    (ray,) = [ray for ray in build_rays(kind) if ray.name in ("", number)]
    changed = plain.simulator.simulate([(kind, ray.values(np.full((1, 1), size)))])[0]
    random, error = np.random.default_rng(seed), np.zeros_like(plain.increments)
    for group in plain.groups:  # errors wander from window to window
        covariance = noise[0].covariance(plain.increments[group, :, 0].reshape(1, -1))[0]
        drawn = np.linalg.cholesky(covariance) @ random.standard_normal(len(covariance))
        error[group, :, 0] = drawn.reshape(len(group), -1)
    ends = plain.start[:, None] + np.cumsum(to_increments(changed, plain.start) + error, 1)
    q = cut.q.copy()
    q[:, cut.num_before :] = np.repeat(ends, 5, 1)
    return one._hold(machine, replace(cut, q=q), running_s, noise)


def search(residuals: Residuals, machine: Machine) -> set[str]:
    """Returns the names that the search of a diagnosis chooses."""
    penalties = load_part("prices")
    kinds = effect_library.load_effects(machine, EFFECTS)
    shapes: list[dict[str, list[Response]]] = [{}]
    for kind in kinds:
        add_responses(shapes, kind.name, choose_rays(kind), residuals)
    tables = [
        SubsetTable(joint, mine, residuals.block)
        for joint, mine in zip(fit_joint_faults(residuals), shapes, strict=True)
    ]
    for table in tables:
        table.explore(dict.fromkeys(EFFECTS, penalties.joint), 3)
    chosen = choose_by_penalties(
        tables, lambda j, subset: penalties.joint * len(subset), penalties, frozenset()
    )
    return set(chosen.names)


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
    assert then.smallest > 0.15 * then.typical * 1.05, "above the least size that is named"
    assert first.smallest / then.smallest == pytest.approx(2.0, rel=0.12)


def test_what_simulators_get_wrong_from_day_to_day_is_never_told(axis: Machine) -> None:
    """A lag has the form of the simulator's own time constant, which is off by 4 ms: 16 nats are sqrt(32) of these."""
    some = motions(axis, 300.0, 2)
    often = [replace(one, metadata={"run": f"{n}"}) for n in range(8) for one in some]
    found = limit(assess(preview(["lag"]), axis, often), "lag", "q3")
    assert found.smallest and found.smallest > 0.95 * np.sqrt(32.0) * 0.004


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
        error = ExpectedError(sensor=0.001, change=0.0, wander=0.001, memory=17.0, reading=0.0)
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


def test_information_is_what_faults_leave() -> None:
    """One fault of length 2 at 60 degrees to a response of length 3: worked by hand."""
    faults, row = np.array([[[2.0, 0.0]]]), np.array([[1.5, np.sqrt(6.75)]])
    # 3/4 of all products; the prior of the fault adds 1
    once = ResponseInformation(faults, 1.0).measure(0, row)
    assert once == pytest.approx([0.75 * 9.0 - (0.75 * 3.0) ** 2 / 4.0])
    twice = ResponseInformation(faults, 2.0).measure(0, row)
    assert twice == pytest.approx([1.5 * 9.0 - (1.5 * 3.0) ** 2 / 7.0])


def test_too_short_motions_are_refused(axis: Machine) -> None:
    short = motions(axis, 150.0, 1)[0]
    part = replace(short, t_s=short.t_s[:60], u=short.u[:60], q=short.q[:60])
    assert choose_horizon_s(axis) == 5.0
    with pytest.raises(RecordingError, match="no motion is long enough for a free run of 5 s"):
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


def test_the_shipped_preview_is_that_of_the_search() -> None:
    with initialize_config_module("conf", version_base="1.3"):
        cfg = compose("config", overrides=["mode=collect"])
    shipped = instantiate(cfg.preview, _convert_="all")
    assert shipped.prices == load_part("prices")
