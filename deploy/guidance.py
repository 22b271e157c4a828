"""From commands to lever positions that a person can follow, and back (paper, equations 2 and 3).

A lever angle is the joint's command times the angle at full command. Which joint hangs on which
axis is the machine's business (`machine.levers`) or that of a pattern here; a joint that is never
moved together with others shares an axis and needs the button of that lever held. What is shown
changes no faster than a hand can, and an axis passes through neutral before the button changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Lever, Machine
from brokk_rl.spec import spec

AXES = (("left", "theta"), ("left", "psi"), ("right", "theta"), ("right", "psi"))
"""Order of the four axes everywhere in this room."""


@dataclass(frozen=True)
class LeverPositions:
    """Positions of both levers, of full, in [-1, 1]: theta fore and aft, psi sideways; and whether the right button is held."""

    left_theta: float
    left_psi: float
    right_theta: float
    right_psi: float
    button_right: bool


@dataclass(frozen=True)
class LeverAngles:
    """Positions of both levers as angles; else as `Levers`."""

    left_theta_rad: float
    left_psi_rad: float
    right_theta_rad: float
    right_psi_rad: float
    button_right: bool

    def parts(self, full_rad: tuple[float, ...]) -> LeverPositions:
        """Returns them as parts of `full_rad`, the angle at full deflection of each of the four `AXES`."""
        parts = (angle / full for angle, full in zip(self.angles_rad, full_rad, strict=True))
        return LeverPositions(*parts, button_right=self.button_right)

    @property
    def angles_rad(self) -> tuple[float, ...]:
        """Angles of the four `AXES`."""
        return self.left_theta_rad, self.left_psi_rad, self.right_theta_rad, self.right_psi_rad


@spec
class LeverGuidance:
    """How commands are shown as lever positions.

    Attributes:
        levers: Axis of each joint; `null` for those of the machine.
        dead_zone: Deflection, of full, that is shown as neutral: hands cannot hold less.
        max_rate_rad_s: Fastest change of what is shown.
    """

    levers: tuple[Lever, ...] | None
    dead_zone: float
    max_rate_rad_s: float

    def check(self) -> None:
        if not 0 <= self.dead_zone < 1 or self.max_rate_rad_s <= 0:
            raise ConfigError(
                "guidance: expected dead_zone in [0, 1) and max_rate_rad_s of more than 0"
            )


def find_full_angles_rad(levers: Sequence[Lever]) -> tuple[float, ...]:
    """Returns the angle at full deflection of each of the four `AXES`; 1 where no joint hangs on it."""
    return tuple(
        max((one.max_angle_rad for one in levers if (one.side, one.axis) == axis), default=1.0)
        for axis in AXES
    )


class LeverMap:
    """The bare mapping between commands and levers.

    Args:
        levers: Axis of each joint.
        machine: The machine.

    Raises:
        ConfigError: a joint has no axis, or two that may move together share one.
    """

    def __init__(self, levers: tuple[Lever, ...], machine: Machine) -> None:
        names = machine.joint_names
        for lever in levers:
            if lever.joint not in names:
                raise ConfigError(
                    f"guidance: machine '{machine.name}' has no joint '{lever.joint}'; {list_choices(lever.joint, names)}"
                )
        by_joint = {lever.joint: lever for lever in levers}
        if missing := [name for name in names if name not in by_joint]:
            raise ConfigError(
                f"guidance: no lever for {', '.join(missing)}; add it to guidance.levers or to the machine's file"
            )
        self._axis = np.array(
            [AXES.index((by_joint[name].side, by_joint[name].axis)) for name in names]
        )
        self.full_rad = np.array([by_joint[name].max_angle_rad for name in names])
        """Lever angle at full command, `(J,)`."""
        self._exclusive = machine.is_exclusive
        shared = [int(axis) for axis in self._axis[~self._exclusive]]
        if len(set(shared)) != len(shared):
            raise ConfigError("guidance: two joints that may move together share a lever's axis")

    def levers(self, u: np.ndarray) -> tuple[np.ndarray, bool]:
        """Returns the angles of the four `AXES` in rad, and whether the button is held, for commands `(J,)`."""
        angles, button = np.zeros(len(AXES)), bool((u[self._exclusive] != 0).any())
        for j in np.flatnonzero(self._exclusive == button):
            angles[self._axis[j]] = u[j] * self.full_rad[j]
        return angles, button

    def command(self, angles_rad: np.ndarray, button: bool) -> np.ndarray:
        """Returns the commands, `(J,)` in [-1, 1], that levers in these positions give."""
        u = np.where(self._exclusive == button, angles_rad[self._axis] / self.full_rad, 0.0)
        return u.clip(-1.0, 1.0)


@dataclass(frozen=True)
class DisplayedLevers:
    """Lever positions to show: angles of the four `AXES` in rad, and whether the right button is to be held."""

    angles_rad: np.ndarray
    button_right: bool


class LeverDisplay:
    """What is shown, period by period.

    Args:
        guidance: How.
        machine: The machine.
    """

    def __init__(self, guidance: LeverGuidance, machine: Machine) -> None:
        self._guidance = guidance
        self.map = LeverMap(guidance.levers or machine.levers, machine)
        self._angles_rad, self._button = np.zeros(len(AXES)), False

    def show(self, u: np.ndarray, period_s: float) -> DisplayedLevers:
        """Returns what to show for commands `(J,)`, one period after what was shown last."""
        wanted = np.where(np.abs(u) < self._guidance.dead_zone, 0.0, u)
        angles_rad, button = self.map.levers(wanted)
        moves = bool(wanted.any())
        changes = moves and button != self._button
        if changes and self._angles_rad.any():  # through neutral first
            angles_rad = np.zeros_like(angles_rad)
        elif moves:
            self._button = button
        step = self._guidance.max_rate_rad_s * period_s
        self._angles_rad = self._angles_rad + np.clip(angles_rad - self._angles_rad, -step, step)
        return DisplayedLevers(self._angles_rad.copy(), self._button)
