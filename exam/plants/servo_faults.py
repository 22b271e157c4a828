"""Faults of an arm of position servos: effects as changes of its numbers, and causes outside the library.

Each cause has a severity by joint: 1 plainly, 0 not at all.

wind_up         the firmware has an integral term that winds up: the joint overshoots and hunts
heat            the motor's torque falls as it works, and recovers in pauses
bad_tooth       a sector of the gear in which the joint goes hard
overload_trip   after some tenths of a second at high duty the servo lets go for a while
weak_side       the motor pulls less one way than the other
cross_talk      the joint follows a part of the next joint's target
feed_forward    the firmware adds the target's speed to the target: the joint overshoots
warm_delay      commands come later and later as the machine runs
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.changes import FaultSizes, PlantParameters, read_faults
from exam.plants.servo_drive import STEP_S

COUNT_RAD = 2.0 * np.pi / 4096
"""Step of the servos' encoder: twelve bits over a turn."""


def _add_backlash(n: PlantParameters, size: FaultSizes) -> None:
    """Add friction that the loop's stiffness does not overcome within half the gap.

    The encoder sits behind the gear: play before it leaves no error at rest, friction does.
    """
    n["added_friction_n_m"] = n["added_friction_n_m"] + 0.5 * n["stiffness"] * size["gap_rad"]


def _add_sag(n: PlantParameters, size: FaultSizes) -> None:
    """Add the pull of a cable that bends the loop by the sag in the middle of the travel."""
    n["pull_n_m"] = n["pull_n_m"] - n["stiffness"] * size["sag_rad"]


def _add_joint_friction(n: PlantParameters, size: FaultSizes) -> None:
    n["added_friction_n_m"] = n["added_friction_n_m"] + size["part"] * n["full_n_m"]


def _add_joint_damping(n: PlantParameters, size: FaultSizes) -> None:
    n["added_viscous"] = n["added_viscous"] + size["part"] * n["full_n_m"] / n["full_rad_s"]


def _add_torque_limit(n: PlantParameters, size: FaultSizes) -> None:
    """Cap the motor's duty, as firmware does: back EMF and its own damping lie within the cap."""
    limit_n_m = n["full_n_m"] / np.maximum(size["shortage"], 1e-9)
    n["duty_cap"] = np.minimum(n["duty_cap"], limit_n_m / n["stall_n_m"])


NEUTRAL, FAULTS = read_faults("servos")
NEUTRAL["step_rad"] = COUNT_RAD
FAULTS |= {
    "backlash": _add_backlash,
    "sag": _add_sag,
    "torque_limit": _add_torque_limit,
    "joint_friction": _add_joint_friction,
    "joint_damping": _add_joint_damping,
}

CAUSES = (
    "wind_up", "heat", "bad_tooth", "overload_trip", "weak_side", "cross_talk", "feed_forward", "warm_delay",
)  # fmt: skip

# Sizes at severity 1, chosen by hand so that each shows plainly in the motion.
WIND_S, WIND_RAD = 0.2, 0.08
HEAT_LOSS, HEAT_S, WORK = 0.7, 15.0, 0.15
TOOTH_N_M, TOOTH_TRAVEL = 0.6, 0.12
TRIP_DUTY, TRIP_S, AWAY_S = 0.35, 0.2, 0.8
SIDE_LOSS = 0.7
LEAK = 0.25
LEAD_S = 0.15
WARM_S, WARMING_S = 0.12, 400.0


class ServoCauses:
    """The causes of several runs side by side.

    Args:
        machine: Limits and period.
        severity: Of each cause, `(N, J)`.
    """

    def __init__(self, machine: Machine, severity: Mapping[str, np.ndarray]) -> None:
        self._period_s, self._lower = machine.period_s, machine.lower
        self._travel = machine.upper - machine.lower
        self._of = severity
        none = np.zeros_like(severity["heat"])
        self._heat, self._strained_s, self._away_s = none.copy(), none.copy(), none.copy()
        self._wound_rad = none.copy()
        self._before: np.ndarray | None = None

    def command(self, u: np.ndarray) -> np.ndarray:
        """Return the commands that reach the servos, `(N, J)`, once a control period."""
        u = u + LEAK * self._of["cross_talk"] * (np.roll(u, -1, axis=1) - u)
        before = u if self._before is None else self._before
        self._before = u
        return u + LEAD_S / self._period_s * self._of["feed_forward"] * (u - before)

    def target(self, target: np.ndarray, reading: np.ndarray) -> np.ndarray:
        """Return the targets that the proportional loop sees, `(N, J)`, rad, once a time step."""
        size = self._of["wind_up"]
        wound = self._wound_rad + STEP_S / WIND_S * size * (target - reading)
        self._wound_rad = np.clip(wound, -WIND_RAD * size, WIND_RAD * size)
        return target + self._wound_rad

    def delay_s(self, t_s: np.ndarray) -> np.ndarray:
        """Return the extra delay of a frame, `(N, J)`, after a running time of `t_s`, `(N,)`."""
        return WARM_S * self._of["warm_delay"] * (1.0 - np.exp(-t_s / WARMING_S))[:, None]

    def cap(self, duty: np.ndarray) -> np.ndarray:
        """Return the largest duties of the coming step, `(N, J)`, after duties of the last one."""
        work = np.minimum(np.abs(duty) / WORK, 1.0)
        self._heat += (work - self._heat) * STEP_S / HEAT_S
        cap = np.ones_like(duty)
        size = self._of["overload_trip"]
        if size.any():
            self._strained_s = np.where(np.abs(duty) > TRIP_DUTY, self._strained_s + STEP_S, 0.0)
            trips = (self._strained_s > TRIP_S) & (size > 0)
            self._away_s = np.where(trips, AWAY_S * size, self._away_s - STEP_S)
            cap = np.where(self._away_s > 0, 0.0, cap)
        return cap

    def weaken(self, torque: np.ndarray) -> np.ndarray:
        """Return the torques of the motors, `(N, J)`: hot ones, and those with a weak side."""
        side = 1.0 - SIDE_LOSS * self._of["weak_side"] * (torque > 0)
        return torque * side * (1.0 - HEAT_LOSS * self._of["heat"] * self._heat)

    def friction_n_m(self, q: np.ndarray) -> np.ndarray:
        """Return further Coulomb friction at `q`, `(N, J)`."""
        place = (q - self._lower) / self._travel
        sector = np.exp(-np.square((place - 0.5) / TOOTH_TRAVEL))
        return TOOTH_N_M * self._of["bad_tooth"] * sector
