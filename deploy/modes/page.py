"""`brokk mode=page`: serves the operator's page with a made-up machine, to look at and to try at a desk."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from rich.console import Console

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec


class FeedSource(Protocol):
    """A spec in `conf/feed`: what the page shows."""

    def build(self, machine: Machine) -> Any:
        """Returns it at work."""
        ...


class Served(Protocol):
    """A spec in `conf/page`: how the page is served."""

    def serve(
        self,
        stop: Callable[[], bool],
        machine: Machine,
        feed: Any,
        session: Session,
        tell: Callable[[str], None],
    ) -> None:
        """Serves until `stop` says so; tells the link to open."""
        ...


@spec
class PageMode:
    """Serves the operator's page with a made-up machine; `brokk preset=bench` shows the loop's own."""

    session: Session
    machine: Machine
    feed: FeedSource
    page: Served
    seconds: float | None

    def check(self) -> None:
        if self.seconds is not None and self.seconds <= 0:
            raise ConfigError(f"seconds: expected more than 0, or null, got {self.seconds}")

    def run(self) -> None:
        """Serves until its time is over or a person stops it; leaves the link in `page.url`.

        Raises:
            LinkError: the address is taken.
        """
        end_s = None if self.seconds is None else time.monotonic() + self.seconds
        console = Console(stderr=True)
        self.page.serve(
            lambda: end_s is not None and time.monotonic() > end_s,
            self.machine,
            self.feed.build(self.machine),
            self.session,
            lambda link: console.print(f"operator's page: {link}", soft_wrap=True, highlight=False),
        )
