"""The paper's excitation: one joint at a time, sines of random frequency and amplitude."""

from typing import Annotated

import numpy as np
from annotated_types import Interval
from numpy.random import Generator

from actuators.excite.poses import move_joint
from actuators.excite.schedule import check_order
from brokk_rl.contracts.actuator import Segment
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec


@spec
class Sine:
    """One joint at a time, sines of random frequency and amplitude (the paper's excitation).

    Attributes:
        share: Part of the time, relative to the others of the plan.
        lowest_hz: Lowest frequency; frequencies are drawn log-uniformly, anew for each full wave.
        highest_hz: Highest frequency.
        smallest: Smallest amplitude; amplitudes are drawn uniformly.
        largest: Largest amplitude.
        stop_margin: A joint that would come to rest this close to its stop, as a part of its
            travel, is brought home.
    """

    share: Positive
    lowest_hz: Positive
    highest_hz: float
    smallest: Positive
    largest: Annotated[float, Interval(gt=0, le=1)]
    stop_margin: float

    def check(self) -> None:
        check_order(self, "lowest_hz", "highest_hz")
        check_order(self, "smallest", "largest")

    def segments(self, machine: Machine, duration_s: float, generator: Generator) -> list[Segment]:
        """Return one segment per joint, from home, of equal length, in random order."""
        steps = int(duration_s / machine.num_joints / machine.period_s)
        if steps * machine.period_s < 1.0 / self.highest_hz:
            raise ConfigError(
                f"excitation=sine: {duration_s:.1f} s for {machine.num_joints} joints do not hold a wave of {self.highest_hz:g} "
                "Hz; raise collect.run_minutes"
            )
        found = []
        for joint in generator.permutation(machine.num_joints):
            waves = self._waves(steps, machine.period_s, generator)
            name, u = move_joint("sine", machine, joint, waves)
            found.append(Segment(name, machine.home, u, "home", self.stop_margin))
        return found

    def _waves(self, steps: int, period_s: float, generator: Generator) -> np.ndarray:
        """Return full waves end to end, `(T,)`; each begins at a command of zero."""
        u, at = np.zeros(steps), 0
        shortest = max(2, round(1.0 / self.highest_hz / period_s))
        while steps - at >= shortest:
            hz = np.exp(generator.uniform(np.log(self.lowest_hz), np.log(self.highest_hz)))
            # A sine may begin in either direction.
            amplitude = generator.uniform(self.smallest, self.largest)
            amplitude *= generator.choice([-1.0, 1.0])
            count = min(max(round(1.0 / hz / period_s), shortest), steps - at)
            u[at : at + count] = amplitude * np.sin(2.0 * np.pi * np.arange(count) / count)
            at += count
        return u
