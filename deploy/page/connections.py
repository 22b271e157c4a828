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
        self._limit, self._undrawn, self._free = limit, list[int](), asyncio.Event()
        self._free.set()

    def note_sent(self, number: int) -> None:
        """Note that message `number` went out."""
        self._undrawn.append(number)
        if len(self._undrawn) >= self._limit:
            self._free.clear()

    def note_drawn(self, number: int) -> None:
        """Note that message `number` was drawn; those before it are of no use any more."""
        # A page draws the newest message and skips older ones, so a later number answers for all
        # before it.
        self._undrawn = [one for one in self._undrawn if one > number]
        if len(self._undrawn) < self._limit:
            self._free.set()

    async def wait(self) -> None:
        """Wait until another message may go out."""
        await self._free.wait()


class ConnectionBudget(Generic[C]):
    """Places for connections: watchers, those without their token yet, and operators.

    Nobody can lock out the operator. A new connection takes the place of the oldest one that has
    not shown its token, an operator that of the operator who came first, and a watcher that of one
    that has been mute.

    Args:
        clients: Pages that can be open at once.
    """

    def __init__(self, clients: int) -> None:
        self._clients = clients
        # When each watcher was heard last; the others in the order in which they came.
        self._watchers: dict[C, float] = {}
        self._unproven: dict[C, None] = {}
        self._operators: dict[C, None] = {}

    @property
    def num_watchers(self) -> int:
        """Number of watchers."""
        return len(self._watchers)

    def admit_watcher(self, connection: C, now_s: float) -> tuple[bool, C | None]:
        """Return whether a watcher is let in, and the one that has to go for it."""
        evicted = None
        if len(self._watchers) >= WATCHING * self._clients:
            evicted = min(self._watchers, key=lambda one: self._watchers[one])
            if now_s - self._watchers[evicted] < MUTE_S:
                return False, None
            del self._watchers[evicted]
        self._watchers[connection] = now_s
        return True, evicted

    def note_heard(self, connection: C, now_s: float) -> None:
        """Note that a watcher has answered."""
        # One that has been evicted may still say something.
        if connection in self._watchers:
            self._watchers[connection] = now_s

    def admit_unproven(self, connection: C) -> C | None:
        """Let in a connection that still has to show its token; return the one that has to go."""
        return _take_place(self._unproven, connection, UNPROVEN)

    def admit_operator(self, connection: C) -> C | None:
        """Let in a connection that has shown the token; return the one that has to go."""
        return _take_place(self._operators, connection, OPERATING * self._clients)

    def release(self, connection: C) -> None:
        """Free the place of a connection, whatever it was."""
        self._watchers.pop(connection, None)
        self._unproven.pop(connection, None)
        self._operators.pop(connection, None)


def _take_place(places: dict[C, None], connection: C, limit: int) -> C | None:
    evicted = next(iter(places)) if len(places) >= limit else None
    if evicted is not None:
        del places[evicted]
    places[connection] = None
    return evicted
