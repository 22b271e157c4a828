"""Drive of a position servo: firmware, motor and friction, for `N` runs of `J` joints.

Sources: Canudas de Wit, Olsson, Astrom and Lischinsky, IEEE Trans. Automatic Control 40 (1995) 419
(LuGre: bristles with a Stribeck curve). Duclusaud, Passault, Padois and Ly, ICRA 2025 (BAM: friction
that grows with the torque through the gear).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.changes import PlantParameters

STEP_S = 0.002
"""Time step, s; that of `so101_arm.xml`."""
BRISTLE_DAMPING = 0.3
"""Damping ratio of a joint that hangs on its bristles; chosen by hand."""
ROTOR_INERTIA = 0.02
"""Inertia that this ratio counts with, kg m^2: the armature of `so101_arm.xml`."""
SOFT_RAD_S = 0.02
"""Speed about which the smooth part of dry friction changes its sign; chosen by hand."""


class TargetFilter:
    """Targets as the firmware follows them: a bounded slope, then two equal first-order stages.

    Args:
        numbers: `stroke_s`, `filter_s`, each `(N, J)`; 0 switches either off.
        machine: The machine, whose travel targets span.
        q: Positions at the beginning, `(N, J)`.
    """

    def __init__(self, numbers: PlantParameters, machine: Machine, q: np.ndarray) -> None:
        self._middle = (machine.upper + machine.lower) / 2
        self._half = (machine.upper - machine.lower) / 2
        stroke_s = numbers["stroke_s"]
        limited = self._half * STEP_S / np.maximum(stroke_s, 1e-9)
        self._reach = np.where(stroke_s > 0, limited, np.inf)
        filter_s = 0.5 * numbers["filter_s"]  # of each stage
        kept = np.exp(-STEP_S / np.maximum(filter_s, 1e-9))
        self._share = 1.0 - np.where(filter_s > 0, kept, 0.0)
        self._slow = np.stack([q, q, q])

    def step(self, u: np.ndarray) -> np.ndarray:
        """Return the targets that the loop sees under commands `(N, J)`, rad."""
        slow = self._slow
        away = self._middle + self._half * u - slow[0]
        slow[0] += np.clip(away, -self._reach, self._reach)
        slow[1] += self._share * (slow[0] - slow[1])
        slow[2] += self._share * (slow[1] - slow[2])
        return slow[2]


class PositionLoop:
    """Loop on the encoder's reading; its duty feeds a motor with back EMF.

    Args:
        numbers: The arm's, each `(N, J)`.
    """

    def __init__(self, numbers: PlantParameters) -> None:
        self._n = numbers
        self._duty, self._count = np.zeros_like(numbers["stiffness"]), 0

    def step(
        self, target: np.ndarray, reading: np.ndarray, speed: np.ndarray, cap: np.ndarray
    ) -> np.ndarray:
        """Return the duties, `(N, J)`, at most `cap`.

        Args:
            target: Targets, `(N, J)`.
            reading: Readings of the encoders.
            speed: Speeds, rad/s.
            cap: Largest duties; 0 lets the joint go.
        """
        n = self._n
        error = target - reading
        half = 0.5 * n["dead_zone_rad"]
        error = np.sign(error) * np.maximum(np.abs(error) - half, 0.0)
        asked = (n["stiffness"] * error - n["firmware_damping"] * speed) / n["stall_n_m"]
        due = self._count % n["ticks"] == 0
        self._duty = np.clip(np.where(due, asked, self._duty), -cap, cap)
        self._count += 1
        return self._duty

    def torque(self, duty: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the torque of the motors, `(N, J)`, Nm: the voltage less the back EMF."""
        supply = 1.0 - self._n["supply_drop"] * np.abs(duty).sum(1, keepdims=True)
        return self._n["stall_n_m"] * (duty * supply - speed / self._n["no_load_rad_s"])


class BristleFriction:
    """LuGre: bristles bend up to a break-away torque, which falls with the speed.

    Args:
        numbers: The arm's, each `(N, J)`.
    """

    changes: Mapping[str, np.ndarray] = {}

    def __init__(self, numbers: PlantParameters) -> None:
        n = self._n = numbers
        self._own = n["coulomb_n_m"] + n["added_friction_n_m"]
        self._stiffness = self._own * n["static_ratio"] / n["presliding_rad"]
        self._damping = 2.0 * BRISTLE_DAMPING * np.sqrt(self._stiffness * ROTOR_INERTIA)
        self._bend = np.zeros_like(self._own)

    def torque(self, speed: np.ndarray, extra_n_m: np.ndarray) -> np.ndarray:
        """Return the torque against the motion, `(N, J)`, with this much more Coulomb friction.

        It is implicit in the bend, so that no speed makes it unstable.
        """
        n = self._n
        slow = np.exp(-np.square(speed / n["stribeck_rad_s"]))
        most = (self._own + extra_n_m) * (1.0 + (n["static_ratio"] - 1.0) * slow)
        slip = STEP_S * np.abs(speed) * self._stiffness / most
        bend = (self._bend + STEP_S * speed) / (1.0 + slip)
        growth, self._bend = (bend - self._bend) / STEP_S, bend
        return self._stiffness * bend + self._damping * growth


class DryFriction:
    """Dry friction that MuJoCo solves as a constraint, with a smooth Stribeck part beside it.

    Args:
        numbers: The arm's, each `(N, J)`.
    """

    def __init__(self, numbers: PlantParameters) -> None:
        self._n = numbers
        self._own = numbers["coulomb_n_m"] + numbers["added_friction_n_m"]

    @property
    def changes(self) -> Mapping[str, np.ndarray]:
        """Part of it that MuJoCo simulates: `friction` in Nm, as a full command is 1 Nm."""
        return {"friction": self._own}

    def torque(self, speed: np.ndarray, extra_n_m: np.ndarray) -> np.ndarray:
        """Return the torque against the motion, `(N, J)`, with this much more Coulomb friction."""
        n = self._n
        slow = np.exp(-np.square(speed / n["stribeck_rad_s"]))
        most = extra_n_m + self._own * (n["static_ratio"] - 1.0) * slow
        return most * np.tanh(speed / SOFT_RAD_S)


FRICTIONS = {"bristle": BristleFriction, "dry": DryFriction}
"""By make: bristles that bend before they slip, or dry friction of MuJoCo with a Stribeck part."""
