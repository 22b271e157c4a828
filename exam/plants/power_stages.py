"""Power stages of the plants, from valve opening to speed: three makes.

`TwoChamberCylinders`: two chamber pressures a cylinder, orifices in and out, a partial compensator,
compressible oil. `CompensatedValves`: flow follows the opening, the pump starves the heaviest
joint,
one oil column a joint. `ThrottleValves`: open-centre valves; speed settles to a static balance of
first order, and loads count most at small openings.

Units: pressure over supply pressure, speed over the machine's `max_speed`, force over supply
pressure times bore area.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.plant_parameters import RAD_PER_CYCLE, PlantParameters

SMOOTHING_SPEED = 0.015
"""Speed, of full speed, below which friction grows with speed: no chatter at the time steps
used."""


def compute_friction(speed: np.ndarray, dry: np.ndarray, viscous: np.ndarray) -> np.ndarray:
    """Return friction force over speed: a dry part that is smooth through zero, and a viscous one."""
    return dry / np.sqrt(speed * speed + SMOOTHING_SPEED * SMOOTHING_SPEED) + viscous


class PowerStage:
    """Base of the three makes: inertia of the joints, leak and stops.

    Args:
        numbers: The machine's, `(N, J)`.
        machine: Full speeds, yield forces, stiffness.
        force_ratio: Force at supply pressure over the machine's yield force.
    """

    dt_s: float

    def __init__(
        self, numbers: PlantParameters, machine: Machine, force_ratio: float = 1.0
    ) -> None:
        self._n, self._leak = numbers, numbers["leak"] / machine.max_speed
        self.speed = np.zeros(numbers["notch"].shape)
        force = force_ratio * np.array([body.yield_force.value for body in machine.bodies])
        stiffness = np.array([body.stiffness.value for body in machine.bodies])
        inertia = stiffness / RAD_PER_CYCLE**2 / 36.0  # first mode at 6 Hz
        self._push = force / (inertia * machine.max_speed)  # 1/s

    def begin(self, load: np.ndarray) -> None:
        """Let the cylinders of resting joints bear their load, `(N, J)`."""

    def step(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Return the speeds after a time step, of `max_speed`.

        Args:
            opening: Signed flow asked for, of that at full speed, `(N, J)`.
            load: Weight in the positive direction over yield force, `(N, J)`.
        """
        raise NotImplementedError

    def stopped(self, where: np.ndarray) -> None:
        """Take the speed from joints at their stops, `(N, J)` bool."""
        self.speed = np.where(where, 0.0, self.speed)


CHAMBER_FORCE_RATIO = 1.4
"""Force at supply pressure over the machine's yield force."""
ROD_AREA = 0.75
"""Area of the rod side over that of the bore."""
BACK_PRESSURE = 0.45
"""Pressure in the emptying chamber at full speed without load; it keeps a falling load from running
away."""
REST_PRESSURE = 0.40
"""Pressure on the rod side of a machine that has just stopped."""
DROP_OUT, DROP_IN = 1.0 - ROD_AREA * BACK_PRESSURE, 1.0 - BACK_PRESSURE
"""Pressure over the inlet at full speed without load, extending and retracting."""


