"""Location of the gap: one table of joints and regimes.

The floor is the error of the same simulator on reference recordings that it was not fitted to. The
gap is the error beyond the floor and beyond one standard error. Shares add up to 1 over joints, and
those of a joint over its regimes.

An error of position stays after its cause is over, so it is traced to its origin: the error of a
window is the sum of its increments, `e = Σ_c e_c` with `e_c` those of the samples in regime `c`,
and `Σ_t e_c(t) e(t)` is the part of the squared error of regime `c`. The parts add up exactly; a
negative part works against the others.

Samples of one recording are dependent, so a standard error counts parts of `PART_S`, never samples.
Axes: `W` windows, `K` steps, `J` joints, `C` regimes, `B` parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.answer import JointGap, RegimeGap, Selected, Stage, Where
from diagnosis.effect_library import EffectType
from diagnosis.free_runs import WindowedRuns
from diagnosis.regimes import REGIMES, label_recordings

PART_S = 30.0
"""Length of the parts of recordings, s; chosen by hand: six windows of 5 s."""
SURE_ERRORS = 3.0
"""Standard errors beyond the floor from which the regimes of a joint are told. With errors that are
random walks, one of 20 unchanged machines of five joints exceeds them."""
TINY = np.finfo(float).tiny
"""Smallest divisor: a sum of squares may be 0."""


@dataclass(frozen=True)
class _PartSums:
    """Sums over the windows of each part of a recording, all `(B, J, C)`.

    Attributes:
        square: Part of the squared error.
        count: Samples.
    """

    square: np.ndarray
    count: np.ndarray


def find_stage(selected: Sequence[Selected], kinds: Sequence[EffectType]) -> Stage | None:
    """Return where the first named effect lies on the way from command to estimate; `None` without any."""
    named = selected[0].effect if selected else ""
    return next((kind.stage for kind in kinds if kind.name == named), None)


def locate_gap(
    runs: WindowedRuns, reference: WindowedRuns | None, machine: Machine, stage: Stage | None = None
) -> Where:
    """Return where the gap lies; the regimes of joints that exceed their floor for sure.

    Args:
        runs: Free runs through field recordings.
        reference: The same simulator's through reference recordings that it was not fitted to;
            `None`: there is no floor, and every error counts.
        machine: Gives joints, limits, period and dead time.
        stage: Part of the way from command to estimate, as the answer tells it.
    """
    field = _sum_parts(runs, machine)
    square, count = field.square.sum(0), field.count.sum(0)
    whole, time = square.sum(1), np.maximum(count.sum(1), 1.0)
    base, chance, expected = np.zeros(len(whole)), np.zeros(len(whole)), np.zeros_like(square)
    if reference is not None:
        floor = _sum_parts(reference, machine)
        seen = floor.count.sum(0)
        base = floor.square.sum((0, 2)) / np.maximum(seen.sum(1), 1.0)
        own = floor.square.sum(0) / np.maximum(seen, 1.0)
        # Where the reference never was in a regime, the floor of the joint counts.
        expected = np.where(seen > 0, own, base[:, None]) * count
        chance = _estimate_chance(floor, len(field.square)) * time
    excess = whole - base * time
    # Metres and radians do not add up, so mixed joints count by their travel.
    is_alike = len({joint.unit for joint in machine.joints}) == 1
    travel = np.ones(len(whole)) if is_alike else machine.upper - machine.lower
    beyond = _take_first_positive(excess - chance, excess, whole)
    share = _normalise(beyond / travel**2)
    joints, regimes = {}, []
    for j, joint in enumerate(machine.joints):
        rmse, least = np.sqrt(whole[j] / time[j]), np.sqrt(base[j])
        joints[joint.name] = JointGap(float(rmse), float(least), float(share[j]), joint.unit)
        if excess[j] <= SURE_ERRORS * chance[j]:
            continue
        parts = share[j] * _normalise(_take_first_positive(square[j] - expected[j], square[j]))
        for regime, part in zip(REGIMES, parts.tolist(), strict=True):
            if part > 0.0:
                regimes.append(RegimeGap(joint.name, regime, part))
    regimes.sort(key=lambda one: -one.share)
    return Where(joints, tuple(regimes), stage)


def trace_to_origin(error: np.ndarray, label: np.ndarray, num_categories: int) -> np.ndarray:
    """Return the error by the category of its origin, `(C, W, K, J)`; the sum is `error`.

    Args:
        error: Errors of free runs, `(W, K, J)`, NaN after the end of a recording.
        label: Number of the category of each sample, `(W, K, J)`.
        num_categories: `C`.
    """
    given = np.isfinite(error)
    added = np.diff(np.where(given, error, 0.0), axis=1, prepend=0.0) * given
    return np.stack([np.cumsum(added * (label == c), 1) for c in range(num_categories)]) * given


def _sum_parts(runs: WindowedRuns, machine: Machine) -> _PartSums:
    label = runs.cut(label_recordings(runs.recordings, machine))
    traced = trace_to_origin(runs.error, label, len(REGIMES))
    belongs = np.stack([label == c for c in range(len(REGIMES))])
    number = _number_parts(runs)
    sums = []
    for values in (traced * np.nan_to_num(runs.error), belongs):
        by_window = np.moveaxis(values.sum(2).astype(float), 0, 2)
        by_part = np.zeros((number.max() + 1, *by_window.shape[1:]))
        np.add.at(by_part, number, by_window)
        sums.append(by_part)
    return _PartSums(*sums)


def _number_parts(runs: WindowedRuns) -> np.ndarray:
    """Return the number of the part of `PART_S` of a recording that each window lies in, `(W,)`."""
    begin_s = []
    for source, row in zip(runs.source, runs.row, strict=True):
        t_s = runs.recordings[source].t_s
        begin_s.append(t_s[row] - t_s[0])
    place = np.stack([runs.source, np.array(begin_s) // PART_S], 1)
    return np.unique(place, axis=0, return_inverse=True)[1].ravel()


def _estimate_chance(floor: _PartSums, num_parts: int) -> np.ndarray:
    """Return the standard error of the excess of an unchanged machine over the floor, per sample, `(J,)`.

    Source: the ratio estimator's, Cochran 1977, section 2.11, with the scatter of the reference on
    both sides.

    Args:
        floor: The reference.
        num_parts: Parts of the field.
    """
    square, count = floor.square.sum(2), floor.count.sum(2)
    known = len(square)
    if known < 2:
        return np.zeros(square.shape[1])
    total = np.maximum(count.sum(0), 1.0)
    off = square - square.sum(0) / total * count
    variance = known / (known - 1) * (off**2).sum(0) / total**2
    return np.sqrt(variance * (1.0 + known / num_parts))


def _take_first_positive(*choices: np.ndarray) -> np.ndarray:
    """Return the positive part of the first choice that has any."""
    for choice in choices:
        if (choice > 0).any():
            return np.maximum(choice, 0.0)
    return np.zeros_like(choices[-1])


def _normalise(values: np.ndarray) -> np.ndarray:
    return values / max(float(values.sum()), TINY)
