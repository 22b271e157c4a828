"""A make with a compensated valve: flow goes by opening, the pump starves the heaviest joint, one oil column a joint.

Units as in `chambers`: speed over `max_speed`, force over that at supply pressure.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.anatomy import TAU_HZ, Anatomy
from exam.plants.friction import rubbing

FORCE_RATIO = 1.6
"""Force at supply pressure over the machine's yield force."""


class Compensated:
    """Force of the oil column and speed of each joint; Heun's method."""

    dt_s = 0.005

    def __init__(self, numbers: Anatomy, machine: Machine) -> None:
        self._n = numbers
        shape = numbers["notch"].shape
        self.speed, self._force = np.zeros(shape), np.zeros(shape)
        force = FORCE_RATIO * np.array([body.yield_force.value for body in machine.bodies])
        inertia = np.array([body.stiffness.value for body in machine.bodies]) / TAU_HZ**2 / 36.0
        self._push = force / (inertia * machine.max_speed)
        self._stiff = (TAU_HZ * numbers["mode_hz"]) ** 2 / self._push
        self._leak = numbers["leak"] / machine.max_speed

    def begin(self, load: np.ndarray) -> None:
        """Lets the cylinders of resting joints bear their load, `(N, J)`."""
        self._force = -load / FORCE_RATIO

    def step(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Returns the speeds after a time step, of `max_speed`; see `chambers` for the arguments."""
        n, dt_s = self._n, self.dt_s
        # the compensator's spring gives: flow falls in proportion to the load it works against
        flow = opening * np.clip(1.0 + 0.5 * n["sensitivity"] * np.sign(opening) * load, 0.2, 1.8)

        def slope(force: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            pull = force + load / FORCE_RATIO - rubbing(speed, n["friction"], n["viscous"]) * speed
            return self._stiff * (flow + self._leak * load - speed), self._push * pull

        force_1, speed_1 = slope(self._force, self.speed)
        force_2, speed_2 = slope(self._force + dt_s * force_1, self.speed + dt_s * speed_1)
        self._force = np.clip(self._force + 0.5 * dt_s * (force_1 + force_2), -1.0, 1.0)
        self.speed = self.speed + 0.5 * dt_s * (speed_1 + speed_2)
        return self.speed

    def stopped(self, where: np.ndarray) -> None:
        """Takes the speed from joints at their stops, `(N, J)` bool."""
        self.speed = np.where(where, 0.0, self.speed)
