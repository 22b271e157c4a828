"""A person at work: strokes towards places, and short corrections there. It moves otherwise than a test programme."""

from typing import Annotated

import numpy as np
from annotated_types import Interval

from actuators.excite.poses import PoseProgram
from brokk_rl.machine import Machine
from brokk_rl.spec import Count, Ordered, Positive, PositiveRange, spec

CommandRange = Annotated[tuple[float, Annotated[float, Interval(gt=0, le=1)]], Ordered()]
"""Smallest and largest command."""


@spec
class Work(PoseProgram):
    """Strokes of one or some joints that the hand ramps, then short corrections to and fro, then a pause.

    Attributes:
        share: Part of the time, relative to the others of the plan.
        pose_s: Time after which another start pose is taken, about.
        joints_at_once: Most joints that move at the same time; an exclusive joint moves alone.
        stroke_s: Shortest and longest stroke; drawn log-uniformly.
        level: Smallest and largest command of a stroke.
        ramp_s: Time in which the hand takes the lever out, and lets it go.
        corrections: Most corrections after a stroke.
        correction_s: Shortest and longest correction.
        correction_level: Smallest and largest command of a correction.
        pause_s: Shortest and longest pause.
        stop_margin: As in `levels`.
    """

    joints_at_once: Count
    stroke_s: PositiveRange
    level: CommandRange
    ramp_s: Positive
    corrections: int
    correction_s: PositiveRange
    correction_level: CommandRange
    pause_s: PositiveRange

    def program(self, machine: Machine, steps: int, generator: np.random.Generator) -> np.ndarray:
        """Return the commands of so many control periods, `(T, J)`."""
        u, at = np.zeros((steps, machine.num_joints)), 0
        while at < steps:
            first = int(generator.integers(machine.num_joints))
            joints = [first]
            if not machine.is_exclusive[first]:
                others = np.flatnonzero(~machine.is_exclusive)
                others = generator.permutation(others[others != first])
                joints += others[: generator.integers(self.joints_at_once)].tolist()
            longest = 0
            for joint in joints:
                move = self._move(machine.period_s, generator)[: steps - at]
                u[at : at + len(move), joint] = move
                longest = max(longest, len(move))
            at += longest + round(generator.uniform(*self.pause_s) / machine.period_s)
        return u

    def _move(self, period_s: float, generator: np.random.Generator) -> np.ndarray:
        """Return a stroke of one joint with its corrections, `(T,)`."""
        side = generator.choice([-1.0, 1.0])
        stroke_s = np.exp(generator.uniform(*np.log(self.stroke_s)))
        parts = [self._ramp(side * generator.uniform(*self.level), stroke_s, period_s)]
        for _ in range(int(generator.integers(self.corrections + 1))):
            side = -side
            level = side * generator.uniform(*self.correction_level)
            parts.append(self._ramp(level, generator.uniform(*self.correction_s), period_s))
        return np.concatenate(parts)

    def _ramp(self, level: float, length_s: float, period_s: float) -> np.ndarray:
        """Return a command that is taken out to `level` and let go again, `(T,)`."""
        t_s = period_s * np.arange(1, max(2, round(length_s / period_s)))
        ramp_s = min(self.ramp_s, 0.5 * length_s)
        return np.interp(t_s, (0.0, ramp_s, length_s - ramp_s, length_s), (0.0, level, level, 0.0))
