"""Location of the gap: one table of joints and regimes.

The floor is the error of the same simulator on reference recordings that it was not fitted to. The
gap is the error beyond the floor and beyond one standard error. The table splits error and gap
completely: its cells add up to 1 over joints and regimes.

An error of position stays after its cause is over, so it is traced to its origin: the error of a
window is the sum of its increments, `e = Σ_c e_c` with `e_c` those of the samples in regime `c`,
and `Σ_t e_c(t) e(t)` is the part of the squared error of regime `c`. The parts add up exactly; a
negative part works against the others.

Samples of one recording are dependent, so parts of `PART_S` of a recording change sides in the
permutation test, never samples.
Axes: `W` windows, `K` steps, `J` joints, `C` regimes, `B` parts.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import false_discovery_control

from actuators.scales import scale_time
from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns
from diagnosis.regimes import REGIMES, label_recordings

INCREMENT_S = 0.25
"""Time of the increments that the tests compare on the reference of `actuators.scales`, s; chosen by
hand: increments are less dependent than the error, which stays."""
PART_S = 30.0
"""Length of the parts of recordings, s; chosen by hand: six windows of 5 s."""
NUM_PERMUTATIONS = 2000
"""Random permutations; the smallest p is 1 / 2001."""
FALSE_DISCOVERY_RATE = 0.05
"""The usual level."""
TINY = np.finfo(float).tiny
"""Smallest divisor: a sum of squares may be 0."""


@dataclass(frozen=True)
class GapPart:
    """Share of one joint in one regime in error and gap.

    Attributes:
        joint: The joint.
        category: The regime, one of `regimes.REGIMES`.
        time: Part of the joint's time that it takes.
        error: Its part of the whole squared error of all joints; all add up to 1.
        gap: Its part of the excess over the floor; these add up to 1 as well, none is negative.
        p: How probable so large an excess would be by chance; `None` without a floor, or where the
            reference never was.
        is_sure: It holds with at most 5 % false discoveries among all that are sure.
    """

    joint: str
    category: str
    time: float
    error: float
    gap: float
    p: float | None
    is_sure: bool


@dataclass(frozen=True)
class JointError:
    """Error of one joint over the horizon of the free runs.

    Attributes:
        rmse: Root mean square error, rad or m.
        floor: The same on the reference; 0 without one.
        error: Its part of the squared error of all joints (of travel, where units differ).
        gap: Its part of the excess over the floor; of the squared error where nothing exceeds it.
        is_sure: It exceeds the floor in one of its regimes for sure.
    """

    rmse: float
    floor: float
    error: float
    gap: float
    is_sure: bool


@dataclass(frozen=True)
class GapLocation:
    """Location of the gap.

    Attributes:
        joints: By joint.
        parts: Of each joint and regime.
        has_gap: A joint exceeds its floor for sure; without a reference there is no telling, and
            this is true.
    """

    joints: dict[str, JointError]
    parts: list[GapPart]
    has_gap: bool

    def largest(self) -> list[GapPart]:
        """Return the parts, the largest of the gap first."""
        return sorted(self.parts, key=lambda part: -part.gap)

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return asdict(self)


@dataclass(frozen=True)
class _PartSums:
    """Sums over the windows of each part of a recording, all `(B, J, C)`.

    Attributes:
        square: Part of the squared error.
        added: Absolute increments of the error within `INCREMENT_S`, which the test compares: a few
            windows would decide their squares.
        count: Samples.
    """

    square: np.ndarray
    added: np.ndarray
    count: np.ndarray


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


def number_parts(runs: WindowedRuns) -> np.ndarray:
    """Return the number of the part of `PART_S` of a recording that each window lies in, `(W,)`."""
    begin_s = []
    for source, row in zip(runs.source, runs.row, strict=True):
        t_s = runs.recordings[source].t_s
        begin_s.append(t_s[row] - t_s[0])
    place = np.stack([runs.source, np.array(begin_s) // PART_S], 1)
    return np.unique(place, axis=0, return_inverse=True)[1].ravel()


def locate_gap(
    runs: WindowedRuns,
    reference: WindowedRuns | None,
    machine: Machine,
    dead_time_s: np.ndarray,
    generator: np.random.Generator,
) -> GapLocation:
    """Return where the gap lies.

    Args:
        runs: Free runs through field recordings.
        reference: The same simulator's through reference recordings that it was not fitted to;
            `None`: there is no floor.
        machine: Gives joints, limits, period and masses.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
        generator: Draws the permutations.
    """
    field = _sum_parts(runs, machine, dead_time_s)
    floor = _sum_parts(reference, machine, dead_time_s) if reference else None
    square, count = field.square.sum(0), field.count.sum(0)
    whole, time = square.sum(1), np.maximum(count.sum(1), 1.0)
    base = np.zeros(len(whole))
    expected, p = np.zeros_like(square), np.full(square.shape, np.nan)
    chance, joint_chance = np.zeros_like(square), np.zeros(len(whole))
    if floor is not None:
        seen = floor.count.sum(0)
        base = floor.square.sum((0, 2)) / np.maximum(seen.sum(1), 1.0)
        own = floor.square.sum(0) / np.maximum(seen, 1.0)
        # Where the reference never was in a regime, the floor of the joint counts.
        expected = np.where(seen > 0, own, base[:, None]) * count
        chance = _estimate_chance(field, floor) * count
        joint_chance = _estimate_chance(_sum_regimes(field), _sum_regimes(floor))[:, 0] * time
        p = _test_excess(field, floor, generator)
    # Metres and radians do not add up, so mixed joints count by their travel.
    is_alike = len({joint.unit for joint in machine.joints}) == 1
    travel = np.ones(len(whole)) if is_alike else machine.upper - machine.lower
    weight = travel**-2.0
    beyond = _take_first_positive(whole - base * time - joint_chance, whole - base * time, whole)
    joint_gap = _normalise(beyond * weight)
    error = _normalise(whole * weight)
    is_sure = _adjust_p_values(p) <= FALSE_DISCOVERY_RATE
    joints, parts = {}, []
    for j, name in enumerate(machine.joint_names):
        # A joint keeps parts that add up to 1 even where nothing exceeds the floor for sure.
        more = square[j] - expected[j]
        within = _normalise(_take_first_positive(more - chance[j], more, square[j]))
        joints[name] = JointError(
            float(np.sqrt(whole[j] / time[j])),
            float(np.sqrt(base[j])),
            float(error[j]),
            float(joint_gap[j]),
            bool(is_sure[j].any()),
        )
        for c, regime in enumerate(REGIMES):
            part = GapPart(
                name,
                regime,
                float(count[j, c] / time[j]),
                float(error[j] * square[j, c] / max(whole[j], TINY)),
                float(joint_gap[j] * within[c]),
                float(p[j, c]) if np.isfinite(p[j, c]) else None,
                bool(is_sure[j, c]),
            )
            parts.append(part)
    return GapLocation(joints, parts, floor is None or bool(is_sure.any()))


def _sum_parts(runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray) -> _PartSums:
    label = runs.cut(label_recordings(runs.recordings, machine, dead_time_s))
    traced = trace_to_origin(runs.error, label, len(REGIMES))
    belongs = np.stack([label == c for c in range(len(REGIMES))])
    span = max(1, round(scale_time(machine, INCREMENT_S) / machine.period_s))
    before = np.pad(runs.error, ((0, 0), (span, 0), (0, 0)))[:, : runs.error.shape[1]]
    added = np.nan_to_num(np.abs(runs.error - before))
    number = number_parts(runs)
    sums = []
    for values in (traced * np.nan_to_num(runs.error), added * belongs, belongs):
        by_window = np.moveaxis(values.sum(2).astype(float), 0, 2)
        by_part = np.zeros((number.max() + 1, *by_window.shape[1:]))
        np.add.at(by_part, number, by_window)
        sums.append(by_part)
    return _PartSums(*sums)


def _sum_regimes(sums: _PartSums) -> _PartSums:
    """Return the sums of each joint as a single regime."""
    every = (sums.square, sums.added, sums.count)
    return _PartSums(*(values.sum(2, keepdims=True) for values in every))


def _estimate_chance(field: _PartSums, floor: _PartSums) -> np.ndarray:
    """Return the standard error of the excess over the floor, per sample, `(J, C)`.

    Source: the ratio estimator's, Cochran 1977, section 2.11; both sides are independent.
    """
    variance = np.zeros(field.square.shape[1:])
    for side in (field, floor):
        num_parts = len(side.square)
        if num_parts < 2:
            continue
        total = np.maximum(side.count.sum(0), 1.0)
        off = side.square - side.square.sum(0) / total * side.count
        variance += num_parts / (num_parts - 1) * (off**2).sum(0) / total**2
    return np.sqrt(variance)


def _test_excess(field: _PartSums, floor: _PartSums, generator: np.random.Generator) -> np.ndarray:
    """Return how probable so large a mean increment would be by chance, `(J, C)`.

    NaN where one side never visited the regime.
    """
    added = np.concatenate([field.added, floor.added])
    count = np.concatenate([field.count, floor.count])
    is_field = np.arange(len(count)) < len(field.count)
    drawn = generator.permuted(np.tile(is_field, (NUM_PERMUTATIONS, 1)), axis=1)
    sides = np.concatenate([is_field[None], drawn]).astype(float)  # the first is the observation
    with np.errstate(invalid="ignore", divide="ignore"):
        mine = np.tensordot(sides, added, 1) / np.tensordot(sides, count, 1)
        others = np.tensordot(1.0 - sides, added, 1) / np.tensordot(1.0 - sides, count, 1)
        difference = mine - others
        seen = difference[0]
        # A draw in which one side never visits the regime says nothing against chance; rounding
        # must not tell equals apart.
        is_larger = ~(difference < seen - 1e-12 * np.abs(seen))
    return np.where(np.isfinite(seen), is_larger.mean(0), np.nan)


def _take_first_positive(*choices: np.ndarray) -> np.ndarray:
    """Return the positive part of the first choice that has any."""
    for choice in choices:
        if (choice > 0).any():
            return np.maximum(choice, 0.0)
    return np.zeros_like(choices[-1])


def _normalise(values: np.ndarray) -> np.ndarray:
    return values / max(float(values.sum()), TINY)


def _adjust_p_values(p: np.ndarray) -> np.ndarray:
    """Return p adjusted for the false discovery rate (Benjamini and Hochberg 1995); NaN stays NaN."""
    found = np.full(p.shape, np.nan)
    given = np.isfinite(p)
    if given.any():
        found[given] = false_discovery_control(p[given])
    return found
