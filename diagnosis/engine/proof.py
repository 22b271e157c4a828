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

from diagnosis.engine.baseline import JointBaseline
from diagnosis.engine.evidence import FieldJoint
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
        restarts: Paths begin at the measured position, as those of joints that take speeds do.
    """

    first: np.ndarray
    steps: int
    restarts: bool

    @property
    def rows(self) -> np.ndarray:
        """Rows of the simulated positions, `(W, K)`."""
        return self.first[:, None] + 1 + np.arange(self.steps)

    def cut(self, path: np.ndarray) -> np.ndarray:
        """Return a path `(…, T)` in each window, less its value at the beginning where it restarts, `(…, W, K)`."""
        found = path[..., self.rows]
        return found - path[..., self.first, None] if self.restarts else found


def list_windows(side: Side, horizon_s: float) -> Windows:
    """Return the windows of a side, on end, after each recording has settled."""
    steps = side.count(horizon_s)
    first = []
    for begin, end in zip(side.starts, side.ends, strict=True):
        first += range(begin + side.count(side.model.settling_s), end - steps, steps)
    return Windows(np.array(first, dtype=int), steps, side.model.integrates)


def run_free(side: Side, windows: Windows, numbers: Sequence[np.ndarray]) -> np.ndarray:
    """Return the positions of free runs with numbers `(P,)` of each joint, `(W, K, J)`, rad or m."""
    begun = side.q[windows.first]
    now = side.with_positions(side.q)
    positions = side.q[windows.rows]
    for _ in range(1 + POSE_ROUNDS):
        now.ask_others(numbers)
        paths = np.stack([now.simulate(j, row)[0] for j, row in enumerate(numbers)], 1)
        positions = paths[windows.rows]
        if windows.restarts:
            positions = positions + (begun - paths[windows.first])[:, None]
        q = side.q.copy()
        q[windows.rows] = positions
        now = side.with_positions(q)
    return positions * measure_units(side.machine)


class Floor:
    """Error of the unchanged machine under the motion of the field.

    On the reference the error of the left-out parts over a window is fitted as a function of how
    far the joint goes. What the likeliest ageing of the numbers adds is simulated on the field itself.

    Args:
        reference: The machine as it was.
        bases: Its joints.
        horizon_s: Length of the windows.
    """

    def __init__(self, reference: Side, bases: Sequence[JointBaseline], horizon_s: float) -> None:
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

    def foresee(self, windows: Windows, joints: Sequence[FieldJoint]) -> np.ndarray:
        """Return the mean squares that the unchanged machine would show, `(W, J)`, rad² or m².

        Args:
            windows: Windows of the field.
            joints: Joints of the field with the named effects.
        """
        found = []
        for joint, law in zip(joints, self._laws, strict=True):
            model, aged = joint.side.model, joint.numbers.copy()
            aged[model.fitted] += joint.nuisance.explain_ageing(joint.projection, joint.residual)
            aged = np.clip(aged, model.list_values("lower"), model.list_values("upper"))
            path = joint.side.simulate(joint.joint, aged)[0]
            moved = windows.cut(path - joint.path)
            motion = _describe_motion(joint.path, windows)
            found.append(motion @ law + np.square(moved).mean(1))
        machine = joints[0].side.machine
        squares = np.stack(found, 1) * np.square(measure_units(machine))
        # A joint that its reference hardly moved may run away in the simulation, the machine does not.
        return np.minimum(squares, np.square(machine.upper - machine.lower))


def _describe_motion(path: np.ndarray, windows: Windows) -> np.ndarray:
    """Return 1, the way in each window and its square, `(W, 3)`."""
    step = np.abs(np.diff(path, append=path[-1]))
    way = step[windows.rows - 1].sum(1)
    return np.stack([np.ones_like(way), way, way**2], 1)
