"""Location of the gap by joint, regime, direction, load, frequency and running time.

The floor is the error of the same simulator on reference recordings that it was not fitted to. The
gap is the error beyond the floor and beyond one standard error. Each grouping splits error and gap
completely: parts add up to 1 over joints and categories.

An error of position stays after its cause is over, so it is traced to its origin: the error of a
window is the sum of its increments, `e = Σ_c e_c` with `e_c` those of the samples in category `c`,
and `Σ_t e_c(t) e(t)` is the part of the squared error of category `c`. The parts add up exactly; a
negative part works against the others. Frequency bands add up by Parseval's theorem, recordings and
running time by windows.
Axes: `W` windows, `K` steps, `J` joints, `C` categories.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from actuators.scales import scale_time
from brokk_rl.machine import Machine
from diagnosis.error_growth import ErrorGrowth, measure_growth
from diagnosis.free_runs import WindowedRuns
from diagnosis.permutation_test import (
    FALSE_DISCOVERY_RATE,
    adjust_p_values,
    assign_blocks,
    compute_excess_p,
    estimate_standard_error,
    sum_by_block,
)
from diagnosis.regimes import SampleGrouping, group_samples
from diagnosis.sanity import name_recording

BANDS_HZ = (0.3, 1.0, 3.0)
"""Bounds of the frequency bands, Hz; chosen by hand: drift, motion, valve, vibration."""
NUM_AGES = 4
"""Number of parts of the running time; chosen by hand."""
INCREMENT_S = 0.25
"""Time of the increments that the tests compare on the reference of `actuators.scales`, s; chosen by
hand: increments are less dependent than the error, which stays."""


@dataclass(frozen=True)
class GroupSums:
    """Sums of each window by joint and category, all `(W, J, C)`.

    Attributes:
        categories: Their names.
        square: Part of the squared error.
        tested: Quantity that the tests compare: of a band, its part of the squared error; else the
            increment of the error
            within `INCREMENT_S`: within a category its size (a few windows would decide its square), of
                a joint as a whole its square
            (in the mean size a short regime would drown).
        count: Samples.
    """

    categories: tuple[str, ...]
    square: np.ndarray
    tested: np.ndarray
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


def sum_by_joint(runs: WindowedRuns, machine: Machine) -> GroupSums:
    """Return the sums of each joint as a single category."""
    count = np.isfinite(runs.error).sum(1)[..., None].astype(float)
    return GroupSums(
        ("",),
        np.nansum(runs.error**2, 1)[..., None],
        (_measure_increments(runs, machine) ** 2).sum(1)[..., None],
        count,
    )


def sum_by_condition(
    runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray
) -> dict[str, GroupSums]:
    """Return the sums by regime, direction, load (where masses are known) and frequency."""
    found = {}
    for dimension in group_samples(list(runs.recordings), machine, dead_time_s):
        found[dimension.name] = _sum_by_origin(runs, dimension, machine)
    return found | {"frequency": _sum_by_band(runs, machine)}


def sum_by_time(runs: WindowedRuns, machine: Machine) -> dict[str, GroupSums]:
    """Return the sums by recording and by running time, which are those of whole windows."""
    edges = np.linspace(runs.elapsed_s.min(), runs.elapsed_s.max(), NUM_AGES + 1)
    age = np.clip(np.searchsorted(edges, runs.elapsed_s, "right") - 1, 0, NUM_AGES - 1)
    whole = sum_by_joint(runs, machine)

    def sums(names: tuple[str, ...], label: np.ndarray) -> GroupSums:
        belongs = label[:, None, None] == np.arange(len(names))
        return GroupSums(
            names, whole.square * belongs, whole.tested * belongs, whole.count * belongs
        )

    ages = tuple(f"{low:.0f} to {high:.0f} s" for low, high in pairwise(edges))
    return {
        "running time": sums(ages, age),
        "recording": sums(tuple(map(name_recording, runs.recordings)), runs.source),
    }


def _measure_increments(runs: WindowedRuns, machine: Machine) -> np.ndarray:
    """Return the absolute increment of the error within `INCREMENT_S`, `(W, K, J)`."""
    span = max(1, round(scale_time(machine, INCREMENT_S) / machine.period_s))
    before = np.pad(runs.error, ((0, 0), (span, 0), (0, 0)))[:, : runs.error.shape[1]]
    return np.nan_to_num(np.abs(runs.error - before))


def _sum_by_origin(runs: WindowedRuns, dimension: SampleGrouping, machine: Machine) -> GroupSums:
    label, names = runs.cut(dimension.label), dimension.categories
    error, added = np.nan_to_num(runs.error), _measure_increments(runs, machine)
    square = (trace_to_origin(runs.error, label, len(names)) * error).sum(2)
    belongs = np.stack([label == c for c in range(len(names))])
    return GroupSums(
        names,
        np.moveaxis(square, 0, 2),
        np.moveaxis((added * belongs).sum(2), 0, 2),
        np.moveaxis(belongs.sum(2).astype(float), 0, 2),
    )


def _sum_by_band(runs: WindowedRuns, machine: Machine) -> GroupSums:
    """Split by Parseval's theorem; the error after the end of a recording counts as 0."""
    error = np.nan_to_num(runs.error)
    power = np.abs(np.fft.rfft(error, axis=1)) ** 2 / error.shape[1]
    hertz = np.fft.rfftfreq(error.shape[1], machine.period_s)
    power[:, (hertz > 0) & (hertz < 0.5 / machine.period_s - 1e-9)] *= 2.0  # the mirrored half
    bands = []
    for low, high in pairwise((0.0, *BANDS_HZ, np.inf)):
        bands.append(power[:, (hertz >= low) & (hertz < high)].sum(1))
    square = np.stack(bands, 2)
    names = (
        f"below {BANDS_HZ[0]:g} Hz",
        *(f"{a:g} to {b:g} Hz" for a, b in pairwise(BANDS_HZ)),
        f"above {BANDS_HZ[-1]:g} Hz",
    )
    count = np.repeat(np.isfinite(runs.error).sum(1)[..., None].astype(float), len(names), 2)
    return GroupSums(names, square, square, count)


