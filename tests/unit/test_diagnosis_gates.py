"""Gates of a verdict: each passes just below its limit and fails just above it."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gaps import reach, recording

from actuators.recordings.inspection import InspectionThresholds
from actuators.recordings.recording_checks import RecordingRemark, examine_recordings
from brokk_rl.machine import Machine
from diagnosis import effect_library, gates, verdict
from diagnosis.answer import Answer, Ranked, Where
from diagnosis.closure import Estimate, Gap, Gate, RivalError, read_rivals
from diagnosis.gap import GapClosure
from diagnosis.motion_floor import LeftOutErrors
from diagnosis.residuals import build_rays
from diagnosis.rivals import Rival
from diagnosis.search import EffectSet


def by_name(found: list[Gate]) -> dict[str, Gate]:
    return {one.name: one for one in found}


def rivals(**errors: float) -> dict[str, Rival]:
    """Returns rivals that err alike on all joints and windows."""
    every = {"hold": 1.0, "arx": 1.0, "flexible": 1.0} | errors
    return {name: Rival(np.full((40, 5), value**2)) for name, value in every.items()}


def remark(name: str, joint: str, share: float) -> RecordingRemark:
    return RecordingRemark(name, "bad", joint, "planted", 0.0, 1.0, 1, "", "", "", share)


@pytest.mark.parametrize(("name", "limit"), gates.MAX_REMARK_SHARES.items())
def test_findings_beyond_their_share_forbid_any_telling(
    machine: Machine, name: str, limit: float
) -> None:
    field = [recording(machine)]
    for share, passes in ((limit, True), (1.01 * limit, False)):
        found = by_name(gates.judge_recordings([remark(name, "q3", share)], field, [], machine))
        gate = found[name.replace(" ", "_")]
        assert gate.passed is passes and gate.value == pytest.approx(share)
        others = [one for one in found.values() if one is not gate]
        assert all(one.passed for one in others)
        assert ("q3" in gate.text) is not passes
    # joints are judged one by one, recordings together: half of the time here, none there
    halves = [remark(name, "q3", limit), remark(name, "q4", limit)]
    assert by_name(gates.judge_recordings(halves, field, [], machine))[gate.name].passed
    calm = replace(recording(machine), metadata={"run": "calm"})
    some = [remark(name, "q3", 1.9 * limit)]
    assert by_name(gates.judge_recordings(some, [*field, calm], [], machine))[gate.name].passed
    more = [remark(name, "q3", 2.1 * limit)]
    assert not by_name(gates.judge_recordings(more, [*field, calm], [], machine))[gate.name].passed


def test_a_coarse_sensor_is_not_frozen(machine: Machine) -> None:
    fine = recording(machine)
    for levels, passes in ((200, True), (201, False)):
        q = fine.q.copy()
        q[:, 2] = np.arange(len(q)) % levels / levels
        field = [replace(fine, q=q)]
        assert ("q3" in gates.find_coarse_sensors(field, machine)) is passes
        frozen = [remark("frozen sensor", "q3", 0.8)]
        found = by_name(gates.judge_recordings(frozen, field, [], machine))
        assert found["frozen_sensor"].passed is passes


def test_limits_that_the_recordings_leave_are_told(machine: Machine) -> None:
    plain = recording(machine)
    travel = machine.upper - machine.lower

    def moved(beyond: float) -> Any:
        q = np.tile((machine.lower + machine.upper) / 2, (len(plain.q), 1))
        q[:400, 3] = machine.upper[3] + beyond * travel[3]
        return replace(plain, q=q)

    for beyond, passes in ((0.049, True), (0.051, False)):
        (gate,) = [
            one for one in gates.judge_recordings([], [moved(beyond)], [], machine) if one.name == "limits"
        ]  # fmt: skip
        assert gate.passed is passes and gate.value == pytest.approx(beyond)
        assert ("q4" in gate.text) is not passes
    below = replace(plain, q=2 * machine.lower - machine.upper + 0.0 * plain.q)
    assert not by_name(gates.judge_recordings([], [below], [], machine))["limits"].passed
    # a field that alone leaves them may have a biased encoder
    assert by_name(gates.judge_recordings([], [moved(0.3)], [plain], machine))["limits"].passed
    assert not by_name(gates.judge_recordings([], [plain], [moved(0.3)], machine))["limits"].passed
    spike = moved(0.3)
    spike.q[4:400, 3] = machine.home[3]
    assert by_name(gates.judge_recordings([], [spike], [], machine))["limits"].passed


def test_fast_motion_without_command_is_an_unlogged_input_and_slow_one_a_leak(
    machine: Machine, thresholds: InspectionThresholds
) -> None:
    plain = recording(machine, seconds=245.0)
    t_s = plain.t_s
    for share, name in ((0.5, "unlogged input"), (0.1, "motion without command")):
        q = plain.q.copy()
        swing = np.abs((0.1 * t_s) % 2.0 - 1.0)  # slope of 0.1 a second
        q[:, 1] = machine.home[1] + share * machine.max_speed[1] / 0.1 * swing
        found = examine_recordings([replace(plain, q=q)], machine, thresholds)
        names = {one.name: one for one in found if one.joint == "q2"}
        assert name in names and len({"unlogged input", "motion without command"} & {*names}) == 1
        assert names[name].share > 0.8
        told = gates.judge_recordings(found, [plain], [], machine)
        assert by_name(told)["unlogged_input"].passed is (share < 0.2)


def test_a_model_no_better_than_standing_still_does_not_fit(machine: Machine) -> None:
    def errors(actual: float) -> LeftOutErrors:
        return LeftOutErrors(np.full((4, 5), actual**2), np.ones((4, 5)), np.full((4, 5), 0.04))

    assert gates.judge_model(errors(0.19), machine).passed
    assert gates.judge_model(errors(0.19), machine).value == pytest.approx(0.95)
    for error in (0.2, 0.21):
        failed = gates.judge_model(errors(error), machine)
        assert not failed.passed and "does not fit this machine" in failed.text


def with_base(seen: GapClosure, paths: np.ndarray) -> GapClosure:
    """Returns the same simulator with other free runs in the field."""
    residuals = SimpleNamespace(**{**vars(seen.base.field.residuals), "base": paths})
    known = {**vars(seen.base), "field": SimpleNamespace(residuals=residuals)}
    other: Any = SimpleNamespace(**known)
    return replace(seen, base=other, after=paths)


def judged(
    machine: Machine, thresholds: InspectionThresholds, before: float, floor: float, **of: float
) -> dict[str, Gate]:
    seen = reach(machine, before, before, before, floor, scatter=0.05)
    return by_name(gates.judge_none(seen, rivals(**of), [recording(machine)], thresholds))


def test_none_is_said_near_the_floor_only(
    machine: Machine, thresholds: InspectionThresholds
) -> None:
    assert all(one.passed for one in judged(machine, thresholds, 0.017, 0.010).values())
    found = judged(machine, thresholds, 0.019, 0.010)
    assert not found["near_floor"].passed and found["near_floor_by_joint"].passed
    assert found["near_floor"].value == pytest.approx(1.9, rel=0.03)
    found = judged(machine, thresholds, 0.037, 0.010)
    assert not found["near_floor_by_joint"].passed


def test_a_ratio_by_chance_is_no_gap(machine: Machine, thresholds: InspectionThresholds) -> None:
    for often, passes in ((8, True), (2, False)):
        seen = reach(machine, 0.010, 0.010, 0.010, 0.010, windows=16)
        base = seen.base.field.residuals.base.copy()
        base[::often] *= np.sqrt(1.0 + 3.5 * often)  # the same mean square, in few windows or many
        again = with_base(seen, base)
        found = by_name(gates.judge_none(again, rivals(), [recording(machine)], thresholds))
        assert found["near_floor"].value == pytest.approx(np.sqrt(4.5))
        assert found["near_floor"].passed is passes


def test_one_joint_far_above_its_floor_is_enough(
    machine: Machine, thresholds: InspectionThresholds
) -> None:
    seen = reach(machine, 0.010, 0.010, 0.010, 0.010, scatter=0.05)
    for factor, passes in ((3.3, True), (3.7, False)):
        base = seen.base.field.residuals.base.copy()
        base[..., 2] *= factor
        again = with_base(seen, base)
        found = by_name(gates.judge_none(again, rivals(), [recording(machine)], thresholds))
        assert found["near_floor_by_joint"].passed is passes
        assert "q3" in found["near_floor_by_joint"].text


def test_none_is_never_said_where_a_rival_does_better(
    machine: Machine, thresholds: InspectionThresholds
) -> None:
    for name, below, above in (("hold", 0.99, 1.02), ("arx", 1.47, 1.53), ("flexible", 1.47, 1.53)):
        before = reach(machine, 0.012, 0.012, 0.012, 0.010, scatter=0.05).before[0]
        for ratio, passes in ((below, True), (above, False)):
            found = judged(machine, thresholds, 0.012, 0.010, **{name: float(before) / ratio})
            assert found[f"below_{name}"].passed is passes
            assert found[f"below_{name}"].value == pytest.approx(ratio)
    bare = rivals() | {"flexible": Rival(None, "not installed")}
    seen = reach(machine, 0.012, 0.012, 0.012, 0.010, scatter=0.05)
    found = by_name(gates.judge_none(seen, bare, [recording(machine)], thresholds))
    assert "below_flexible" not in found


def test_an_error_of_the_sensors_noise_is_none_whatever_the_floor(
    machine: Machine, thresholds: InspectionThresholds
) -> None:
    noise = np.sqrt(gates.estimate_sensor_noise([recording(machine)], machine, thresholds).mean())
    assert noise == pytest.approx(0.0003, rel=0.2)  # as it was planted
    for times, passes in ((2.8, True), (3.3, False)):
        found = judged(machine, thresholds, times * float(noise), 1e-5, hold=1e-6)
        assert all(one.passed for one in found.values()) is passes
    seen = reach(machine, 0.012, 0.012, 0.012, 0.010, scatter=0.05)
    seen.base.left_out = []  # pyright: ignore[reportAttributeAccessIssue]
    found = by_name(gates.judge_none(seen, rivals(), [recording(machine)], thresholds))
    assert not found["near_floor"].passed and "no floor" in found["near_floor"].text


def test_effects_must_close_a_share_on_windows_apart(machine: Machine) -> None:
    good = by_name(gates.judge_effects(reach(machine, 0.03, 0.02, 0.02, 0.01), rivals()))
    assert not good["reduces"].passed  # the same everywhere: no interval could be computed

    def less(share: float, noise: float) -> dict[str, Gate]:
        seen = reach(machine, 0.03, 0.02, 0.02, 0.01, scatter=0.1)
        draw = np.random.default_rng(5).standard_normal((40, 1, 1))
        base = seen.base.field.residuals.base
        after = base * (1.0 - share + noise * draw)
        after[..., [0, 1, 3, 4]] = base[..., [0, 1, 3, 4]]  # other joints are left as they were
        return by_name(gates.judge_effects(replace(seen, after=after), rivals(hold=0.03)))

    assert less(0.10, 0.02)["reduces"].passed
    assert "q3" in less(0.10, 0.02)["reduces"].text and "q1" not in less(0.10, 0.02)["reduces"].text
    assert less(0.055, 0.005)["reduces"].passed
    assert not less(0.045, 0.005)["reduces"].passed
    chance = less(-0.01, 0.6)["reduces"]
    assert chance.value is not None and chance.limit is not None
    assert chance.value > chance.limit and not chance.passed
    assert not less(-0.10, 0.02)["reduces"].passed


def test_a_repaired_simulator_worse_than_standing_still_is_not_named(machine: Machine) -> None:
    seen = reach(machine, 0.03, 0.02, 0.02, 0.01, scatter=0.1)
    after = float(seen.errors(seen.after)[0])
    for hold, passes in ((1.01 * after, True), (0.99 * after, False)):
        assert by_name(gates.judge_effects(seen, rivals(hold=hold)))["below_hold"].passed is passes


def test_a_verdict_that_fails_gives_its_probability_to_unknown() -> None:
    rows = (Ranked("none", (), 0.9), Ranked("lag", ("q1",), 0.3), Ranked("unknown", (), 0.05))
    found = gates.rank_unknown_first(rows)
    assert [(one.effect, pytest.approx(one.probability)) for one in found] == [
        ("unknown", 0.9), ("none", 0.1), ("lag", 0.1)
    ]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Found:
    """Free runs of the simulator, and the mean response of late frames."""

    base: np.ndarray
    mean: Any


SENSOR = SimpleNamespace(
    name="sensor_noise", target=SimpleNamespace(side="measurement", stochastic=True)
)
FRAMES = SimpleNamespace(name="frame_loss", target=SimpleNamespace(side="command", stochastic=True))


def findings(
    machine: Machine, before: float, after: float | None, detected: int = 0, mean: Any = None
) -> Any:
    """Returns findings whose fitted set errs by `after`; `None`: none is fitted.

    With a `mean` response of late frames the detected effects are late frames, else those of sensors.
    """
    seen = reach(machine, before, after or before, before, 0.010, scatter=0.1)
    draw = 1.0 + 0.05 * np.random.default_rng(3).standard_normal((40, 1, 1))
    fitted = None if after is None else SimpleNamespace(after=seen.after * draw, own=seen.after)
    result = verdict.DetectionResult(
        residuals=Found(seen.base.field.residuals.base, mean), tables=[], rays={},  # pyright: ignore[reportArgumentType]
        price=lambda j, subset: 0.0, chosen=EffectSet((frozenset({"lag"}),) * 5, 1.0), fitted=fitted,  # pyright: ignore[reportArgumentType]
        detected=[SimpleNamespace(kind=SENSOR if mean is None else FRAMES)] * detected,  # pyright: ignore[reportArgumentType]
        clue_gains=np.zeros(1), reference_clue_gains=np.zeros(1),  # pyright: ignore[reportArgumentType]
        scatter=np.zeros(1), strays=np.zeros(1), tool_left=0.0,
    )  # fmt: skip
    return result, seen.base


def told(
    machine: Machine,
    thresholds: InspectionThresholds,
    found: Any,
    unknown: bool = False,
    **of: float,
) -> verdict.Judgement:
    result, base = found
    case: Any = SimpleNamespace(machine=machine, field=[recording(machine)])
    return verdict.judge_findings(
        result, case, base, rivals(**of), thresholds, np.random.default_rng(0), unknown
    )


def test_verdicts_follow_their_gates(machine: Machine, thresholds: InspectionThresholds) -> None:
    good = told(machine, thresholds, findings(machine, 0.03, 0.015))
    assert good.verdict == "effects" and good.fitted is not None and not good.failed
    weak = told(machine, thresholds, findings(machine, 0.03, 0.031))
    assert weak.verdict == "unknown" and weak.fitted is None and "remove" in weak.failed
    assert not weak.result.chosen.names and weak.result.fitted is None
    beside = told(machine, thresholds, findings(machine, 0.03, 0.031, detected=1))
    assert beside.verdict == "effects" and beside.fitted is None and len(beside.found) == 1
    still = told(machine, thresholds, findings(machine, 0.03, 0.015), hold=0.01)
    assert still.verdict == "unknown" and "standing still" in still.failed
    near = told(machine, thresholds, findings(machine, 0.011, None))
    assert near.verdict == "none" and not near.failed and all(one.passed for one in near.gates)
    far = told(machine, thresholds, findings(machine, 0.02, None))
    assert far.verdict == "unknown" and "unchanged machine" in far.failed
    slow = told(machine, thresholds, findings(machine, 0.011, None), hold=0.01)
    assert slow.verdict == "unknown" and "standing still" in slow.failed
    outside = told(machine, thresholds, findings(machine, 0.03, 0.015), unknown=True)
    assert outside.verdict == "unknown" and outside.fitted is None and not outside.gates


def test_late_frames_that_surely_add_to_the_error_are_not_named(
    machine: Machine, thresholds: InspectionThresholds
) -> None:
    draw = np.random.default_rng(4).standard_normal((40, 1, 1))
    for more, name in ((0.01, ["frame_loss"]), (-0.01, [])):
        # errors of 30 mrad, from which the mean delay takes or to which it adds a third
        found = findings(machine, 0.03, None, detected=1, mean=-more * (1.0 + 0.1 * draw))
        seen = told(machine, thresholds, found)
        assert [one.kind.name for one in seen.found] == name
        assert seen.verdict == ("effects" if name else "unknown")
        assert bool(name) or ("frame_loss" in seen.failed and seen.result.residuals.mean is None)


def test_a_size_at_its_bound_is_marked(machine: Machine) -> None:
    (kind,) = effect_library.load_effects(machine, ("dead_time",))
    (ray,) = build_rays(kind)
    last = 2.5 * float(ray.sizes[-1])
    assert verdict.is_at_bound(last, ray) and verdict.is_at_bound(last - 5e-4, ray)
    assert not verdict.is_at_bound(last - 5e-3, ray) and not verdict.is_at_bound(0.0, ray)
    tied = replace(ray, is_tied=True)
    assert verdict.is_at_bound(float(ray.sizes[-1]), tied) and not verdict.is_at_bound(last, tied)
    number = kind.numbers[ray.name]
    sizes = np.array([[1.0, last, 1.0, 1.0, 1.0]])
    fitted: Any = SimpleNamespace(rays=[ray], sizes=sizes)
    value, bound = number.typical, max(number.bounds, key=abs)
    given = {ray.name: {"q1": value, "q2": value, "q3": bound}}
    values = {name: {joint: Estimate(one, (0.0, 1.0)) for joint, one in row.items()} for name, row in given.items()}  # fmt: skip
    found = verdict.mark_bounds(values, fitted, kind, machine)[ray.name]
    assert {joint: one.at_bound for joint, one in found.items()} == {
        "q1": False, "q2": True, "q3": True
    }  # fmt: skip


def test_gates_and_rivals_are_written_as_the_format_says() -> None:
    gate = Gate("near_floor", False, 2.5, 1.75, "too far")
    found = Answer(
        verdict="unknown", selected=(), ranking=(), where=Where({}, (), None),
        gap=Gap(0.03, 0.03, 0.01, None, closed_reason="why"), next_experiment=None,
        rivals={"hold": RivalError(0.09, {"q1": 0.1}), "flexible": RivalError(None, {}, "not installed")},
        gates=(gate,),
    ).to_json()  # fmt: skip
    assert found["rivals"]["hold"]["rmse_rad"] == 0.09
    assert found["rivals"]["flexible"]["rmse_rad"] is None
    assert read_rivals(found["rivals"])["flexible"].reason == "not installed"
    assert found["gates"] == [
        {"name": "near_floor", "passed": False, "value": 2.5, "limit": 1.75, "text": "too far"}
    ]
    assert found["gap"]["closed"] is None and found["gap"]["closed_reason"] == "why"
