"""The clock of one page, compared with this computer's by the page's answers to messages."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

KEPT = 64
"""Messages of which the sending time is remembered. Chosen by hand: a page has at most four that it
has not drawn."""


@dataclass(frozen=True)
class DrawAcknowledgement:
    """Answer of a page to a message.

    Attributes:
        number: Of the message.
        advice: Number of the advice that became visible with it; `None` where that had been visible
            before.
        drawn_s: When, by this computer's monotonic clock.
    """

    number: int
    advice: int | None
    drawn_s: float


class PageClock:
    """Translates times of a page into those of this computer.

    The difference of the clocks is that of the exchange with the shortest round trip so far (as in
    NTP): waiting in a queue on one way only makes the round trip longer.

    Attributes:
        round_trip_s: The shortest one.
    """

    def __init__(self) -> None:
        self.round_trip_s = math.inf
        self._ahead_s = 0.0
        self._sent: dict[int, tuple[float, int | None]] = {}
        self._advice: int | None = None

    def note_sent(self, number: int, advice: int | None, now_s: float) -> None:
        """Note that message `number` went out, with the advice of that number."""
        self._sent[number] = (now_s, advice)
        if len(self._sent) > KEPT:
            del self._sent[next(iter(self._sent))]

    def read_acknowledgement(self, text: str | bytes, now_s: float) -> DrawAcknowledgement | None:
        """Return the page's answer in `text`, `None` where it holds none.

        It is `[number, came_ms, drawn_ms, said_ms]`, by the page's own clock.
        """
        try:
            number, came_ms, drawn_ms, said_ms = json.loads(text)
            came_s = float(came_ms) / 1000.0
            drawn_s = float(drawn_ms) / 1000.0
            said_s = float(said_ms) / 1000.0
            sent_s, advice = self._sent.pop(number)
        except (ValueError, TypeError, KeyError):
            return None
        if not all(map(math.isfinite, (came_s, drawn_s, said_s))) or not came_s <= said_s:
            return None
        round_trip_s = (now_s - sent_s) - (said_s - came_s)
        if round_trip_s < self.round_trip_s:
            self.round_trip_s = round_trip_s
            self._ahead_s = ((came_s - sent_s) + (said_s - now_s)) / 2.0
        new = advice is not None and advice != self._advice
        self._advice = advice
        return DrawAcknowledgement(number, advice if new else None, drawn_s - self._ahead_s)
