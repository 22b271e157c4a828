"""A make with open-centre throttle valves: speed settles to a static balance, loads count most at small openings.

No pressures and no inertia: the answer is of first order, solved exactly over each time step. Units
as in `chambers`.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.anatomy import Anatomy


class Throttled:
    """Speed of each joint; exponential steps."""

    dt_s = 0.01

    def __init__(self, numbers: Anatomy, machine: Machine) -> None:
        self._n = numbers
        self.speed = np.zeros(numbers["notch"].shape)
        self._sink = numbers["leak"] / machine.max_speed
        self._keep = np.exp(-self.dt_s / numbers["answer_s"])

    def begin(self, load: np.ndarray) -> None:
        """Does nothing: there is no pressure to build up."""

    def step(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Returns the speeds after a time step, of `max_speed`; see `chambers` for the arguments."""
        grip = 0.5 * self._n["sensitivity"] / (0.4 + 0.6 * np.minimum(np.abs(opening), 1.0))
        settled = (
            opening * np.clip(1.0 + grip * np.sign(opening) * load, 0.2, 1.8) + self._sink * load
        )
        self.speed = settled + (self.speed - settled) * self._keep
        return self.speed

    def stopped(self, where: np.ndarray) -> None:
        """Takes the speed from joints at their stops, `(N, J)` bool."""
        self.speed = np.where(where, 0.0, self.speed)
