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
from study.operators.person import Person, Range

DAMPING = 0.05
"""Damping of the least squares, m at unit motion."""
ROUNDS = 4
"""Gauss-Newton steps from the arm as it is to the arm as it should be."""
MARGIN = 0.05
"""Distance from the ends of the joints that is kept, rad or m."""


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

    def build(self, machine: Machine, person: Person) -> SightModel:
        """Return the person's eyes."""
        return SightModel(self, machine, person)


class SightModel:
    """Eyes at work.

    Attributes:
        way: Apparent error of each joint, `(J,)`: an exclusive joint alone, or all others.
    """

    def __init__(self, sight: Sight, machine: Machine, person: Person) -> None:
        self._config, self._machine, self._chance = sight, machine, person.chance
        self._relative = person.draw("relative", sight.relative)
        self._finest_m = person.draw("finest_m", sight.finest_m)
        self._habit = self._chance.standard_normal(3)
        self._exclusive = np.flatnonzero(machine.is_exclusive)
        behind = int(self._exclusive.max(initial=-1)) + 1
        self._reach_joint = min(behind, machine.num_joints - 1)
        self._period = max(1, round(1.0 / (sight.looks_hz * machine.period_s)))
        self._steps = 0
        self.way = np.zeros(machine.num_joints)

    def look(self, q: np.ndarray, rim_in_base_m: np.ndarray) -> bool:
        """Look, where it is time to, at the arm at `q`, `(J,)` (where it is, or will be); says whether `way` is new."""
        self._steps += 1
        if (self._steps - 1) % self._period:
            return False
        config = self._config
        tip_m = compute_tool_kinematics(self._machine, q).tip_in_base_m
        size = self._relative * np.linalg.norm(rim_in_base_m - tip_m) + self._finest_m
        error = 0.5 * self._habit + 0.5 * self._chance.standard_normal(3)
        seen = rim_in_base_m + size * error / math.sqrt(3)
        outer, inner = config.funnel_m
        aside = math.hypot(*(seen - tip_m)[:2])
        lift = min(max((aside - inner) / (outer - inner), 0.0), 1.0) * config.hover_m
        height = tip_m[2] - seen[2]
        lowered = min(height, config.hover_m) - config.lower_m
        goal = seen + np.array([0.0, 0.0, max(lift - config.depth_m, lowered)])
        self.way = np.where(self._machine.is_exclusive, 0.0, self._solve(q, goal) - q)
        if height > config.clear_m:
            for joint in self._exclusive:
                self._position(int(joint), q, seen)
        return True

    def _solve(self, start: np.ndarray, goal_m: np.ndarray) -> np.ndarray:
        """Return joint positions that put the upright tool at `goal_m`, `(3,)`, within the limits, by the free joints."""
        machine, q = self._machine, start
        free = (~machine.is_exclusive).astype(float)
        for _ in range(ROUNDS):
            at = compute_tool_kinematics(machine, q)
            step = goal_m - at.tip_in_base_m
            step = step * min(1.0, 0.6 / max(float(np.linalg.norm(step)), 1e-9))
            tilt = np.clip(np.array([0.0, 0.0, -1.0]) - at.axis_in_base, -0.5, 0.5)
            q = q + solve_joint_step(at, np.concatenate((step, tilt)), free, DAMPING)
            q = np.clip(q, machine.lower + MARGIN, machine.upper - MARGIN)
        return np.where(np.isfinite(q), q, start)

    def _position(self, joint: int, q: np.ndarray, rim_m: np.ndarray) -> None:
        """Let the exclusive joint move alone where the hole is out of reach of the others."""
        near, far = self._config.reach_m
        distance = self._measure_reach(q, rim_m)
        if near <= distance <= far:
            return
        nudge = 0.01 * np.eye(len(q))[joint]
        slope = (self._measure_reach(q + nudge, rim_m) - distance) / 0.01
        wanted = np.clip(((near + far) / 2 - distance) * slope / (slope**2 + 0.05), -0.5, 0.5)
        lower, upper = self._machine.lower[joint] + MARGIN, self._machine.upper[joint] - MARGIN
        away = np.clip(q[joint] + wanted, lower, upper) - q[joint]
        if abs(away) > 0.01:
            self.way = away * np.eye(len(q))[joint]

    def _measure_reach(self, q: np.ndarray, rim_m: np.ndarray) -> float:
        """Return the distance of the hole from the first joint behind the exclusive ones, turned into the arm's plane."""
        origin = compute_tool_kinematics(self._machine, q).joints_in_base_m[self._reach_joint]
        ahead = math.hypot(*rim_m[:2]) - math.hypot(*origin[:2])
        return math.hypot(ahead, rim_m[2] - origin[2])
