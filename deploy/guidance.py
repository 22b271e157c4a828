"""Lever positions for commands, and back (paper, equations 2 and 3).

A lever angle is the joint's command times the angle at full command. The machine (`machine.levers`)
or a pattern here assigns each joint to an axis. A joint that is never moved together with others
shares an axis and needs the button of that lever held. The displayed positions change no faster
than a hand can, and an axis passes through neutral before the button changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec

AXES = (("left", "theta"), ("left", "psi"), ("right", "theta"), ("right", "psi"))
"""Order of the four axes everywhere in `deploy`."""


@dataclass(frozen=True)
class LeverPositions:
    """Positions of both levers, of full, in [-1, 1], and whether the right button is held.

    Theta is fore and aft, psi sideways.
    """

    left_theta: float
    left_psi: float
    right_theta: float
    right_psi: float
    button_right: bool


@dataclass(frozen=True)
class LeverAngles:
    """Lever angles of the four `AXES` in rad, and whether the right button is to be held."""

    angles_rad: np.ndarray
    button_right: bool


@spec
class LeverGuidance:
    """Mapping and pace of the displayed lever positions.

    Attributes:
        dead_zone: Deflection, of full, below which neutral is displayed: a hand cannot hold less.
        max_rate_rad_s: Fastest change of the displayed angle.
    """

    dead_zone: Annotated[float, Interval(ge=0, lt=1)]
    max_rate_rad_s: Positive


class LeverMap:
    """Mapping between commands and levers.

    Args:
        machine: The machine, with the axis of each joint.

    Raises:
        ConfigError: a joint has no axis, or two that may move together share one.
    """

    def __init__(self, machine: Machine) -> None:
        names = machine.joint_names
        by_joint = {lever.joint: lever for lever in machine.levers}
        if missing := [name for name in names if name not in by_joint]:
            raise ConfigError(f"guidance: no lever for {', '.join(missing)} in the machine's file")
        levers = [by_joint[name] for name in names]
        self._axis = np.array([AXES.index((lever.side, lever.axis)) for lever in levers])
        self.full_rad = np.array([lever.max_angle_rad for lever in levers])
        """Lever angle at full command, `(J,)`."""
        self.axis_full_rad = np.ones(len(AXES))
        """Lever angle at full deflection of each of the four `AXES`; 1 without a joint."""
        for axis in set(self._axis.tolist()):
            self.axis_full_rad[axis] = self.full_rad[self._axis == axis].max()
        self._exclusive = machine.is_exclusive
        shared = [int(axis) for axis in self._axis[~self._exclusive]]
        if len(set(shared)) != len(shared):
            raise ConfigError("guidance: two joints that may move together share a lever's axis")

    def levers(self, u: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the angles of the four `AXES` in rad, and the button, for commands `(J,)`."""
        angles = np.zeros(len(AXES))
        button = bool((u[self._exclusive] != 0).any())
        for j in np.flatnonzero(self._exclusive == button):
            angles[self._axis[j]] = u[j] * self.full_rad[j]
        return angles, button

    def read_positions(self, angles_rad: np.ndarray, button: bool) -> LeverPositions:
        """Return angles of the four `AXES`, `(4,)`, as parts of those at full deflection."""
        return LeverPositions(*(angles_rad / self.axis_full_rad).tolist(), button_right=button)

    def command(self, angles_rad: np.ndarray, button: bool) -> np.ndarray:
        """Return the commands, `(J,)` in [-1, 1], of levers at these angles."""
        u = np.where(self._exclusive == button, angles_rad[self._axis] / self.full_rad, 0.0)
        return u.clip(-1.0, 1.0)


class LeverDisplay:
    """Displayed lever positions, period by period.

    Args:
        guidance: Mapping and pace.
        machine: The machine.
    """

    def __init__(self, guidance: LeverGuidance, machine: Machine) -> None:
        self._guidance = guidance
        self.map = LeverMap(machine)
        self._angles_rad = np.zeros(len(AXES))
        self._button = False

    def show(self, u: np.ndarray, period_s: float) -> LeverAngles:
        """Return the angles to display for commands `(J,)`, one period after the last ones."""
        wanted = np.where(np.abs(u) < self._guidance.dead_zone, 0.0, u)
        angles_rad, button = self.map.levers(wanted)
        moves = bool(wanted.any())
        if moves and button != self._button and self._angles_rad.any():  # through neutral first
            angles_rad = np.zeros_like(angles_rad)
        elif moves:
            self._button = button
        step = self._guidance.max_rate_rad_s * period_s
        self._angles_rad = self._angles_rad + np.clip(angles_rad - self._angles_rad, -step, step)
        return LeverAngles(self._angles_rad.copy(), self._button)


class HandLag:
    """Lag and dead zone of the hand that a policy counts on, where nobody moves the levers.

    The same as `follower=filter`, without torch: the commands of a policy that learned behind a
    person swing from sample to sample, and a hand smooths them.

    Args:
        advice: `advice` of the policy's contract.
        machine: The machine.
    """

    def __init__(self, advice: dict[str, Any], machine: Machine) -> None:
        lag = max(float(np.mean(advice["lag_s"])) / machine.period_s, 1e-6)  # 0 would divide
        self._dead_zone = float(np.mean(advice["dead_zone"]))
        self._exclusive = machine.is_exclusive
        self._left = math.exp(-1.0 / lag)
        self._mean = lag * (1.0 - self._left)
        self._hand = np.zeros(machine.num_joints)

    def give(self, u: np.ndarray, guiding: bool) -> np.ndarray:
        """Return the mean command, `(J,)`, of a period in which the hand moves towards `u`.

        Without advice (`guiding` false, `u` zero) it lets go at once.
        """
        asked = np.abs(u) + 1e-6 * np.abs(self._hand)
        alone = asked[self._exclusive].max(initial=0.0) > asked[~self._exclusive].max(initial=0.0)
        held = self._exclusive == alone
        away = (self._hand - u) * guiding
        self._hand = np.where(held, u + away * self._left, 0.0)
        deflection = np.where(held, u + away * self._mean, 0.0)
        opened = (np.abs(deflection) - self._dead_zone).clip(min=0.0) / (1.0 - self._dead_zone)
        return np.copysign(opened, deflection)
