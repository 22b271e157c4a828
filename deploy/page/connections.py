"""Connections of the page's server: newest values, undrawn messages, and places for connections."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

WATCHING = 2
"""WebSockets of one page that only watch: states and frames."""
OPERATING = 3
"""WebSockets of one page that show the token: requests, and extensions such as study and video."""
UNPROVEN = 8
"""WebSockets that may still have to send their token. Chosen by hand: a page sends its token within
one round trip, and only mute ones grow old."""
MUTE_S = 2.0
"""Silence of a watcher from which a new page takes its place when all are taken. Chosen by hand: a
page answers each message when it has drawn it, ten times a second at least."""

T = TypeVar("T")
C = TypeVar("C")


class LatestValue(Generic[T]):
    """A value that is replaced and never queued.

    It has many readers, none of whom can hold up the writer or another reader.

    Args:
        value: The first.
    """

    def __init__(self, value: T) -> None:
        self.value, self.number = value, 0
        self._changed = asyncio.Condition()

    async def put(self, value: T) -> None:
        """Replace the value."""
        self.value, self.number = value, self.number + 1
        async with self._changed:
            self._changed.notify_all()

    async def wait_after(self, number: int) -> tuple[int, T]:
        """Wait for a value that is newer than the `number`-th; return its number and the value."""
        async with self._changed:
            await self._changed.wait_for(lambda: self.number > number)
        return self.number, self.value


class SendWindow:
    """Keeps a page from having more than `limit` messages that it has not drawn."""

    def __init__(self, limit: int) -> None:
        self._limit, self._num_sent, self._num_drawn = limit, 0, 0
        self._changed = asyncio.Event()

    def note_sent(self, number: int) -> None:
        """Note that message `number` went out."""
        self._num_sent = number

    def note_drawn(self, number: int) -> None:
        """Note that message `number` was drawn; those before it are of no use any more."""
        # A page draws the newest message and skips older ones, so a later number answers for all
        # before it.
        self._num_drawn = max(self._num_drawn, min(number, self._num_sent))
        self._changed.set()

    async def wait(self) -> None:
        """Wait until another message may go out."""
        while self._num_sent - self._num_drawn >= self._limit:
            self._changed.clear()
            await self._changed.wait()


class Places(Generic[C]):
    """Places for connections of one kind: where all are taken, who is mute longest goes.

    Nobody can lock out the operator.

    Args:
        limit: Connections that can be open at once.
        mute_s: Silence from which a connection loses its place; 0: the oldest one always does.
    """

    def __init__(self, limit: int, mute_s: float = 0.0) -> None:
        self._limit, self._mute_s = limit, mute_s
        self._heard_s: dict[C, float] = {}

    def __len__(self) -> int:
        return len(self._heard_s)

    def admit(self, connection: C, now_s: float) -> tuple[bool, C | None]:
        """Return whether a connection is let in, and the one that has to go for it."""
        evicted = None
        if len(self._heard_s) >= self._limit:
            evicted = min(self._heard_s, key=lambda one: self._heard_s[one])
            if now_s - self._heard_s[evicted] < self._mute_s:
                return False, None
            del self._heard_s[evicted]
        self._heard_s[connection] = now_s
        return True, evicted

    def note_heard(self, connection: C, now_s: float) -> None:
        """Note that a connection has said something."""
        # One that has been evicted may still say something.
        if connection in self._heard_s:
            self._heard_s[connection] = now_s

    def release(self, connection: C) -> None:
        """Free the place of a connection."""
        self._heard_s.pop(connection, None)
