"""Repeats of the same commands: their scatter is the noise floor of the machine."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from brokk_rl.contracts.actuator import Segment
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Count, spec


@spec
class Repeat:
    """All segments before it once more, with the commands really sent: the difference is noise.

    Attributes:
        times: How many repeats.
    """

    times: Count

    def weight(self, before: float) -> float:
        """Return as much as all before it have, for each repeat.

        Raises:
            ConfigError: there is nothing before it.
        """
        if before <= 0:
            raise ConfigError(
                "excitation=repeat: nothing before it to repeat; put it last: excitation=[levels,holds,repeat]"
            )
        return self.times * before

    def segments(
        self,
        machine: Machine,
        duration_s: float,
        generator: np.random.Generator,
        before: Sequence[Segment],
    ) -> list[Segment]:
        """Return the segments `before`, renamed; their length stays."""
        repeated = []
        for i, segment in product(range(1, self.times + 1), before):
            name, original = f"{segment.name}_repeat_{i}", segment.repeat_of or segment.name
            repeated.append(replace(segment, name=name, repeat_of=original))
        return repeated
