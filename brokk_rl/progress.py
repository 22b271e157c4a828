"""Progress of long work: a bar with the time left, or a line a minute in a log file."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from typing import Any, Self, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

log = logging.getLogger(__name__)

Item = TypeVar("Item")

SPEED_WINDOW_S = 3600.0
"""Time over which the speed is estimated, s: a case of an exam takes a minute or more."""
LINE_EVERY_S = 60.0
"""Time between two lines where nobody sees a bar, s."""
SHARE = 1.0
"""Total of work that is not counted in items: what is done is a share of it."""


class ItemProgress:
    """Progress over a number of items, or of a share that grows to 1.

    Args:
        title: What is done.
        total: Number of items, or `SHARE`; `None` where nobody knows it.
        quiet: Show nothing: of several processes the first shows it for all.
    """

    def __init__(self, title: str, total: float | None, quiet: bool = False) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn() if total == SHARE else MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        # Tables and figures go to stdout; whoever redirects them still sees the bar.
        self._bar = Progress(
            *columns,
            # A notebook without ipywidgets would get a warning for each bar.
            console=Console(stderr=True, force_jupyter=False),
            transient=True,
            speed_estimate_period=SPEED_WINDOW_S,
            disable=quiet,
        )
        self._task = self._bar.add_task(title, total=total, note="")
        self._title, self._note, self._total, self._quiet = title, "", total, quiet
        self._done, self._known = 0.0, 0.0
        self._begun_s, self._told_s = time.monotonic(), time.monotonic()

    def skip(self, count: float = 1) -> None:
        """Count items that were done before: they say nothing about the speed."""
        self._known += count
        self._done += count
        # a new start of the clock: the bar's speed is that of the items of this run
        self._bar.reset(self._task, total=self._total, completed=self._done)  # pyright: ignore[reportArgumentType]

    def advance(self, count: float = 1) -> None:
        """Count items that are done."""
        self.reach(self._done + count)

    def reach(self, done: float, title: str | None = None, note: str | None = None) -> None:
        """Set what is done so far; less than before is not shown, since a step may be repeated.

        Args:
            done: Items or share.
            title: What is done now; `None` leaves it.
            note: Figures to show beside it; `None` leaves them.
        """
        self._done = max(self._done, done)
        self._title = self._title if title is None else title
        self._note = self._note if note is None else note
        self._bar.update(self._task, completed=self._done, description=self._title, note=self._note)
        now_s = time.monotonic()
        hidden = not self._bar.console.is_terminal and not self._quiet
        if hidden and now_s - self._told_s > LINE_EVERY_S:
            self._told_s = now_s
            told = ", ".join(filter(None, (self.describe(now_s - self._begun_s), self._note)))
            log.info("%s: %s", self._title, told)

    def describe(self, elapsed_s: float) -> str:
        """Return what is done and how long the rest takes, in words."""
        fresh = self._done - self._known
        if self._total == SHARE:
            text = f"{self._done:.0%}"
        else:
            text = f"{self._done:g}" + ("" if self._total is None else f" of {self._total:g}")
        if not fresh or self._total is None:
            return text
        left_s = elapsed_s / fresh * (self._total - self._done)
        return f"{text}, about {left_s / 60.0:.0f} min left"

    def __enter__(self) -> Self:
        self._bar.__enter__()
        return self

    def __exit__(self, *exc: Any) -> None:
        self._bar.__exit__(*exc)


def track_items(items: Iterable[Item], title: str, total: int | None = None) -> Iterator[Item]:
    """Yield items and show the progress over them.

    Args:
        items: The items; without a length give `total`.
        title: What is done.
        total: Number of items, `None`: their length.
    """
    count = total if total is not None else len(items)  # type: ignore[arg-type]
    with ItemProgress(title, count) as progress:
        for item in items:
            yield item
            progress.advance()
