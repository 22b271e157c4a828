"""Progress of long work: a bar with the time left, or a line a minute in a log file."""

from __future__ import annotations

import logging
import time
from typing import Any, Self

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

log = logging.getLogger(__name__)

SPEED_WINDOW_S = 3600.0
"""Time over which the speed is estimated, s: a case of an exam takes a minute or more."""
LINE_EVERY_S = 60.0
"""Time between two lines where nobody sees a bar, s."""


class ItemProgress:
    """Progress over a known number of items.

    Args:
        title: What is done.
        total: Number of items.
    """

    def __init__(self, title: str, total: int) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, transient=True, speed_estimate_period=SPEED_WINDOW_S)
        self._task = self._bar.add_task(title, total=total)
        self._title, self._total, self._done, self._known = title, total, 0, 0
        self._begun_s, self._told_s = time.monotonic(), time.monotonic()

    def skip(self, count: int = 1) -> None:
        """Count items that were done before: they say nothing about the speed."""
        self._known += count
        self._done += count
        # a new start of the clock: the bar's speed is that of the items of this run
        self._bar.reset(self._task, total=self._total, completed=self._done)

    def advance(self, count: int = 1) -> None:
        """Count items that are done."""
        self._done += count
        self._bar.advance(self._task, count)
        now_s = time.monotonic()
        if not self._bar.console.is_terminal and now_s - self._told_s > LINE_EVERY_S:
            self._told_s = now_s
            log.info("%s: %s", self._title, self.describe(now_s - self._begun_s))

    def describe(self, elapsed_s: float) -> str:
        """Return what is done and how long the rest takes, in words."""
        fresh = self._done - self._known
        text = f"{self._done} of {self._total}"
        if not fresh:
            return text
        left_s = elapsed_s / fresh * (self._total - self._done)
        return f"{text}, about {left_s / 60.0:.0f} min left"

    def __enter__(self) -> Self:
        self._bar.__enter__()
        return self

    def __exit__(self, *exc: Any) -> None:
        self._bar.__exit__(*exc)
