"""The proof: free runs over the field, with and without the named effects, and the floor.

A free run begins at the measured position of its window and then gets commands only. Poses and
demand of the other joints follow from the simulated positions, by iteration. Sizes are those that
were fitted to the other half of the field.
Axes: `T` samples, `W` windows, `K` steps, `J` joints, `P` numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from diagnosis.engine.baseline import FITTED, STEP, JointBaseline
from diagnosis.engine.measure import SETTLING_S
from diagnosis.engine.nuisance import AGEING, SPEED_AGEING, SPEEDS
from diagnosis.engine.side import Side, measure_units

POSE_ROUNDS = 2
"""Rounds in which poses follow the simulated positions. A third one changes errors by less than a
thousandth: pose and demand change speed by some ten per cent only."""


@dataclass(frozen=True)
class Windows:
    """Windows of a side.

    Attributes:
        first: Row of the measured position at which each begins, `(W,)`.
        steps: Number of simulated positions, `K`.
    """

    first: np.ndarray
    steps: int

    @property
    def rows(self) -> np.ndarray:
        """Rows of the simulated positions, `(W, K)`."""
        return self.first[:, None] + 1 + np.arange(self.steps)

    def cut(self, path: np.ndarray) -> np.ndarray:
        """Return a path `(…, T)` less its value at the beginning of each window, `(…, W, K)`."""
        return path[..., self.rows] - path[..., self.first, None]


def list_windows(side: Side, horizon_s: float) -> Windows:
    """Return the windows of a side, on end, after each recording has settled."""
    steps = side.count(horizon_s)
    first = []
    for begin, end in zip(side.starts, side.ends, strict=True):
        first += range(begin + side.count(SETTLING_S), end - steps, steps)
    return Windows(np.array(first, dtype=int), steps)


def run_free(side: Side, windows: Windows, numbers: Sequence[np.ndarray]) -> np.ndarray:
    """Return the positions of free runs with numbers `(P,)` of each joint, `(W, K, J)`, rad or m."""
    begun = side.q[windows.first]
    now = side.with_positions(side.q)
    positions = side.q[windows.rows]
    for _ in range(1 + POSE_ROUNDS):
        now.ask_others(numbers)
        moved = [windows.cut(now.simulate(j, row)[0]) for j, row in enumerate(numbers)]
        positions = begun[:, None] + np.stack(moved, 2)
        q = side.q.copy()
        q[windows.rows] = positions
        now = side.with_positions(q)
    return positions * measure_units(side.machine)


class Floor:
    """Error of the unchanged machine under the motion of the field.

    On the reference the error of the left-out parts over a window is fitted as a function of how
    far the joint goes. What the ageing of the numbers adds is simulated on the field itself.

    Args:
        reference: The machine as it was.
        bases: Its joints.
        horizon_s: Length of the windows.
    """

    def __init__(self, reference: Side, bases: Sequence[JointBaseline], horizon_s: float) -> None:
        self._bases = bases
        windows = list_windows(reference, horizon_s)
        self.errors = np.stack([windows.cut(base.error) for base in bases], 2)
        """Errors of the left-out parts, `(W, K, J)`, units."""
        self.windows = windows
        self._laws = []
        for j, base in enumerate(bases):
            squares = np.square(self.errors[..., j]).mean(1)
            path = reference.simulate(j, base.numbers)[0]
            columns = _describe_motion(path, windows)
            weight = 1.0 / np.sqrt(np.maximum(np.median(squares), 1e-12) + squares)
            law, _ = nnls(columns * weight[:, None], squares * weight)
            self._laws.append(law)

    def foresee(self, side: Side, windows: Windows, numbers: Sequence[np.ndarray]) -> np.ndarray:
        """Return the mean squares that the unchanged machine would show, `(W, J)`, rad² or m²."""
        found = []
        for j, (base, row) in enumerate(zip(self._bases, numbers, strict=True)):
            varied = np.repeat(row[None], 1 + len(FITTED), 0)
            varied[1 + np.arange(len(FITTED)), FITTED] += STEP
            paths = windows.cut(side.simulate(j, varied))
            ageing = np.where(SPEEDS, SPEED_AGEING * base.numbers[FITTED], AGEING)
            changes = (paths[1:] - paths[:1]) * (ageing / STEP)[:, None, None]
            aged = np.square(changes).mean(2).sum(0)
            motion = _describe_motion(side.simulate(j, row)[0], windows)
            found.append(motion @ self._laws[j] + aged)
        return np.stack(found, 1) * np.square(measure_units(side.machine))


def _describe_motion(path: np.ndarray, windows: Windows) -> np.ndarray:
    """Return 1, the way in each window and its square, `(W, 3)`."""
    step = np.abs(np.diff(path, append=path[-1]))
    way = step[windows.rows - 1].sum(1)
    return np.stack([np.ones_like(way), way, way**2], 1)
