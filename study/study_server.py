"""The process that leads a sitting: the operator's page beside the loop, with the study's pages over it.

Advice is shown in guided trials alone, and left out here, not in the browser. While a sitting goes
on nothing but `stop` is taken from the operator's page: recording and borehole are the study's.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from websockets.asyncio.server import ServerConnection

from brokk_rl.signals import Frame
from deploy.page.files import read_static_files
from deploy.page.loop_feed import LoopFeed, PageProcessConfig
from deploy.page.protocol import DrawReport, OperatorRequest, PageFeed, PageState
from deploy.page.server import serve_page
from deploy.page.settings import LINK
from deploy.runtime.process import Stop
from deploy.runtime.shm_layout import LoopMemory
from study.conductor import Conductor, Words
from study.trial import Times
from study.twin_control import LoopStage

log = logging.getLogger(__name__)

TICK_S = 0.05
SHOW_S = 0.1
"""Between two looks at the view; pages get changes only."""
HEAD = (
    b'<link rel="stylesheet" href="study.css"><script type="module" src="study.js"></script></head>'
)


@dataclass(frozen=True)
class StudyServerConfig:
    """Settings of the study's server.

    Attributes:
        page: The page, and how the loop is shown.
        folder: The study's.
        participant: Who comes first; `None`: chosen on the page.
        words: Texts of the lab for participants.
        times: Countdown and the like.
        facts: Further fields of every trial.
        target: File that says to the loop where the hole is.
        port: Where the twin can be put elsewhere; `None` on a machine.
    """

    page: PageProcessConfig
    folder: Path
    participant: str | None
    words: Words
    times: Times
    facts: dict[str, Any]
    target: Path
    port: int | None


def run(stop: Stop, config: StudyServerConfig, memory: LoopMemory) -> None:
    """Lead sittings until it is asked to stop.

    Raises:
        LinkError: the page's address is taken.
    """
    page = config.page
    stage = LoopStage(memory, page.machine, config.target, config.port)
    conductor = Conductor(
        config.folder,
        page.machine,
        stage,
        config.words,
        config.times,
        config.facts,
        page.session.stream,
    )
    if config.participant:
        conductor.choose(config.participant)
    link = page.session.folder / LINK

    def announce(address: str) -> None:
        log.info(
            "%s; the link that leads the sitting stands in %s", address.partition("#")[0], link
        )

    try:
        feed = StudyFeed(LoopFeed(page, memory), conductor)
        pages = StudyPages(conductor)
        serve_page(page.page, stop, page.machine, feed, page.session, announce, pages)
    finally:
        conductor.close()


class StudyFeed:
    """The loop's feed as a study shows it; see `deploy.page.protocol.PageFeed`.

    Args:
        feed: The loop's.
        conductor: Of the sitting.
    """

    def __init__(self, feed: PageFeed, conductor: Conductor) -> None:
        self._feed, self._conductor = feed, conductor

    def read_advice_number(self) -> int | None:
        """See `PageFeed`."""
        return self._feed.read_advice_number() if self._conductor.shows_advice else None

    def read_state(self) -> PageState:
        """See `PageFeed`."""
        state = self._feed.read_state()
        if self._conductor.shows_advice:
            return replace(state, guiding=True)
        return replace(state, guiding=False, advice=None, path_in_base_m=())

    def read_frame(self, after_s: float) -> Frame | None:
        """See `PageFeed`."""
        return self._feed.read_frame(after_s)

    def submit(self, request: OperatorRequest) -> bool:
        """See `PageFeed`; `stop` ends the trial too."""
        if request.kind != "stop":
            return False
        self._conductor.take({"do": "stop_trial"})
        return True

    def confirms_stop(self) -> bool:
        """See `PageFeed`; a trial is ended by the conductor, and nothing is ever sent in a study."""
        return True

    def report_drawn(self, report: DrawReport) -> None:
        """See `PageFeed`."""
        self._feed.report_drawn(report)


class StudyPages:
    """The study's pages and their WebSocket; see `deploy.page.server.PageExtension`.

    Questions to the participant lie over the operator's page; in a trial it is a bar at its
    upper edge.

    Args:
        conductor: Of the sitting.
    """

    path = "/study"

    def __init__(self, conductor: Conductor) -> None:
        self._conductor = conductor
        kind, index = read_static_files("deploy.page")["/index.html"]
        self.files: Mapping[str, tuple[str, bytes]] = read_static_files("study") | {
            "/": (kind, index.replace(b"</head>", HEAD, 1))
        }

    async def run(self) -> None:
        """See `PageExtension`."""
        while True:
            self._conductor.tick()
            await asyncio.sleep(TICK_S)

    async def talk(self, connection: ServerConnection) -> None:
        """Send the view whenever it changes, and take answers; see `PageExtension`."""
        speaking = asyncio.create_task(self._speak(connection))
        try:
            async for text in connection:
                refused = self._take(text)
                if refused:
                    log.info("refused: %s", refused)
                await connection.send(
                    json.dumps({"refused": refused} | {"study": self._conductor.view()})
                )
        finally:
            speaking.cancel()

    async def _speak(self, connection: ServerConnection) -> None:
        before = ""
        while True:
            text = json.dumps({"study": self._conductor.view()})
            if text != before:
                before = text
                await connection.send(text)
            await asyncio.sleep(SHOW_S)

    def _take(self, text: str | bytes) -> str:
        try:
            said = json.loads(text)
        except ValueError:
            return "malformed"
        return self._conductor.take(said) if isinstance(said, dict) else "malformed"
