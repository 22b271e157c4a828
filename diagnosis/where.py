"""Where the gap lies: error of free runs beyond the floor, by joint, regime, direction, load, frequency and time, with tests.

The floor is the error of the same simulator on reference recordings that it was not fitted to; what
exceeds it,
beyond one standard error, is the gap. Each way of sorting splits error and gap completely: parts
add up to 1 over joints and categories.
Axes: `W` windows, `J` joints, `C` categories.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.blocks import FALSE_DISCOVERIES, adjusted, blocks, excess_p, standard_error, summed
from diagnosis.free_runs import WindowedRuns
from diagnosis.growth import Growth, growth
from diagnosis.tracing import Sums, by_joint, by_occasion, by_time

TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class Part:
    """What one category of one joint answers for.

    Attributes:
        joint: The joint.
        category: The category.
        time: Part of the joint's time that it takes.
        error: Its part of the whole squared error of all joints; those of one dimension add up to
            1.
        gap: Its part of what exceeds the floor; they add up to 1 as well, none is below 0.
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
        """Returns it as plain JSON data."""
        return {
            name: round(value, 6) if isinstance(value, float) else value
            for name, value in self.__dict__.items()
        }


@dataclass(frozen=True)
class JointError:
    """Error of one joint over the horizon of the free runs.

    Attributes:
        rmse: Root mean square error, rad or m.
        floor: The same on the reference; 0 without one.
        error: Its part of the squared error of all joints (of travel, where units differ).
        gap: Its part of what exceeds the floor; of the squared error where nothing does.
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
class Location:
    """Where the gap lies.

    Attributes:
        joints: By joint.
        parts: By dimension (`regime`, `direction`, `load`, `frequency`, `running time`,
            `recording`).
        growth: By joint.
        blocks: What changed sides in the tests; empty without a reference.
        has_gap: A joint exceeds its floor for sure; without a reference there is no telling, and
            this is true.
    """

    joints: dict[str, JointError]
    parts: dict[str, list[Part]]
    growth: dict[str, Growth]
    blocks: str
    has_gap: bool

    def totals(self, dimension: str) -> dict[str, float]:
        """Returns the part of the gap of each category, all joints together."""
        found: dict[str, float] = {}
        for part in self.parts[dimension]:
            found[part.category] = found.get(part.category, 0.0) + part.gap
        return found

    def largest(self, dimension: str = "regime") -> list[Part]:
        """Returns the parts of one dimension, the largest of the gap first."""
        return sorted(self.parts[dimension], key=lambda part: -part.gap)

    def plain(self) -> dict[str, Any]:
        """Returns it as plain JSON data."""
        return {
            "joints": {name: joint.__dict__ for name, joint in self.joints.items()},
            "parts": {name: [part.plain() for part in parts] for name, parts in self.parts.items()},
            "growth": {name: growth.plain() for name, growth in self.growth.items()},
            "blocks": self.blocks,
            "has_gap": self.has_gap,
        }


def locate(
    runs: WindowedRuns,
    reference: WindowedRuns | None,
    machine: Machine,
    dead_time_s: np.ndarray,
    generator: np.random.Generator,
    whole: WindowedRuns | None = None,
) -> Location:
    """Returns where the gap lies.

    Args:
        runs: Free runs through field recordings.
        reference: The same simulator's through reference recordings that it was not fitted to;
            `None`: there is no floor.
        machine: Gives joints, limits, period and masses.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
        generator: Draws the permutations.
        whole: Free runs through whole field recordings, for the growth beyond the windows.
    """
    judge = _Judge(runs, reference, machine, generator)
    joints = judge.joints()
    own = {**by_occasion(runs, machine, dead_time_s), **by_time(runs, machine)}
    floor = by_occasion(reference, machine, dead_time_s) if reference else {}
    parts = {name: judge.parts(sums, floor.get(name), joints) for name, sums in own.items()}
    has_gap = reference is None or any(joint.is_sure for joint in joints.values())
    return Location(joints, parts, growth(runs, reference, machine, whole), judge.unit, has_gap)


class _Judge:
    """Holds both sides against each other: what exceeds the floor, and how sure that is."""

    def __init__(
        self,
        runs: WindowedRuns,
        reference: WindowedRuns | None,
        machine: Machine,
        generator: np.random.Generator,
    ) -> None:
        self._machine, self._generator = machine, generator
        alike = len({joint.unit for joint in machine.joints}) == 1
        self._weight = (
            np.ones(machine.num_joints) if alike else (machine.upper - machine.lower) ** -2.0
        )
        self._mine = by_joint(runs, machine)
        self._floor = by_joint(reference, machine) if reference else None
        self._blocks = blocks(runs, reference) if reference else None
        self.unit = self._blocks.unit if self._blocks else ""

    def joints(self) -> dict[str, JointError]:
        """Returns the error of each joint."""
        mean, base = _mean(self._mine), self._floor_mean()
        rmse, floor = np.sqrt(mean).tolist(), np.sqrt(base).tolist()
        count = self._mine.count.sum(0)[:, 0]
        error = mean * count * self._weight
        error = error / max(error.sum(), TINY)
        chance = self._chance(self._mine, self._floor)[:, 0]
        excess = _first_positive(mean - base - chance, mean - base, mean) * count * self._weight
        gap = excess / max(excess.sum(), TINY)
        p = self._p(self._mine, self._floor)[:, 0]
        sure = adjusted(p) <= FALSE_DISCOVERIES
        return {
            name: JointError(
                rmse[j], floor[j], float(error[j]), float(gap[j]), _known(p[j]), bool(sure[j])
            )
            for j, name in enumerate(self._machine.joint_names)
        }

    def parts(self, sums: Sums, floor: Sums | None, joints: dict[str, JointError]) -> list[Part]:
        """Returns the parts of one way of sorting; where the reference never was, the joint's own floor counts."""
        square, count = sums.square.sum(0), sums.count.sum(0)
        expected = self._floor_mean()[:, None] * count
        if floor is not None:
            seen = floor.count.sum(0)
            expected = np.where(
                seen > 0, floor.square.sum(0) / np.maximum(seen, 1.0) * count, expected
            )
        chance = self._chance(sums, floor) * count
        rows = zip(square - expected - chance, square - expected, square, strict=True)
        excess = np.stack([_first_positive(*row) for row in rows])
        within = excess / np.maximum(excess.sum(1, keepdims=True), TINY)
        gap = within * np.array([joint.gap for joint in joints.values()])[:, None]
        error = square * self._weight[:, None]
        error = error / max(self._mine.square.sum((0, 2)) @ self._weight, TINY)
        time = count / np.maximum(self._mine.count.sum(0), 1.0)
        p = self._p(sums, floor)
        sure = adjusted(p) <= FALSE_DISCOVERIES
        return [
            Part(
                name,
                category,
                float(time[j, c]),
                float(error[j, c]),
                float(gap[j, c]),
                _known(p[j, c]),
                bool(sure[j, c]),
            )
            for j, name in enumerate(self._machine.joint_names)
            for c, category in enumerate(sums.categories)
        ]

    def _floor_mean(self) -> np.ndarray:
        return _mean(self._floor) if self._floor else np.zeros(self._machine.num_joints)

    def _chance(self, mine: Sums, floor: Sums | None) -> np.ndarray:
        """Returns the standard error of what exceeds the floor, per sample, `(J, C)`; 0 without a floor to exceed."""
        shape = mine.square.shape[1:]
        if floor is None or self._blocks is None:
            return np.zeros(shape)
        square = np.zeros(shape)
        for sums, block in ((mine, self._blocks.field), (floor, self._blocks.reference)):
            totals = (
                summed(values.reshape(len(block), -1), block)
                for values in (sums.square, sums.count)
            )
            square += np.nan_to_num(standard_error(*totals).reshape(shape)) ** 2
        return np.sqrt(square)

    def _p(self, mine: Sums, floor: Sums | None) -> np.ndarray:
        """Returns p of each joint and category, `(J, C)`; NaN without a floor."""
        shape = mine.square.shape[1:]
        if floor is None or self._blocks is None:
            return np.full(shape, np.nan)
        field, reference = (
            (
                summed(sums.tested.reshape(len(block), -1), block),
                summed(sums.count.reshape(len(block), -1), block),
            )
            for sums, block in ((mine, self._blocks.field), (floor, self._blocks.reference))
        )
        return excess_p(field, reference, self._generator).reshape(shape)


def _first_positive(*choices: np.ndarray) -> np.ndarray:
    """Returns the positive part of the first choice that has any."""
    return next(
        (np.maximum(choice, 0.0) for choice in choices if (choice > 0).any()),
        np.zeros_like(choices[-1]),
    )


def _mean(sums: Sums) -> np.ndarray:
    """Returns the mean squared error of each joint, `(J,)`."""
    return sums.square.sum(0)[:, 0] / np.maximum(sums.count.sum(0)[:, 0], 1.0)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
