"""CAN buses through python-can.

Only `recv` and `send` of python-can are used. Its `Notifier` dies silently of the first exception.
Its cyclic senders die too or, in the kernel, go on repeating the last command while the program
hangs. Nothing here uses them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

import can

from brokk_rl.errors import LinkError
from brokk_rl.spec import Count, Index, Port, spec

log = logging.getLogger(__name__)

BUS_OFF = 0x40
"""Bit of an error frame of Linux (CAN_ERR_BUSOFF in linux/can/error.h)."""
LARGEST_STANDARD_ID = 0x7FF
"""Identifiers above it have 29 bits."""
EXTENDED_MASK = 0x1FFFFFFF
"""All 29 bits of an identifier."""
QUEUE_FRAMES = 1000
"""Queue of a virtual bus; its memory grows without end otherwise when nobody reads. By hand."""


@dataclass(frozen=True)
class CanFrame:
    """One frame on the bus.

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
        hops: Networks that a frame of `udp_multicast` may cross; 0: it stays on this computer, so
            that two benches on one network do not mix; `null` elsewhere.
    """

    interface: Literal["socketcan", "udp_multicast", "virtual"]
    channel: str
    bitrate: Count | None
    port: Port | None
    hops: Index | None

    def open(self, frame_ids: Sequence[int] | None = None) -> OpenCanBus:
        """Open the bus.

        Args:
            frame_ids: Identifiers to receive; the kernel leaves out others where it can. `None`:
                all.

        Raises:
            LinkError: there is no such bus.
        """
        options = {"bitrate": self.bitrate, "port": self.port, "hop_limit": self.hops}
        # Adapters refuse options that they do not know, even when these are `None`.
        options = {key: value for key, value in options.items() if value is not None}
        # Classic frames only: the gateway does not understand CAN FD.
        if self.interface == "udp_multicast":
            options["fd"] = False
        if self.interface == "virtual":
            options["rx_queue_size"] = QUEUE_FRAMES
        try:
            bus = can.Bus(interface=self.interface, channel=self.channel, **options)  # type: ignore[arg-type]
            # The kernel filters before the program wakes up.
            if frame_ids is not None:
                bus.set_filters([_build_filter(one) for one in frame_ids])
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise LinkError(
                f"bus.interface={self.interface} bus.channel={self.channel}: cannot be opened ({error}). `ip link` shows the CAN "
                "interfaces of this computer; bus=udp needs none"
            ) from error
        return OpenCanBus(bus)


def _build_filter(frame_id: int) -> can.typechecking.CanFilter:
    extended = frame_id > LARGEST_STANDARD_ID
    return {"can_id": frame_id, "can_mask": EXTENDED_MASK, "extended": extended}


class OpenCanBus:
    """An open bus; a context manager."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def recv(self, timeout_s: float) -> CanFrame | None:
        """Return the next data frame; `None` when none came in time, or for an error frame.

        Raises:
            LinkError: the bus is down.
        """
        try:
            # A negative time would block for ever.
            message = self._bus.recv(max(0.0, timeout_s))
        except (can.CanError, OSError, ValueError) as error:
            raise LinkError(f"bus: cannot receive ({error})") from error
        # Bus-off needs a restart of the controller; other error frames are transient.
        if message is not None and message.is_error_frame and message.arbitration_id & BUS_OFF:
            raise LinkError("bus: the controller has gone off the bus (bus-off)")
        if message is None or message.is_error_frame or message.is_remote_frame:
            return None
        return CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id)

    def send(self, frame: CanFrame) -> None:
        """Send a frame.

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
            # Without waiting: a command that cannot go out now is outdated later.
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError) as error:
            raise LinkError(f"bus: cannot send ({error})") from error

    def close(self) -> None:
        """Close the bus; a second call does nothing."""
        try:
            self._bus.shutdown()
        # Closing happens after an error too, and must not hide it.
        except (can.CanError, OSError) as error:
            log.debug("bus: %s while closing", error)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
