"""A gamepad of this computer, read through the joystick interface of Linux."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from brokk_rl.errors import ConfigError

EVENT = struct.Struct("IhBB")
"""`js_event` of Linux (`linux/joystick.h`): time in ms, value, kind, number."""
BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80
"""Kinds of a `js_event`: a button or an axis moved; the last is set too where the event only tells
the first state."""
FULL_SCALE = 32767.0
"""Value of an axis at its end."""
DEAD_ZONE = 0.12
"""Part of the travel of a stick that counts as centred. Chosen by hand."""


class Gamepad:
    """A gamepad; what has not moved yet is centred and not pressed.

    Args:
        path: Device, such as `/dev/input/js0`.
        option: Option that names the device, for the error.
        instead: What a person without a gamepad does, likewise.

    Attributes:
        connected: Whether it is still there.

    Raises:
        ConfigError: The device cannot be opened.
    """

    def __init__(self, path: Path, option: str, instead: str) -> None:
        self._values: dict[tuple[int, int], int] = {}  # by kind and number
        self._rest = b""
        self.connected = True
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ConfigError(
                f"{option}={path}: {error.strerror}. Plug the gamepad into this computer and "
                f"give its device (ls /dev/input/js*), or {instead}"
            ) from error

    def poll(self) -> bool:
        """Take in what has happened since; return whether anything has."""
        try:
            data = os.read(self._file, 64 * EVENT.size)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        # A device without an end has one when it is unplugged.
        self.connected = bool(data)
        self._rest += data
        whole = len(self._rest) // EVENT.size * EVENT.size
        events, self._rest = self._rest[:whole], self._rest[whole:]
        for _, value, kind, number in EVENT.iter_unpack(events):
            self._values[kind & ~INITIAL, number] = value
        return bool(events)

    def read_axes(self, axes: Sequence[int]) -> list[float]:
        """Return positions of axes, in [-1, 1], 0 within the dead zone.

        Args:
            axes: Their numbers; negative turns one round, and axis 0 cannot be turned.
        """
        found = []
        for axis in axes:
            sign = -1.0 if axis < 0 else 1.0
            value = sign * self._values.get((AXIS, abs(axis)), 0) / FULL_SCALE
            size = min(1.0, max(0.0, abs(value) - DEAD_ZONE) / (1.0 - DEAD_ZONE))
            found.append(size if value > 0 else -size)
        return found

    def is_pressed(self, button: int) -> bool:
        """Return whether a button is held."""
        return self._values.get((BUTTON, button), 0) != 0

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)
