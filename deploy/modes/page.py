"""`brokk mode=page`: plays a recorded session on the operator's page."""

from __future__ import annotations

import math
import time

from rich.console import Console

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import Positive, spec
from deploy.page.protocol import FeedSpec
from deploy.page.server import serve_page
from deploy.page.settings import PageSettings


@spec
class PageMode:
    """Play a recorded session on the operator's page; `brokk preset=bench` shows the loop's own."""

    session: Session
    machine: Machine
    feed: FeedSpec
    page: PageSettings
    seconds: Positive | None

    def run(self) -> None:
        """Serve until the time is over or a person stops it; leave the link in `page.url`.

        Raises:
            LinkError: the address is taken.
        """
        end_s = time.monotonic() + (self.seconds or math.inf)
        console = Console(stderr=True)

        def show(link: str) -> None:
            console.print(f"operator's page: {link}", soft_wrap=True, highlight=False)

        feed = self.feed.build(self.machine)
        serve_page(
            self.page, lambda: time.monotonic() > end_s, self.machine, feed, self.session, show
        )
