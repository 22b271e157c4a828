"""The verdict: what the search found, held against the gates, and which sizes ended at a bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from actuators.recordings.inspection import InspectionThresholds
from actuators.recordings.recording_checks import RecordingRemark
from brokk_rl.commands import view_speeds
from brokk_rl.machine import Machine
from diagnosis import gates
from diagnosis.answer import Verdict
from diagnosis.baseline import Baseline
from diagnosis.case import GapCase
from diagnosis.closure import Estimate, Gate, RivalError
from diagnosis.detection import DetectionResult
from diagnosis.effect_library import DetectedEffect, EffectType
from diagnosis.gap import GapClosure, combine_joints
from diagnosis.motion_floor import measure_squares
from diagnosis.refine import MAX_EXTRAPOLATION, FittedSet
from diagnosis.residuals import ParameterRay
from diagnosis.rivals import Rival, measure_rivals
from diagnosis.search import EffectSet

BOUND_TOLERANCE = 1e-3
"""Distance of a size from its bound, in typical sizes, within which it is at the bound."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict with its reasons.

    Attributes:
        verdict: The verdict.
        result: The findings, without effects that failed a gate.
        fitted: The fitted effects that are named; `None` without any.
        found: The detected effects that are named.
        reach: Errors with the named effects.
        gates: Gates of the verdict, passed or not.
        failed: Findings of the gates that failed; empty where all were passed.
    """

    verdict: Verdict
    result: DetectionResult
    fitted: FittedSet | None
    found: Sequence[DetectedEffect]
    reach: GapClosure
    gates: tuple[Gate, ...]
    failed: str


def judge_case(
    case: GapCase, base: Baseline, remarks: Sequence[RecordingRemark], reach: GapClosure
) -> list[Gate]:
    """Return the gates before the search: the recordings, and the kind of model."""
    found = gates.judge_recordings(remarks, case.field, case.reference, case.machine)
    if reach.left_out is not None and not base.is_flexible:
        found.append(gates.judge_model(reach.left_out, case.machine))
    return found


def judge_findings(
    result: DetectionResult,
    case: GapCase,
    base: Baseline,
    rivals: Mapping[str, Rival],
    thresholds: InspectionThresholds,
    generator: np.random.Generator,
    is_unknown: bool,
) -> Judgement:
    """Return the verdict on what the search found.

    Effects on motion that fail their gates are not named, nor are late frames whose mean delay adds to
    the error. Effects that sensors, frames or tool points show have been judged by their own statistic.

    Args:
        result: The findings.
        case: The recordings.
        base: The simulator.
        rivals: Errors of simple rivals.
        thresholds: When a stretch of a recording is worth telling.
        generator: Draws bootstraps.
        is_unknown: The cause probably lies outside the library.
    """
    if is_unknown:
        reach = GapClosure(base, case.machine, base.field.residuals.base, None, generator)
        return Judgement("unknown", result, None, [], reach, (), "")
    told: list[Gate] = []
    fitted, found, failed = result.fitted, result.detected, ""
    reach = _build_reach(result, fitted, base, case.machine, generator)
    if fitted is not None:
        told = gates.judge_effects(reach, rivals, sorted(result.chosen.names))
        if failed := gates.list_failures(told):
            empty = EffectSet((frozenset(),) * len(result.chosen.subsets), 0.0)
            result, fitted = replace(result, chosen=empty, fitted=None), None
            reach = _build_reach(result, None, base, case.machine, generator)
    late = [one for one in found if _is_delay_by_chance(one)]
    if fitted is None and late:
        gate = gates.judge_late_frames(reach, [one.kind.name for one in late])
        told.append(gate)
        if not gate.passed:
            failed = "; ".join(filter(None, (failed, gate.text)))
            found = [one for one in found if not _is_delay_by_chance(one)]
            residuals = replace(result.residuals, mean=None)
            result = replace(result, detected=found, residuals=residuals)
            reach = _build_reach(result, None, base, case.machine, generator)
    if fitted is not None or found:
        return Judgement("effects", result, fitted, found, reach, tuple(told), failed)
    if not failed:
        told += gates.judge_none(reach, rivals, case.field, thresholds)
        failed = gates.list_failures(told)
    verdict: Verdict = "unknown" if failed else "none"
    return Judgement(verdict, result, None, [], reach, tuple(told), failed)


def _is_delay_by_chance(one: DetectedEffect) -> bool:
    """Return whether a detected effect delays commands by chance; see `timing`."""
    return one.kind.target.side == "command" and one.kind.target.stochastic


def _build_reach(
    result: DetectionResult,
    fitted: FittedSet | None,
    base: Baseline,
    machine: Machine,
    generator: np.random.Generator,
) -> GapClosure:
    """Return the errors with the fitted and the detected effects."""
    residuals = result.residuals
    mean = 0.0 if residuals.mean is None else residuals.mean
    paths = base.field.residuals.base
    if fitted is not None:
        paths = fitted.after
    elif result.detected:
        paths = residuals.base + mean
    return GapClosure(base, machine, paths, None if fitted is None else fitted.own, generator)


def collect_rivals(base: Baseline) -> dict[str, Rival]:
    """Return the rivals on the windows of the field; a flexible model that is at hand replaces the boosting."""
    simulator = base.field.residuals.simulator
    cut = simulator.cut
    found = measure_rivals(replace(cut, u=view_speeds(cut.u, simulator.machine)))
    if base.is_flexible and base.left_out:
        squares = [measure_squares(one.residuals) for one in base.left_out]
        found["flexible"] = Rival(np.concatenate(squares))
    return found


def describe_rivals(rivals: Mapping[str, Rival], machine: Machine) -> dict[str, RivalError]:
    """Return the errors of rivals as an answer tells them."""
    found = {}
    for name, one in rivals.items():
        if one.squares is None:
            found[name] = RivalError(None, {}, one.reason)
            continue
        squares = one.squares.mean(0)
        joints = dict(zip(machine.joint_names, np.sqrt(squares).tolist(), strict=True))
        found[name] = RivalError(float(combine_joints(squares, machine)), joints)
    return found


def mark_bounds(
    parameters: Mapping[str, Mapping[str, Estimate]],
    fitted: FittedSet,
    kind: EffectType,
    machine: Machine,
) -> dict[str, dict[str, Estimate]]:
    """Return the numbers of an effect, those marked whose size ended at a bound of the fit or of the number."""
    found = {name: dict(values) for name, values in parameters.items()}
    for ray, sizes in zip(fitted.rays, fitted.sizes, strict=True):
        if ray.kind.name != kind.name:
            continue
        for name in (ray.name,) if ray.name else kind.fitted:
            for joint, value in found.get(name, {}).items():
                j = machine.joint_names.index(joint) if joint != "machine" else 0
                size = sizes[j] if joint != "machine" else sizes[np.abs(sizes).argmax()]
                clipped = _is_clipped(value.mean, kind, name, j if joint != "machine" else None)
                at_bound = is_at_bound(float(size), ray) or clipped
                found[name][joint] = replace(value, at_bound=at_bound)
    return found


def is_at_bound(size: float, ray: ParameterRay) -> bool:
    """Return True if a size ended where its fit ends; the neutral size is no bound."""
    by = 1.0 if ray.is_tied else MAX_EXTRAPOLATION
    ends = [by * float(ray.sizes[-1]), by * float(ray.sizes[0])]
    return any(end != 0.0 and abs(size - end) <= BOUND_TOLERANCE for end in ends)


def _is_clipped(value: float, kind: EffectType, name: str, joint: int | None) -> bool:
    number = kind.numbers[name]
    tolerance = BOUND_TOLERANCE * abs(kind.size_on(name, joint))
    limits = [float(end[joint or 0]) for end in kind.limits(name)]
    ends = [bound for bound in limits if bound != number.none]
    return any(abs(value - bound) <= tolerance for bound in ends)
