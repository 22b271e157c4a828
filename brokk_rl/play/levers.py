"""A person at the levers of one simulated machine: keys or a gamepad."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import torch

from brokk_rl.contracts.actuator import FollowerModel
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine, mask_exclusive_joints

KEY_STEP = 0.25
"""Stroke by which one press of a key moves a lever. Chosen by hand: four presses to full speed."""
EVENT = struct.Struct("IhBB")
"""`js_event` of Linux (`linux/joystick.h`): time in ms, value, kind, number."""
AXIS, INITIAL = 0x02, 0x80
"""Kinds of a `js_event`: an axis moved; set too where the event only tells the first state."""
FULL_SCALE = 32767.0
"""Value of an axis at its end."""
DEAD_ZONE = 0.12
"""Part of the travel of a gamepad's stick that counts as centred. Chosen by hand."""


class PersonAtLevers(FollowerModel):
    """Follower that gives a person's commands in one environment and the policy's in the others.

    Levers stay where they were put until they are released.

    Args:
        inner: Follower of the other environments.
        machine: The machine.

    Attributes:
        env: Environment that the person drives; `None` for none.
        levers: Positions of the levers, `(J,)` in [-1, 1].
        proposed: Last commands that the policy proposed, `(N, J)`.
    """

    def __init__(self, inner: FollowerModel, machine: Machine) -> None:
        self._inner = inner
        self._is_exclusive = torch.as_tensor(machine.is_exclusive)
        self.env: int | None = None
        self.levers = torch.zeros(machine.num_joints)
        self.proposed: torch.Tensor | None = None

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """State of the follower inside."""
        return self._inner.state

    def reset(self, mask: torch.Tensor) -> None:
        """Reset the follower inside; the person's levers stay."""
        self._inner.reset(mask)

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return the commands that are given, `(N, J)`, for those proposed."""
        self.proposed = proposed
        given = self._inner.step(proposed)
        if self.env is None:
            return given
        given = given.clone()
        given[self.env] = self.read_command().to(given.device)
        return given

    def read_command(self) -> torch.Tensor:
        """Return the person's command, `(J,)`: a lever of an exclusive joint rules out the others."""
        positioning = bool(self.levers[self._is_exclusive].any())
        return self.levers * mask_exclusive_joints(self._is_exclusive, positioning)


class Gamepad:
    """A gamepad of this computer, read through the joystick interface of Linux.

    Args:
        path: Device, such as `/dev/input/js0`.
        axes: Axis of the gamepad for each joint, in machine order; negative turns it round, and
            axis 0 cannot be turned.

    Raises:
        ConfigError: The device cannot be opened.
    """

    def __init__(self, path: Path, axes: tuple[int, ...]) -> None:
        self._axes = axes
        self._values: dict[int, float] = {}
        self._rest = b""
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ConfigError(
                f"play.gamepad={path}: {error.strerror}. Plug the gamepad into this computer and "
                "give its device (ls /dev/input/js*), or leave play.gamepad out and use the keys."
            ) from error

    def read(self) -> torch.Tensor | None:
        """Return positions of the levers, `(J,)`; `None` where no axis has moved since."""
        try:
            self._rest += os.read(self._file, 64 * EVENT.size)
        except BlockingIOError:
            return None
        whole = len(self._rest) // EVENT.size * EVENT.size
        events, self._rest = self._rest[:whole], self._rest[whole:]
        for _, value, kind, number in EVENT.iter_unpack(events):
            if kind & ~INITIAL == AXIS:
                self._values[number] = value / FULL_SCALE
        if not events:
            return None
        levers = []
        for axis in self._axes:
            value = self._values.get(abs(axis), 0.0) * (-1.0 if axis < 0 else 1.0)
            size = max(0.0, abs(value) - DEAD_ZONE) / (1.0 - DEAD_ZONE)
            levers.append(size if value > 0 else -size)
        return torch.tensor(levers).clamp(-1.0, 1.0)

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)
