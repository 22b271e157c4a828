"""Progress of long work: a bar with the time left, or a line a minute in a log file."""

from __future__ import annotations

import logging
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
        title: Work that is done.
        total: Number of items, or `SHARE`; `None` where nobody knows it.
        quiet: Show nothing: of several processes the first shows it for all.
    """

    def __init__(self, title: str, total: float | None, quiet: bool = False) -> None:
        # Tables and figures go to stdout; whoever redirects them still sees the bar.
        # A notebook without ipywidgets would get a warning for each bar.
        console = Console(stderr=True, force_jupyter=False)
        self._done = TaskProgressColumn() if total == SHARE else MofNCompleteColumn(" of ")
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            self._done,
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            speed_estimate_period=SPEED_WINDOW_S,
            disable=quiet or not console.is_terminal,  # a bar leaves empty lines in a file
        )
        self._bar.add_task(title, total=total, note="")
        self._is_logged = not quiet and not console.is_terminal
        self._told_s = self._bar.get_time()

    def skip(self, count: float = 1) -> None:
        """Count items that were done before: they say nothing about the speed."""
        task = self._bar.tasks[0]
        # Resets the clock: the speed is that of the items of this run.
        self._bar.reset(task.id, completed=task.completed + count, note="")  # pyright: ignore[reportArgumentType]

    def advance(self, count: float = 1) -> None:
        """Count items that are done."""
        self.reach(self._bar.tasks[0].completed + count)

    def reach(self, done: float, title: str | None = None, note: str | None = None) -> None:
        """Set what is done so far; less than before is not shown, since a step may be repeated.

        Args:
            done: Items or share, at most the total.
            title: Work that is done now; `None` leaves it.
            note: Figures to show beside it; `None` leaves them.
        """
        task = self._bar.tasks[0]
        done = max(task.completed, done if task.total is None else min(done, task.total))
        fields: dict[str, Any] = {} if note is None else {"note": note}
        self._bar.update(task.id, completed=done, description=title, **fields)
        if self._is_logged and self._bar.get_time() - self._told_s > LINE_EVERY_S:
            self._told_s = self._bar.get_time()
            log.info("%s: %s", task.description, self.describe())

    def describe(self) -> str:
        """Return what is done, how long the rest takes and the note, in words."""
        task = self._bar.tasks[0]
        parts = [str(self._done.render(task)).strip()]
        if task.time_remaining is not None and not task.finished:
            parts.append(f"about {task.time_remaining / 60.0:.0f} min left")
        return ", ".join(filter(None, (*parts, task.fields["note"])))

    def __enter__(self) -> Self:
        self._bar.__enter__()
        return self

    def __exit__(self, *exc: Any) -> None:
        self._bar.__exit__(*exc)


def track_items(items: Iterable[Item], title: str, total: int | None = None) -> Iterator[Item]:
    """Yield items and show the progress over them.

    Args:
        items: The items; without a length give `total`.
        title: Work that is done.
        total: Number of items, `None`: their length.
    """
    with ItemProgress(title, len(items) if total is None else total) as progress:  # type: ignore[arg-type]
        for item in items:
            yield item
            progress.advance()
