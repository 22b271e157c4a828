"""The view of an operator without advice: tool error as seen from the hole, and the motion of each joint to do about it.

The eye judges the way left with an error in proportion to it, a few times a second; the head knows
how the arm moves. The tool is first brought above the hole, then, as far as it is aligned, lowered
a little at a time.
"""

from __future__ import annotations

import math

import numpy as np

from brokk_rl.kinematics import compute_tool_kinematics, solve_joint_step
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from study.operators.traits import Range, Traits
from study.trial_contract import OperatorView

DAMPING = 0.05
"""Damping of the least squares, m at unit motion."""
ROUNDS = 4
"""Gauss-Newton steps from the arm as it is to the arm as it should be."""


@spec
class Sight:
    """An operator's visual errors and aim.

    Attributes:
        looks_hz: Pictures a second.
        relative: Error of the way left, as a share of it; constant through a person's trial and
            part by part new in each picture.
        finest_m: Error that remains close by.
        hover_m: Height above the target at which the tool is aligned.
        funnel_m: Lateral errors at which lowering begins and at which it is free, (outer, inner).
        lower_m: How far the tool is lowered at a time.
        depth_m: How deep it is aimed below the rim.
        reach_m: Distances from the first joint behind the exclusive ones within which these rest,
            (nearest, farthest).
        clear_m: Height of the tool above the rim below which the exclusive joints rest.
    """

    looks_hz: float
    relative: Range
    finest_m: Range
    hover_m: float
    funnel_m: tuple[float, float]
    lower_m: float
    depth_m: float
    reach_m: tuple[float, float]
    clear_m: float

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> SightModel:
        """Return the eyes of the persons `(N,)`."""
        return SightModel(self, machine, persons, seed)


class SightModel:
    """Eyes at work; `N` trials."""

    def __init__(self, sight: Sight, machine: Machine, persons: np.ndarray, seed: int) -> None:
        self._config, self._machine = sight, machine
        traits = Traits(persons, seed)
        self._relative, self._finest_m = (
            traits.draw("relative", sight.relative),
            traits.draw("finest_m", sight.finest_m),
        )
        self._generator = np.random.default_rng((seed, 2))
        self._habit = self._generator.standard_normal((len(persons), 3))
        exclusive = np.flatnonzero(machine.is_exclusive)
        self._reach_joint = (
            min(int(exclusive[-1]) + 1, machine.num_joints - 1) if len(exclusive) else 0
        )
        self._period = max(1, round(1.0 / (sight.looks_hz * machine.period_s)))
        self._steps = 0
        self.way = np.zeros((len(persons), machine.num_joints))
        """Return the apparent error of each joint, `(N, J)`: exclusive joints alone,
        or all others."""

    def look(self, view: OperatorView, q: np.ndarray) -> bool:
        """Look, where it is time to, at the arm at `q`, `(N, J)` (where it is, or will be); says whether `way` is new."""
        self._steps += 1
        if (self._steps - 1) % self._period:
            return False
        config, machine = self._config, self._machine
        now = compute_tool_kinematics(machine, q)
        left = view.rim_in_base_m - now.tip_in_base_m
        size = self._relative * np.linalg.norm(left, axis=1, keepdims=True) + self._finest_m
        chance = self._generator.standard_normal(left.shape)
        seen = view.rim_in_base_m + size * (0.5 * self._habit + 0.5 * chance) / math.sqrt(3)
        outer, inner = config.funnel_m
        aside = np.linalg.norm((seen - now.tip_in_base_m)[:, :2], axis=1)
        lift = np.clip((aside - inner) / (outer - inner), 0.0, 1.0) * config.hover_m
        height = now.tip_in_base_m[:, 2] - seen[:, 2]
        goal = seen.copy()
        goal[:, 2] += np.maximum(
            lift - config.depth_m, np.minimum(height, config.hover_m) - config.lower_m
        )
        self.way = np.where(machine.is_exclusive, 0.0, self._solved(q, goal) - q)
        for joint in np.flatnonzero(machine.is_exclusive):
            self._position(int(joint), q, seen, now.tip_in_base_m)
        return True

    def _solved(self, q: np.ndarray, goal_m: np.ndarray) -> np.ndarray:
        """Return joint positions that put the upright tool at `goal_m`, `(N, 3)`, within the limits, by the free joints."""
        machine, start = self._machine, q
        free = (~machine.is_exclusive).astype(float)
        for _ in range(ROUNDS):
            at = compute_tool_kinematics(machine, q)
            step = goal_m - at.tip_in_base_m
            step = step * np.minimum(
                1.0, 0.6 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
            )
            tilt = np.clip(np.array([0.0, 0.0, -1.0]) - at.axis_in_base, -0.5, 0.5)
            wanted = np.concatenate((step, tilt), 1)
            q = q + solve_joint_step(at, wanted, free, DAMPING)
            q = np.clip(q, machine.lower + 0.05, machine.upper - 0.05)
        return np.where(np.isfinite(q), q, start)

    def _position(self, joint: int, q: np.ndarray, rim_m: np.ndarray, tip_m: np.ndarray) -> None:
        """Let the exclusive joint move alone where the hole is out of reach of the others and the tool is clear of it."""
        near, far = self._config.reach_m
        distance = self._reach(q, rim_m)
        nudged = q.copy()
        nudged[:, joint] += 0.01
        slope = (self._reach(nudged, rim_m) - distance) / 0.01
        out = ((distance < near) | (distance > far)) & (
            tip_m[:, 2] > rim_m[:, 2] + self._config.clear_m
        )
        wanted = np.clip(((near + far) / 2 - distance) * slope / (slope**2 + 0.05), -0.5, 0.5)
        target = np.clip(
            q[:, joint] + wanted,
            self._machine.lower[joint] + 0.05,
            self._machine.upper[joint] - 0.05,
        )
        moves = out & (np.abs(target - q[:, joint]) > 0.01)
        self.way[moves] = 0.0
        self.way[moves, joint] = (target - q[:, joint])[moves]

    def _reach(self, q: np.ndarray, rim_m: np.ndarray) -> np.ndarray:
        """Return the distance of the hole from the first joint behind the exclusive ones, turned into the arm's plane, `(N,)`."""
        origin = compute_tool_kinematics(self._machine, q).joints_in_base_m[:, self._reach_joint]
        radius = np.hypot(origin[:, 0], origin[:, 1])
        return np.hypot(np.hypot(rim_m[:, 0], rim_m[:, 1]) - radius, rim_m[:, 2] - origin[:, 2])
