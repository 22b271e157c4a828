"""A make with two chamber pressures a cylinder: orifices in and out, a partial compensator, compressible oil.

Units: pressure over supply pressure, speed over the machine's `max_speed`, force over supply
pressure times bore area.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.anatomy import TAU_HZ, Anatomy
from exam.plants.friction import rubbing

FORCE_RATIO = 1.4
"""Force at supply pressure over the machine's yield force."""
ROD = 0.75
"""Area of the rod side over that of the bore."""
BACK = 0.45
"""Pressure in the emptying chamber at full speed without load: what keeps a falling load from
running away."""
PRIMED = 0.40
"""Pressure on the rod side of a machine that has just stopped."""
DROP_OUT, DROP_IN = 1.0 - ROD * BACK, 1.0 - BACK
"""Pressure over the inlet at full speed without load, extending and retracting."""


class Chambers:
    """Chamber pressures and speeds; semi-implicit Euler."""

    dt_s = 0.0025

    def __init__(self, numbers: Anatomy, machine: Machine) -> None:
        self._n = numbers
        shape = numbers["notch"].shape
        self.speed = np.zeros(shape)
        self._bore, self._rod = np.zeros(shape), np.zeros(shape)
        self._loose_out, self._loose_in = (
            np.clip(wanted * drop / (1.0 - wanted * (1.0 - drop)), 0.0, 1.0)
            for wanted, drop in (
                (numbers["sensitivity"] * FORCE_RATIO, DROP_OUT),
                (numbers["sensitivity"] * FORCE_RATIO * ROD, DROP_IN),
            )
        )
        # two springs in a row: the oil column and, where it is soft, the hose
        own_s = 1.0 / numbers["mode_hz"]
        mode_hz = 1.0 / np.hypot(own_s, numbers["soft_s"])
        hose = (numbers["soft_s"] * mode_hz) ** 2  # share of the compliance
        force = FORCE_RATIO * np.array([body.yield_force.value for body in machine.bodies])
        inertia = (
            np.array([body.stiffness.value for body in machine.bodies]) / TAU_HZ**2 / 36.0
        )  # first mode at 6 Hz
        self._push = force / (inertia * machine.max_speed)  # 1/s
        self._stiff = (TAU_HZ * mode_hz) ** 2 / self._push / (1.0 + ROD)  # 1/s
        # what is soft rings with its own damping, and what rubs less lets it
        ringing = 2.0 * numbers["soft_damping"] * TAU_HZ * mode_hz / self._push
        self._friction = numbers["friction"] * (1.0 - 0.7 * hose)
        self._viscous = numbers["viscous"] + hose * (
            np.minimum(ringing, numbers["viscous"]) - numbers["viscous"]
        )
        self._leak = numbers["leak"] / machine.max_speed

    def begin(self, load: np.ndarray) -> None:
        """Lets the cylinders of resting joints bear their load, `(N, J)`."""
        self._rod = np.clip(np.full_like(load, PRIMED) + load / FORCE_RATIO / ROD, PRIMED, 1.0)
        self._bore = ROD * self._rod - load / FORCE_RATIO

    def step(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Returns the speeds after a time step, of `max_speed`.

        Args:
            opening: Signed flow asked for, of that at full speed, `(N, J)`.
            load: Weight in the positive direction over yield force, `(N, J)`.
        """
        dt_s, area, out = self.dt_s, np.abs(opening), opening > 0
        bore, rod = self._bore, self._rod
        # the compensator keeps the drop over the inlet, as far as it is not loose
        head_out = 1.0 + self._loose_out * ((1.0 - bore) / DROP_OUT - 1.0)
        head_in = 1.0 + self._loose_in * ((1.0 - rod) / DROP_IN - 1.0)
        inlet = area * np.sqrt(np.maximum(np.where(out, head_out, head_in), 0.0))
        outlet = area * np.sqrt(np.maximum(np.where(out, rod, bore / ROD), 0.0) / BACK)
        lost = -self._leak * load  # what the weight presses through the closed valve
        into_bore = np.where(out, inlet, -outlet) - lost
        from_rod = np.where(out, outlet, -inlet) + lost  # at the scale of the bore's speed
        speed = self.speed
        bore = np.clip(bore + dt_s * self._stiff * (into_bore - speed), 0.0, 1.0)
        rod = np.clip(rod + dt_s * self._stiff * (speed - from_rod), 0.0, 1.0)
        force = bore - ROD * rod + load / FORCE_RATIO
        drag = dt_s * self._push
        speed = (speed + drag * force) / (
            1.0 + drag * rubbing(speed, self._friction, self._viscous)
        )
        self._bore, self._rod, self.speed = bore, rod, speed
        return speed

    def stopped(self, where: np.ndarray) -> None:
        """Takes the speed from joints at their stops, `(N, J)` bool."""
        self.speed = np.where(where, 0.0, self.speed)
