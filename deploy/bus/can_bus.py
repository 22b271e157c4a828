"""Wires: how frames get onto a bus and off it, through python-can.

Only `recv` and `send` of python-can are used. Its `Notifier` dies silently of the first exception,
and its cyclic senders either die too or, in the kernel, go on repeating the last command while the
program hangs; nothing here uses them.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import can
from can.io.blf import BLFParseError, BLFReader

from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

BUS_OFF = 0x40
"""Bit of an error frame of Linux (CAN_ERR_BUSOFF)."""


@dataclass(frozen=True)
class CanFrame:
    """A frame as the bus carries it.

    Attributes:
        frame_id: Identifier.
        data: Data bytes.
        extended: Whether the identifier has 29 bits.
    """

    frame_id: int
    data: bytes
    extended: bool = True


@spec
class CanBus:
    """A bus that python-can reaches.

    Attributes:
        interface: `socketcan` for a machine, `udp_multicast` between processes, `virtual` within
            one.
        channel: Name of the interface (`can0`), or multicast group.
        bitrate: Bits per second, for adapters that are set by the program; `null` where the system
            sets it (socketcan).
        port: Port of `udp_multicast`; `null` elsewhere.
    """

    interface: Literal["socketcan", "udp_multicast", "virtual"]
    channel: str
    bitrate: int | None
    port: int | None

    def open(self, frame_ids: Sequence[int] | None = None) -> OpenCanBus:
        """Opens the bus.

        Args:
            frame_ids: Only these are received; the kernel leaves out others where it can. `None`:
                all.

        Raises:
            LinkError: there is no such bus.
        """
        options = {"bitrate": self.bitrate, "port": self.port}
        options = {key: value for key, value in options.items() if value is not None}
        if self.interface != "socketcan":
            options["fd"] = False
        if self.interface == "virtual":
            options.pop("fd")
            options["rx_queue_size"] = 1000  # else its memory grows without end when nobody reads
        try:
            bus = can.Bus(interface=self.interface, channel=self.channel, **options)  # type: ignore[arg-type]
            if frame_ids is not None:
                bus.set_filters(
                    [
                        {"can_id": one, "can_mask": 0x1FFFFFFF, "extended": one > 0x7FF}
                        for one in frame_ids
                    ]
                )
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise LinkError(
                f"bus.interface={self.interface} bus.channel={self.channel}: cannot be opened ({error}). `ip link` shows the CAN "
                "interfaces of this computer; bus=udp needs none"
            ) from error
        return OpenCanBus(bus)


class OpenCanBus:
    """An open bus; a context manager."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def recv(self, timeout_s: float) -> CanFrame | None:
        """Returns the next data frame, or `None` when none came in time, or an error frame that says nothing of its own.

        Raises:
            LinkError: the bus is down.
        """
        try:
            message = self._bus.recv(max(0.0, timeout_s))
        except (can.CanError, OSError, ValueError) as error:
            raise LinkError(f"bus: cannot receive ({error})") from error
        if message is not None and message.is_error_frame and message.arbitration_id & BUS_OFF:
            raise LinkError("bus: the controller has gone off the bus (bus-off)")
        if message is None or message.is_error_frame or message.is_remote_frame:
            return None
        return CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id)

    def send(self, frame: CanFrame) -> None:
        """Sends a frame.

        Raises:
            LinkError: it could not be sent; it is not sent later either.
        """
        message = can.Message(
            arbitration_id=frame.frame_id,
            data=frame.data,
            is_extended_id=frame.extended,
            check=False,
        )
        try:
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError) as error:
            raise LinkError(f"bus: cannot send ({error})") from error

    def close(self) -> None:
        """Closes the bus; twice is once."""
        try:
            self._bus.shutdown()
        except (can.CanError, OSError) as error:
            log.debug("bus: %s while closing", error)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


@spec
class BusReplay:
    """Frames that were recorded once, said again in their own time: the same loop over yesterday's run. Nothing is sent.

    Attributes:
        path: BLF file; what the loop itself sent then is left out.
        speed: Times real time.
    """

    path: str
    speed: float

    interface: ClassVar[str] = "replay"

    def check(self) -> None:
        if self.speed <= 0:
            raise ConfigError(f"bus.speed: expected more than 0, got {self.speed}")

    @property
    def channel(self) -> str:
        """The file."""
        return self.path

    def open(self, frame_ids: Sequence[int] | None = None) -> OpenBusReplay:
        """Begins the replay; see `Wire.open`.

        Raises:
            LinkError: the file cannot be read.
        """
        try:
            return OpenBusReplay(
                BLFReader(self.path),
                self.speed,
                None if frame_ids is None else frozenset(frame_ids),
            )
        except (OSError, ValueError, BLFParseError) as error:
            raise LinkError(f"bus.path={self.path}: nothing can be replayed ({error})") from error


class OpenBusReplay:
    """A running replay; as `OpenWire`."""

    def __init__(self, reader: BLFReader, speed: float, frame_ids: frozenset[int] | None) -> None:
        self._reader, self._speed, self._frame_ids = reader, speed, frame_ids
        self._messages, self._next = iter(reader), None
        self._offset_s: float | None = None

    def recv(self, timeout_s: float) -> CanFrame | None:
        """Returns the next frame when its time has come; see `OpenWire.recv`.

        Raises:
            LinkError: the replay is over.
        """
        end_s = time.monotonic() + max(0.0, timeout_s)
        if self._next is None:
            self._next = self._following()
        if self._offset_s is None:
            self._offset_s = time.monotonic() - self._next.timestamp / self._speed
        due_s = self._next.timestamp / self._speed + self._offset_s
        time.sleep(max(0.0, min(due_s, end_s) - time.monotonic()))
        if due_s > end_s:
            return None
        message, self._next = self._next, None
        return CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id)

    def send(self, frame: CanFrame) -> None:
        """Sends nothing."""

    def close(self) -> None:
        """Closes the file."""
        self._reader.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _following(self) -> can.Message:
        for message in self._messages:
            wanted = self._frame_ids is None or message.arbitration_id in self._frame_ids
            if (
                wanted
                and message.is_rx
                and not message.is_error_frame
                and not message.is_remote_frame
            ):
                return message
        raise LinkError("bus: the replay is over")
