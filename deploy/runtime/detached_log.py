"""Logging that never waits: a terminal that is not read must not hold up a process of the loop.

A frozen terminal (Ctrl-S, a dead ssh connection) blocks whoever writes to it. Records go into a
bounded queue, and a thread of their own writes them. When the queue is full, records are dropped and
counted.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import time
from collections.abc import Iterator, Sequence
from logging.handlers import QueueHandler, QueueListener

MOST_RECORDS = 1000
"""Records that wait. Chosen by hand: hours of a calm loop."""
LAST_WORDS_S = 0.5
"""Time at the end of a process for the records that still wait. Chosen by hand."""
POLL_S = 0.01
"""Between looks at the end whether they are written."""


class DetachedHandler(QueueHandler):
    """Hands records to other handlers in a thread of its own.

    Args:
        handlers: They may block.

    Attributes:
        dropped: Records that found no room.
    """

    def __init__(self, handlers: Sequence[logging.Handler]) -> None:
        self._records: queue.Queue[logging.LogRecord] = queue.Queue(MOST_RECORDS)
        super().__init__(self._records)
        self.dropped = 0
        # Never stopped: its thread is a daemon, so that a process can end while its terminal is
        # frozen.
        QueueListener(self._records, *handlers, respect_handler_level=True).start()

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue a record."""
        try:
            self._records.put_nowait(record)
        except queue.Full:
            self.dropped += 1

    def flush(self) -> None:
        """Wait for the records that are queued, but not for long."""
        until_s = time.monotonic() + LAST_WORDS_S
        while self._records.unfinished_tasks and time.monotonic() < until_s:
            time.sleep(POLL_S)


@contextlib.contextmanager
def detach_logging() -> Iterator[None]:
    """Let the records of this process wait for no terminal, as long as the context is open."""
    root = logging.getLogger()
    before = list(root.handlers)
    detached = DetachedHandler(before)
    root.handlers = [detached]
    try:
        yield
    finally:
        detached.flush()
        root.handlers = before
