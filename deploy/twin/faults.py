"""Faults on request, of messages and machine, over a local port. Off unless a port is configured.

A request is one JSON datagram: `{"fault": "drop", "message": "JointPos1", "seconds": 0.2}`.
`message` names one message, or is left out for all; without `seconds` a fault stays until
`{"fault": "none"}`. The same port takes `{"place": {"q": [...], "hole_in_base_m": [x, y, z]}}`:
machine and block are put elsewhere, as between two trials of a study.
"""

from __future__ import annotations

import json
import random
import socket
import time
from dataclasses import dataclass, field

from brokk_rl.errors import ConfigError, list_choices
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import MessageLayout

FRAME_FAULTS = (
    "drop",
    "drop_some",
    "duplicate",
    "reorder",
    "delay",
    "corrupt",
    "short",
    "wrong_id",
    "freeze_counter",
    "masquerade",
)
"""Faults of messages on their way: not sent, one in ten not sent, sent twice, swapped with the
next, sent 0.2 s late, one bit wrong, cut short, under another identifier, with a counter that
stands still, with the CRC of another message."""
SIGNAL_FAULTS = (
    "stuck",
    "jump",
    "drift",
    "out_of_range",
    "sign",
    "mirrored",
    "invalid",
    "swapped",
    "doubled",
    "offset",
)
"""Faults of the measured position of the first joint: stands still, one jump, drifts, beyond its
limits, wrong sign, wrong sign from here on without a jump, called invalid, exchanged with the last
joint's, twice the way from here on, a constant error. A stuck, mirrored or turned sensor is that of
all joints."""
MACHINE_FAULTS = (
    "estop",
    "deadman_released",
    "remote_off",
    "lever",
    "second_sender",
    "second_remote",
    "flood",
    "silent",
)
"""Faults of the machine: emergency stop, dead-man or remote let go, a lever moved, another node
that sends commands, another remote whose dead-man is held, a babbling node, nothing sent at all."""
KNOWN = ("none", *FRAME_FAULTS, *SIGNAL_FAULTS, *MACHINE_FAULTS)
FOREVER_S = 1e9
"""Length of a fault that stays until it is switched off."""
SHARE_DROPPED = 0.1
"""Of the messages under `drop_some`."""
DELAY_S = 0.2
"""Of messages under `delay`: beyond every limit of the guard."""
WRONG_CRC, WRONG_ID = 0x5A, 0x10
"""By which CRC and identifier are XORed; any number but 0 will do."""
REQUEST_BYTES = 1024
"""Longest request and answer."""


@dataclass
class ActiveFaults:
    """The faults that are on.

    Attributes:
        until_s: By fault and message ('' for all), when it ends.
    """

    until_s: dict[tuple[str, str], float] = field(default_factory=dict)
    _held: dict[str, CanFrame] = field(default_factory=dict)
    _late: list[tuple[float, CanFrame]] = field(default_factory=list)
    _chance: random.Random = field(default_factory=lambda: random.Random(0))
    _since_s: dict[str, float] = field(default_factory=dict)
    _place: tuple[list[float], list[float]] | None = None

    def request(self, text: bytes, now_s: float) -> None:
        """Begin the fault that a request asks for; the module lists the requests.

        Raises:
            ConfigError: it is none.
        """
        try:
            asked = json.loads(text)
            if "place" in asked:
                # Converted here, so that a bad request is refused and not the next cycle.
                place = asked["place"]
                q, hole_m = list(map(float, place["q"])), list(map(float, place["hole_in_base_m"]))
                self._place = q, hole_m
                return
            fault, message = asked["fault"], asked.get("message", "")
            seconds = float(asked.get("seconds", FOREVER_S))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"fault: expected JSON with 'fault', got {text[:80]!r} ({error})"
            ) from error
        if fault not in KNOWN:
            raise ConfigError(f"fault: there is no '{fault}'; {list_choices(str(fault), KNOWN)}")
        if fault == "none":
            self.until_s.clear()
        else:
            self.until_s[fault, message] = now_s + seconds
            self._since_s[fault] = now_s

    def take_place(self) -> tuple[list[float], list[float]] | None:
        """Return joint positions and rim to put machine and block to, once; `None` without a request."""
        place, self._place = self._place, None
        return place

    def on(self, fault: str, message: str, now_s: float) -> bool:
        """Return whether a fault is on for a message."""
        # The empty name stands for all messages.
        return any(self.until_s.get((fault, name), -1.0) > now_s for name in (message, ""))

    def since_s(self, fault: str, now_s: float) -> float:
        """Return the time since a fault was requested."""
        return now_s - self._since_s.get(fault, now_s)

    def pass_on(self, layout: MessageLayout, frame: CanFrame, now_s: float) -> list[CanFrame]:
        """Return the frames to send now in place of `frame`."""
        name = layout.name

        def on(fault: str) -> bool:
            return self.on(fault, name, now_s)

        # Faults are applied to the coded bytes, where real ones occur.
        data = bytearray(frame.data)
        if (
            on("silent")
            or on("drop")
            or (on("drop_some") and self._chance.random() < SHARE_DROPPED)
        ):
            return []
        if on("corrupt"):
            data[self._chance.randrange(len(data))] ^= 1 << self._chance.randrange(8)
        if on("masquerade"):
            data[layout.crc_byte] ^= WRONG_CRC
        # The data identifier enters the CRC, so another message's CRC is wrong here.
        if on("short"):
            del data[-1]
        frame = CanFrame(
            frame.frame_id ^ (WRONG_ID if on("wrong_id") else 0), bytes(data), frame.extended
        )
        if on("delay"):
            self._late.append((now_s + DELAY_S, frame))
            return []
        if on("reorder"):
            # The first frame waits for the next one, which then goes first.
            held = self._held.pop(name, None)
            if held is None:
                self._held[name] = frame
                return []
            return [frame, held]
        return [frame, frame] if on("duplicate") else [frame]

    def due(self, now_s: float) -> list[CanFrame]:
        """Return the frames that were held up until now."""
        ripe, waiting = [], []
        for at_s, frame in self._late:
            if at_s <= now_s:
                ripe.append(frame)
            else:
                waiting.append((at_s, frame))
        self._late = waiting
        return ripe


class FaultPort:
    """Datagram socket of this computer for requests; a context manager.

    Args:
        port: Its number; `None`: there is none, and no fault.
    """

    def __init__(self, port: int | None) -> None:
        self._socket: socket.socket | None = None
        if port is not None:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            # This computer only: faults must not be reachable from the network.
            self._socket.bind(("127.0.0.1", port))
            self._socket.setblocking(False)

    def poll(self, faults: ActiveFaults, now_s: float) -> None:
        """Answer a request that has come in by `now_s`, if any."""
        if self._socket is None:
            return
        try:
            text, sender = self._socket.recvfrom(REQUEST_BYTES)
        except BlockingIOError:
            # No request is the usual case in a cycle.
            return
        try:
            faults.request(text, now_s)
            answer = f"ok {time.monotonic()!r}"
        except ConfigError as error:
            answer = str(error)
        self._socket.sendto(answer.encode(), sender)

    def __enter__(self) -> FaultPort:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._socket is not None:
            self._socket.close()


def request_fault(port: int, request: dict[str, object], timeout_s: float = 1.0) -> str:
    """Send a request to a twin on this computer; return its answer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(timeout_s)
        asking.sendto(json.dumps(request).encode(), ("127.0.0.1", port))
        return asking.recv(REQUEST_BYTES).decode()
