"""Independent work on several processor cores, by forked processes.

A forked process shares the memory of its parent, so nothing is sent to it; results come back through
a pipe. On systems without a safe fork (Windows, macOS) one process does all the work. The results do
not depend on the number of processes.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from multiprocessing.connection import Connection
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE, PATIENCE_S = 10.0, 60.0
"""A process that needs so many times as long as this one, and so much longer, is given up and its
work is done here: a library may hang after a fork. Chosen by hand."""

_workers: ContextVar[int] = ContextVar("workers", default=1)


@contextlib.contextmanager
def use_workers(count: int) -> Iterator[None]:
    """Let `map_parallel` use `count` processes inside of this context; 1 for none but this one."""
    before = _workers.set(count)
    try:
        yield
    finally:
        _workers.reset(before)


def map_parallel(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    tell: Callable[[Item, float], None] | None = None,
) -> list[Result]:
    """Return `function` of each item, in their order.

    The function must not change anything that its caller reads, as that may happen in another
    process. An error is raised here as if it had been called in turn.

    Args:
        function: The work; its result can be pickled.
        items: The items.
        tell: Receives an item whose work begins in this process, and the share that was begun
            before.
    """
    todo = list(items)

    def begin(number: int) -> Result:
        if tell:
            tell(todo[number], number / len(todo))
        return function(todo[number])

    count = min(_workers.get(), len(todo))
    if count < 2 or not _can_fork():
        return [begin(number) for number in range(len(todo))]
    context = multiprocessing.get_context("fork")
    place: Any = context.Value("i", 0)
    helpers = []
    for _ in range(count - 1):
        receiving, sending = context.Pipe(duplex=False)
        process = context.Process(
            target=_serve_items, args=(function, todo, place, sending), daemon=True
        )
        with warnings.catch_warnings():
            # Helpers neither log nor take locks of other threads.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
        sending.close()
        helpers.append((process, receiving))
    begun_s, found = time.monotonic(), {}
    try:
        with use_workers(1):
            while (number := _take(place, len(todo))) is not None:
                found[number] = begin(number)
        limit_s = PATIENCE_S + PATIENCE * (time.monotonic() - begun_s)
        for _, receiving in helpers:
            with contextlib.suppress(EOFError, OSError):
                if receiving.poll(limit_s):
                    found |= receiving.recv()
    finally:
        for process, receiving in helpers:
            receiving.close()
            process.kill()
            process.join()
    # The work of a helper that failed is done here, where its error is raised too.
    return [found[number] if number in found else begin(number) for number in range(len(todo))]


def _can_fork() -> bool:
    return sys.platform == "linux"


def _take(place: Any, count: int) -> int | None:
    """Return the number of the next item; `None` after the last."""
    with place.get_lock():
        number = place.value
        place.value = number + 1
    return number if number < count else None


def _serve_items(
    function: Callable[[Item], Any], items: list[Item], place: Any, sending: Connection
) -> None:
    """Do items until none is left or one fails, then send the results by number."""
    logging.disable()  # a lock of the log may be held by a thread that is not here
    _workers.set(1)
    found = {}
    # Ctrl-C reaches the helpers too; the first process says it once.
    with contextlib.suppress(Exception, KeyboardInterrupt):
        while (number := _take(place, len(items))) is not None:
            found[number] = function(items[number])
    sending.send(found)
    sending.close()