class TwoChamberCylinders(PowerStage):
    """Chamber pressures and speeds; semi-implicit Euler."""

    dt_s = 0.0025

    def __init__(self, numbers: PlantParameters, machine: Machine) -> None:
        super().__init__(numbers, machine, CHAMBER_FORCE_RATIO)
        self._bore, self._rod = np.zeros_like(self.speed), np.zeros_like(self.speed)
        self._loose_out, self._loose_in = (
            np.clip(wanted * drop / (1.0 - wanted * (1.0 - drop)), 0.0, 1.0)
            for wanted, drop in (
                (numbers["sensitivity"] * CHAMBER_FORCE_RATIO, DROP_OUT),
                (numbers["sensitivity"] * CHAMBER_FORCE_RATIO * ROD_AREA, DROP_IN),
            )
        )
        # two springs in a row: the oil column and, where it is soft, the hose
        own_s = 1.0 / numbers["mode_hz"]
        mode_hz = 1.0 / np.hypot(own_s, numbers["soft_s"])
        hose = (numbers["soft_s"] * mode_hz) ** 2  # share of the compliance
        self._stiff = (RAD_PER_CYCLE * mode_hz) ** 2 / self._push / (1.0 + ROD_AREA)  # 1/s
        # a soft hose rings with its own damping, and lower friction allows it
        ringing = 2.0 * numbers["soft_damping"] * RAD_PER_CYCLE * mode_hz / self._push
        self._friction = numbers["friction"] * (1.0 - 0.7 * hose)
        self._viscous = numbers["viscous"] + hose * (
            np.minimum(ringing, numbers["viscous"]) - numbers["viscous"]
        )

    def begin(self, load: np.ndarray) -> None:
        """Let the cylinders of resting joints bear their load, `(N, J)`."""
        self._rod = np.clip(
            np.full_like(load, REST_PRESSURE) + load / CHAMBER_FORCE_RATIO / ROD_AREA,
            REST_PRESSURE,
            1.0,
        )
        self._bore = ROD_AREA * self._rod - load / CHAMBER_FORCE_RATIO

    def step(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """See `PowerStage.step`."""
        dt_s, area, out = self.dt_s, np.abs(opening), opening > 0
        bore, rod = self._bore, self._rod
        # the compensator keeps the drop over the inlet, as far as it is not loose
        head_out = 1.0 + self._loose_out * ((1.0 - bore) / DROP_OUT - 1.0)
        head_in = 1.0 + self._loose_in * ((1.0 - rod) / DROP_IN - 1.0)
        inlet = area * np.sqrt(np.maximum(np.where(out, head_out, head_in), 0.0))
        outlet = area * np.sqrt(
            np.maximum(np.where(out, rod, bore / ROD_AREA), 0.0) / BACK_PRESSURE
        )
        lost = -self._leak * load  # leak through the closed valve by the weight
        into_bore = np.where(out, inlet, -outlet) - lost
        from_rod = np.where(out, outlet, -inlet) + lost  # at the scale of the bore's speed
        speed = self.speed
        bore = np.clip(bore + dt_s * self._stiff * (into_bore - speed), 0.0, 1.0)
        rod = np.clip(rod + dt_s * self._stiff * (speed - from_rod), 0.0, 1.0)
        force = bore - ROD_AREA * rod + load / CHAMBER_FORCE_RATIO
        drag = dt_s * self._push
        speed = (speed + drag * force) / (
            1.0 + drag * compute_friction(speed, self._friction, self._viscous)
        )
        self._bore, self._rod, self.speed = bore, rod, speed
        return speed


COMPENSATED_FORCE_RATIO = 1.6
"""Force at supply pressure over the machine's yield force."""


class CompensatedValves(PowerStage):
    """Force of the oil column and speed of each joint; Heun's method."""

    dt_s = 0.005

    def __init__(self, numbers: PlantParameters, machine: Machine) -> None:
        super().__init__(numbers, machine, COMPENSATED_FORCE_RATIO)
        self._force = np.zeros_like(self.speed)
        self._stiff = (RAD_PER_CYCLE * numbers["mode_hz"]) ** 2 / self._push

    def begin(self, load: np.ndarray) -> None:
        """Let the cylinders of resting joints bear their load, `(N, J)`."""
        self._force = -load / COMPENSATED_FORCE_RATIO

    def step(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """See `PowerStage.step`."""
        n, dt_s = self._n, self.dt_s
        # the compensator's spring gives: flow falls in proportion to the load it works against
        flow = opening * np.clip(1.0 + 0.5 * n["sensitivity"] * np.sign(opening) * load, 0.2, 1.8)

        def slope(force: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            pull = (
                force
                + load / COMPENSATED_FORCE_RATIO
                - compute_friction(speed, n["friction"], n["viscous"]) * speed
            )
            return self._stiff * (flow + self._leak * load - speed), self._push * pull

        force_1, speed_1 = slope(self._force, self.speed)
        force_2, speed_2 = slope(self._force + dt_s * force_1, self.speed + dt_s * speed_1)
        self._force = np.clip(self._force + 0.5 * dt_s * (force_1 + force_2), -1.0, 1.0)
        self.speed = self.speed + 0.5 * dt_s * (speed_1 + speed_2)
        return self.speed


class ThrottleValves(PowerStage):
    """Speed of each joint; exponential steps."""

    dt_s = 0.01

    def __init__(self, numbers: PlantParameters, machine: Machine) -> None:
        super().__init__(numbers, machine)
        self._keep = np.exp(-self.dt_s / numbers["answer_s"])

    def step(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """See `PowerStage.step`."""
        grip = 0.5 * self._n["sensitivity"] / (0.4 + 0.6 * np.minimum(np.abs(opening), 1.0))
        settled = (
            opening * np.clip(1.0 + grip * np.sign(opening) * load, 0.2, 1.8) + self._leak * load
        )
        self.speed = settled + (self.speed - settled) * self._keep
        return self.speed
