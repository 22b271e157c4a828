"""Independent work on several processor cores, by forked processes.

A forked process shares the memory of its parent, so neither function nor items have to be pickled;
only results come back through a pipe. On systems without a safe fork (Windows, macOS) one process
does all the work. The results do not depend on the number of processes.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextvars import ContextVar
from typing import Any, TypeVar

log = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")

_workers: ContextVar[int] = ContextVar("workers", default=1)
_work: list[Any] = []
"""Function and items of a helper."""


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
    tell: Callable[[Item, float], None] = lambda item, share: None,
) -> list[Result]:
    """Return `function` of each item, in their order.

    The function must not change anything that its caller reads, as that may happen in another
    process. An error is raised here as if it had been called in turn.

    Args:
        function: The work; its result can be pickled.
        items: The items.
        tell: Receives an item that is next, and the share that was done before.
    """
    todo = list(items)
    count = min(_workers.get(), len(todo))
    if count > 1 and sys.platform == "linux":
        fork = multiprocessing.get_context("fork")
        try:
            with (
                ProcessPoolExecutor(count, fork, _prepare_helper, (function, todo)) as pool,
                warnings.catch_warnings(),
            ):
                # Helpers neither log nor take locks of other threads.
                warnings.simplefilter("ignore", DeprecationWarning)
                return _collect(pool.map(_compute_item, range(len(todo))), todo, tell)
        except BrokenProcessPool:
            log.warning("a helper process was killed; its work is done in this process")
    return _collect(map(function, todo), todo, tell)


def _collect(
    found: Iterator[Result], todo: Sequence[Item], tell: Callable[[Item, float], None]
) -> list[Result]:
    """Return the results of all items; `tell` hears of each item before its result is asked for."""
    results = []
    for number, item in enumerate(todo):
        tell(item, number / len(todo))
        results.append(next(found))
    return results


def _prepare_helper(*work: Any) -> None:
    logging.disable()  # a lock of the log may be held by a thread that is not here
    _workers.set(1)
    _work[:] = work


def _compute_item(number: int) -> Any:
    function, todo = _work
    return function(todo[number])
