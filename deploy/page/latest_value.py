"""The newest of something for many readers, none of whom can hold up the writer or another."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """One value that is replaced and never queued.

    Args:
        value: The first.
    """

    def __init__(self, value: T) -> None:
        self.value, self.number = value, 0
        self._news = asyncio.Condition()

    async def put(self, value: T) -> None:
        """Replaces it."""
        self.value, self.number = value, self.number + 1
        async with self._news:
            self._news.notify_all()

    async def after(self, number: int) -> tuple[int, T]:
        """Waits for one that is newer than the `number`-th; returns its number and it."""
        async with self._news:
            await self._news.wait_for(lambda: self.number > number)
        return self.number, self.value


class Room:
    """Keeps a page from having more than `limit` messages that it has not drawn."""

    def __init__(self, limit: int) -> None:
        self._limit, self._undrawn, self._free = limit, list[int](), asyncio.Event()
        self._free.set()

    def sent(self, number: int) -> None:
        """Notes that message `number` went out."""
        self._undrawn.append(number)
        if len(self._undrawn) >= self._limit:
            self._free.clear()

    def drawn(self, number: int) -> None:
        """Notes that it was drawn: whoever has drawn one has no use for those before."""
        self._undrawn = [one for one in self._undrawn if one > number]
        if len(self._undrawn) < self._limit:
            self._free.set()

    async def wait(self) -> None:
        """Waits until there is room."""
        await self._free.wait()