TINY = np.finfo(float).tiny
"""Smallest divisor: a sum of squares may be 0."""


@dataclass(frozen=True)
class GapPart:
    """Share of one category of one joint in error and gap.

    Attributes:
        joint: The joint.
        category: The category.
        time: Part of the joint's time that it takes.
        error: Its part of the whole squared error of all joints; those of one dimension add up to
            1.
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

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        found = {}
        for name, value in self.__dict__.items():
            found[name] = round(value, 6) if isinstance(value, float) else value
        return found


@dataclass(frozen=True)
class JointError:
    """Error of one joint over the horizon of the free runs.

    Attributes:
        rmse: Root mean square error, rad or m.
        floor: The same on the reference; 0 without one.
        error: Its part of the squared error of all joints (of travel, where units differ).
        gap: Its part of the excess over the floor; of the squared error where nothing exceeds it.
        p: How probable so large an excess would be by chance.
        is_sure: It exceeds the floor, with at most 5 % false discoveries among the joints.
    """

    rmse: float
    floor: float
    error: float
    gap: float
    p: float | None
    is_sure: bool


@dataclass(frozen=True)
class GapLocation:
    """Location of the gap.

    Attributes:
        joints: By joint.
        parts: By dimension (`regime`, `direction`, `load`, `frequency`, `running time`,
            `recording`).
        growth: By joint.
        blocks: Unit that changed sides in the tests; empty without a reference.
        has_gap: A joint exceeds its floor for sure; without a reference there is no telling, and
            this is true.
    """

    joints: dict[str, JointError]
    parts: dict[str, list[GapPart]]
    growth: dict[str, ErrorGrowth]
    blocks: str
    has_gap: bool

    def totals(self, dimension: str) -> dict[str, float]:
        """Return the part of the gap of each category, all joints together."""
        found: dict[str, float] = {}
        for part in self.parts[dimension]:
            found[part.category] = found.get(part.category, 0.0) + part.gap
        return found

    def largest(self, dimension: str = "regime") -> list[GapPart]:
        """Return the parts of one dimension, the largest of the gap first."""
        return sorted(self.parts[dimension], key=lambda part: -part.gap)

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return {
            "joints": {name: joint.__dict__ for name, joint in self.joints.items()},
            "parts": {name: [part.plain() for part in parts] for name, parts in self.parts.items()},
            "growth": {name: growth.plain() for name, growth in self.growth.items()},
            "blocks": self.blocks,
            "has_gap": self.has_gap,
        }


def locate_gap(
    runs: WindowedRuns,
    reference: WindowedRuns | None,
    machine: Machine,
    dead_time_s: np.ndarray,
    generator: np.random.Generator,
    whole: WindowedRuns | None = None,
) -> GapLocation:
    """Return where the gap lies.

    Args:
        runs: Free runs through field recordings.
        reference: The same simulator's through reference recordings that it was not fitted to;
            `None`: there is no floor.
        machine: Gives joints, limits, period and masses.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
        generator: Draws the permutations.
        whole: Free runs through whole field recordings, for the growth beyond the windows.
    """
    judge = _GapTest(runs, reference, machine, generator)
    joints = judge.joints()
    own = {**sum_by_condition(runs, machine, dead_time_s), **sum_by_time(runs, machine)}
    floor = sum_by_condition(reference, machine, dead_time_s) if reference else {}
    parts = {name: judge.parts(sums, floor.get(name), joints) for name, sums in own.items()}
    has_gap = reference is None or any(joint.is_sure for joint in joints.values())
    return GapLocation(
        joints, parts, measure_growth(runs, reference, machine, whole), judge.unit, has_gap
    )


class _GapTest:
    """Comparison of field and reference: the excess over the floor and its p-values."""

    def __init__(
        self,
        runs: WindowedRuns,
        reference: WindowedRuns | None,
        machine: Machine,
        generator: np.random.Generator,
    ) -> None:
        self._machine, self._generator = machine, generator
        # Metres and radians do not add up, so mixed joints count by their travel.
        alike = len({joint.unit for joint in machine.joints}) == 1
        self._weight = (
            np.ones(machine.num_joints) if alike else (machine.upper - machine.lower) ** -2.0
        )
        self._mine = sum_by_joint(runs, machine)
        self._floor = sum_by_joint(reference, machine) if reference else None
        self._blocks = assign_blocks(runs, reference) if reference else None
        self.unit = self._blocks.unit if self._blocks else ""

    def joints(self) -> dict[str, JointError]:
        """Return the error of each joint."""
        mean, base = _average_square(self._mine), self._floor_mean()
        rmse, floor = np.sqrt(mean).tolist(), np.sqrt(base).tolist()
        count = self._mine.count.sum(0)[:, 0]
        error = mean * count * self._weight
        error = error / max(error.sum(), TINY)
        chance = self._chance(self._mine, self._floor)[:, 0]
        excess = (
            _take_first_positive(mean - base - chance, mean - base, mean) * count * self._weight
        )
        gap = excess / max(excess.sum(), TINY)
        p = self._p(self._mine, self._floor)[:, 0]
        sure = adjust_p_values(p) <= FALSE_DISCOVERY_RATE
        found = {}
        for j, name in enumerate(self._machine.joint_names):
            found[name] = JointError(
                rmse[j], floor[j], float(error[j]), float(gap[j]), _drop_nan(p[j]), bool(sure[j])
            )
        return found

    def parts(
        self, sums: GroupSums, floor: GroupSums | None, joints: dict[str, JointError]
    ) -> list[GapPart]:
        """Return the parts of one grouping; without reference samples the joint's floor counts."""
        square, count = sums.square.sum(0), sums.count.sum(0)
        expected = self._floor_mean()[:, None] * count
        if floor is not None:
            seen = floor.count.sum(0)
            expected = np.where(
                seen > 0, floor.square.sum(0) / np.maximum(seen, 1.0) * count, expected
            )
        chance = self._chance(sums, floor) * count
        # A joint keeps parts that add up to 1 even where nothing exceeds the floor for sure.
        rows = zip(square - expected - chance, square - expected, square, strict=True)
        excess = np.stack([_take_first_positive(*row) for row in rows])
        within = excess / np.maximum(excess.sum(1, keepdims=True), TINY)
        gap = within * np.array([joint.gap for joint in joints.values()])[:, None]
        error = square * self._weight[:, None]
        error = error / max(self._mine.square.sum((0, 2)) @ self._weight, TINY)
        time = count / np.maximum(self._mine.count.sum(0), 1.0)
        p = self._p(sums, floor)
        sure = adjust_p_values(p) <= FALSE_DISCOVERY_RATE
        found = []
        for j, name in enumerate(self._machine.joint_names):
            for c, category in enumerate(sums.categories):
                shares = (float(time[j, c]), float(error[j, c]), float(gap[j, c]))
                found.append(GapPart(name, category, *shares, _drop_nan(p[j, c]), bool(sure[j, c])))
        return found

    def _floor_mean(self) -> np.ndarray:
        return _average_square(self._floor) if self._floor else np.zeros(self._machine.num_joints)

    def _chance(self, mine: GroupSums, floor: GroupSums | None) -> np.ndarray:
        """Return the standard error of the excess over the floor, per sample, `(J, C)`."""
        shape = mine.square.shape[1:]
        if floor is None or self._blocks is None:
            return np.zeros(shape)
        square = np.zeros(shape)
        # Field and reference are independent, so their variances add up.
        for sums, block in ((mine, self._blocks.field), (floor, self._blocks.reference)):
            error = estimate_standard_error(
                _sum_blocks(sums.square, block), _sum_blocks(sums.count, block)
            )
            square += np.nan_to_num(error.reshape(shape)) ** 2
        return np.sqrt(square)

    def _p(self, mine: GroupSums, floor: GroupSums | None) -> np.ndarray:
        """Return p of each joint and category, `(J, C)`; NaN without a floor."""
        shape = mine.square.shape[1:]
        if floor is None or self._blocks is None:
            return np.full(shape, np.nan)
        own, other = self._blocks.field, self._blocks.reference
        field = (_sum_blocks(mine.tested, own), _sum_blocks(mine.count, own))
        reference = (_sum_blocks(floor.tested, other), _sum_blocks(floor.count, other))
        return compute_excess_p(field, reference, self._generator).reshape(shape)


def _sum_blocks(values: np.ndarray, block: np.ndarray) -> np.ndarray:
    return sum_by_block(values.reshape(len(block), -1), block)


def _take_first_positive(*choices: np.ndarray) -> np.ndarray:
    """Return the positive part of the first choice that has any."""
    for choice in choices:
        if (choice > 0).any():
            return np.maximum(choice, 0.0)
    return np.zeros_like(choices[-1])


def _average_square(sums: GroupSums) -> np.ndarray:
    """Return the mean squared error of each joint, `(J,)`."""
    return sums.square.sum(0)[:, 0] / np.maximum(sums.count.sum(0)[:, 0], 1.0)


def _drop_nan(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
