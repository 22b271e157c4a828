"""End-to-end protection of messages in the manner of AUTOSAR: CRC-8 with a data id, and a counter.

It finds repetition, loss, delay, insertion, masquerade, wrong sequence, corruption and a blocked
channel. It detects errors; it is no security: whoever knows the bus description can write valid
messages.

A wrong CRC, a repeated counter, or a counter more than `MAX_STEP` further on is an error, and the
message is not used. Each channel has a state:

    INIT     --two good messages in a row--> VALID
    VALID    --two errors in a row, or a score of five (error +1, good -1)--> INVALID
    INVALID  --RECOVERY good messages in a row--> VALID
"""

from __future__ import annotations

from enum import Enum

POLYNOMIAL, START, FINAL = 0x1D, 0xFF, 0xFF
"""CRC-8 SAE J1850: polynomial, initial value, and the value that the result is XORed with."""
MAX_STEP = 4
"""Largest step of a counter. Up to three messages lost in a row are accepted; whether that takes
too long is decided by age."""
IN_A_ROW = 2
"""Good messages that make a channel valid, and errors in a row that make it invalid."""
SCORE = 5
"""Score of errors that makes a channel invalid though good messages lie between them."""
RECOVERY = 10
"""Good messages in a row that make an invalid channel valid again."""


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


class ProtectedChannel:
    """The receiver's side of one message.

    Args:
        modulus: The counter counts 0 … modulus - 1.

    Attributes:
        trust: State of the channel.
        errors: Messages refused so far, by kind.
        lost: Messages that the counter has skipped.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: int | None = None
        self._bad, self._good, self._score = 0, 0, 0
        self.trust = ChannelTrust.INIT
        self.errors = dict.fromkeys(MessageFault, 0)
        self.lost = 0

    def take(self, counter: int) -> MessageFault | None:
        """Check the counter of a message whose CRC is right; return its fault, if any."""
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
        """Count a message that could not be decoded; return `fault`."""
        self._count(fault)
        return fault

    def _count(self, fault: MessageFault | None) -> MessageFault | None:
        if fault is None:
            self._good, self._bad, self._score = self._good + 1, 0, max(0, self._score - 1)
            needed = IN_A_ROW if self.trust is ChannelTrust.INIT else RECOVERY
            if self.trust is not ChannelTrust.VALID and self._good >= needed:
                self.trust = ChannelTrust.VALID
        else:
            self.errors[fault] += 1
            self._good, self._bad, self._score = 0, self._bad + 1, min(SCORE, self._score + 1)
            if self.trust is ChannelTrust.VALID and (self._bad >= IN_A_ROW or self._score >= SCORE):
                self.trust = ChannelTrust.INVALID
                self._score = 0
        return fault
