"""End-to-end protection of messages in the manner of AUTOSAR: CRC-8 with a data id, and a counter.

It finds repetition, loss, delay, insertion, masquerade, wrong sequence, corruption and a blocked
channel. It detects errors; it is no security: whoever knows the bus description can write valid
messages.

A channel has one owner. A wrong CRC, a counter that repeats or jumps by more than `MAX_STEP`, a
message older than the one before it, and more messages than the cycle time allows are faults; the
message is not used. Two senders of one message cannot agree on the counter: their steps would have
to add up to one. The state follows the last `WINDOW` messages (AUTOSAR E2E state machine):

    INIT, VALID --more than MAX_ERRORS errors or MAX_REPEATED repetitions--> INVALID
    any         --too many messages for the cycle time--> INVALID
    INIT        --MIN_GOOD_INIT good messages in a row--> VALID
    INVALID     --MIN_GOOD good messages in a row--> VALID
"""

from __future__ import annotations

import math
from enum import Enum

POLYNOMIAL, START, FINAL = 0x1D, 0xFF, 0xFF
"""CRC-8 SAE J1850: polynomial, initial value, and the value that the result is XORed with."""
MAX_STEP = 4
"""Largest step of a counter. Up to three messages lost in a row are accepted; whether that takes
too long is decided by age."""
WINDOW = 50
"""Messages that are remembered; half a second to a second of the example bus. At most 64, so that
the gateway can keep them in one word. Chosen by hand: whoever inserts two messages in that time is
found."""
MAX_ERRORS = 1
"""Errors in the window that are borne. CAN has its own CRC and sends again, so that even one error
is rare there."""
MAX_REPEATED = 2
"""Repetitions in the window that are borne. CAN itself repeats a message when the last bit is
disturbed."""
MIN_GOOD_INIT, MIN_GOOD = 2, 25
"""Good messages in a row that make a new channel valid, and an invalid one again. The second is half
a window, chosen by hand: the other sender has then been silent for a quarter of a second or more."""
BURST_S = 0.25
"""Messages, in s of their cycle time, that may come at once: a receiver that stood still finds them
in its queue. Longer than the `gap_s` after which the queue is dropped (0.2 s), by one cycle."""
RATE_SLACK = 1.1
"""By which a sender may be faster than its cycle time, for clocks that differ. Chosen by hand."""
ROUNDING_S = 1e-9
"""Rounding error that a sum of cycle times may have, s."""
MASK = (1 << WINDOW) - 1


def _build_table() -> bytes:
    """Return the CRC of each byte, so that a message takes one look-up a byte."""
    values = []
    for value in range(256):
        for _ in range(8):
            value = ((value << 1) ^ POLYNOMIAL if value & 0x80 else value << 1) & 0xFF
        values.append(value)
    return bytes(values)


TABLE = _build_table()


def compute_crc8(data: bytes | bytearray, data_id: int) -> int:
    """Return the CRC of `data` followed by the two bytes of `data_id`, low byte first."""
    crc = START
    for byte in data:
        crc = TABLE[crc ^ byte]
    crc = TABLE[crc ^ (data_id & 0xFF)]
    return TABLE[crc ^ (data_id >> 8)] ^ FINAL


class ChannelTrust(Enum):
    """State of a channel; see the module."""

    INIT = 0
    VALID = 1
    INVALID = 2


class MessageFault(Enum):
    """Why a message was refused."""

    CRC = "wrong CRC"
    REPEATED = "counter repeated"
    SEQUENCE = "counter out of sequence"
    LENGTH = "wrong length"
    LATE = "older than the message before it, or too old"
    RATE = "more messages than the cycle time allows"
    EARLY = "stamp from the future"


class ProtectedChannel:
    """The receiver's side of one message.

    Args:
        modulus: The counter counts 0 … modulus - 1.
        period_s: Cycle time of the message; 0: not sent by the clock, so its rate is free.
        wrap_s: Time after which its stamp wraps; 0: it has none.

    Attributes:
        trust: State of the channel.
        errors: Messages refused so far, by kind.
        lost: Messages that the counter has skipped.
    """

    def __init__(self, modulus: int, period_s: float, wrap_s: float) -> None:
        self._modulus, self._period_s, self._wrap_s = modulus, period_s, wrap_s
        self._last: int | None = None
        self._heard_s, self._debt_s = -math.inf, 0.0
        self._stamp_s: float | None = None
        # One bit a message, the newest lowest.
        self._errors, self._repeated, self._good = 0, 0, 0
        self.trust = ChannelTrust.INIT
        self.errors = dict.fromkeys(MessageFault, 0)
        self.lost = 0

    def take(self, counter: int, stamp_s: float, now_s: float) -> MessageFault | None:
        """Check a message whose CRC is right; return its fault, if any.

        Args:
            counter: Its counter.
            stamp_s: Its stamp; of no meaning where the message has none.
            now_s: When it came.
        """
        elapsed_s, self._heard_s = now_s - self._heard_s, now_s
        # A flood leaves no more behind than can be paid in `BURST_S`.
        left_s = max(0.0, min(BURST_S, self._debt_s) - RATE_SLACK * elapsed_s)
        self._debt_s = left_s + self._period_s
        if self._debt_s > BURST_S + ROUNDING_S:
            return self.refuse(MessageFault.RATE)
        # A stamp that goes back belongs to a late copy. It must not disturb the counter of the
        # sender that it copies. After a long silence back and forth look alike.
        before_s, half_s = self._stamp_s, self._wrap_s / 2
        step_s = 0.0
        if before_s is not None and elapsed_s < half_s:
            step_s = (stamp_s - before_s) % self._wrap_s
        if step_s > half_s:
            return self.refuse(MessageFault.LATE)
        self._stamp_s = stamp_s
        before, self._last = self._last, counter
        if before is None:
            return self._count(None)
        step = (counter - before) % self._modulus
        if step == 0:
            return self._count(MessageFault.REPEATED)
        if step > MAX_STEP:
            return self._count(MessageFault.SEQUENCE)
        self.lost += step - 1
        return self._count(None)

    def refuse(self, fault: MessageFault) -> MessageFault:
        """Count a message that could not be decoded, or is too old; return `fault`."""
        self._count(fault)
        return fault

    def _count(self, fault: MessageFault | None) -> MessageFault | None:
        repeated = fault is MessageFault.REPEATED
        wrong = fault is not None and not repeated
        self._errors = (self._errors << 1 | wrong) & MASK
        self._repeated = (self._repeated << 1 | repeated) & MASK
        if fault is None:
            self._good += 1
            needed = MIN_GOOD_INIT if self.trust is ChannelTrust.INIT else MIN_GOOD
            if self.trust is not ChannelTrust.VALID and self._good >= needed:
                self.trust = ChannelTrust.VALID
            return None
        self.errors[fault] += 1
        self._good = 0
        many = self._errors.bit_count() > MAX_ERRORS or self._repeated.bit_count() > MAX_REPEATED
        if many or fault is MessageFault.RATE:
            self.trust = ChannelTrust.INVALID
            # Errors count anew: MIN_GOOD good messages are then enough. So do stamps, for a sender
            # that has begun anew.
            self._errors, self._repeated, self._stamp_s = 0, 0, None
        return fault
