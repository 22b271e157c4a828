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
from deploy.page.loop_feed import LoopFeed, PageProcessConfig
from deploy.page.protocol import DrawReport, OperatorRequest, PageFeed, PageState
from deploy.page.server import read_static_files
from deploy.page.settings import LINK
from deploy.runtime.process import Stop
from deploy.runtime.shm_layout import LoopMemory
from deploy.study.conductor import Conductor, Words
from deploy.study.trial import Times
from deploy.study.twin_control import LoopStage

log = logging.getLogger(__name__)

TICK_S = 0.05
SHOW_S = 0.1
"""Between looks at what to show; pages get what has changed."""
HEAD = (
    b'<link rel="stylesheet" href="study.css"><script type="module" src="study.js"></script></head>'
)


@dataclass(frozen=True)
class Sitters:
    """What a room is to do.

    Attributes:
        beside: The page, and how the loop is shown.
        folder: The study's.
        participant: Who comes first; `None`: chosen on the page.
        words: What the lab says to participants.
        times: Countdown and the like.
        facts: What every trial says of itself besides.
        operators: Who is simulated, by condition; empty where people take part.
        target: File that says to the loop where the hole is.
        port: Where the twin can be put elsewhere; `None` on a machine.
    """

    beside: PageProcessConfig
    folder: Path
    participant: str | None
    words: Words
    times: Times
    facts: dict[str, Any]
    operators: dict[str, str]
    target: Path
    port: int | None


def run(stop: Stop, sitters: Sitters, memory: LoopMemory) -> None:
    """Leads sittings until it is asked to stop.

    Raises:
        LinkError: the page's address is taken.
    """
    beside = sitters.beside
    stage = LoopStage(memory, beside.machine, sitters.target, sitters.port)
    seed = beside.session.stream
    conductor = Conductor(
        sitters.folder,
        beside.machine,
        stage,
        sitters.words,
        sitters.times,
        sitters.facts,
        seed,
        sitters.operators,
    )
    if sitters.participant:
        conductor.choose(sitters.participant)
    link = beside.session.folder / LINK

    def tell(address: str) -> None:
        log.info(
            "%s; the link that leads the sitting stands in %s", address.partition("#")[0], link
        )

    try:
        feed = StudyFeed(LoopFeed(beside, memory), conductor)
        beside.page.serve(stop, beside.machine, feed, beside.session, tell, StudyPages(conductor))
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

    def news(self) -> int | None:
        """See `Feed`."""
        return self._feed.news() if self._conductor.shows_advice else None

    def shown(self) -> PageState:
        """See `Feed`."""
        shown = self._feed.shown()
        if self._conductor.shows_advice:
            return replace(shown, guiding=True)
        return replace(shown, guiding=False, advice=None, path_in_base_m=())

    def frame(self, after_s: float) -> Frame | None:
        """See `Feed`."""
        return self._feed.frame(after_s)

    def wish(self, wish: OperatorRequest) -> bool:
        """See `Feed`; `stop` ends the trial too."""
        if wish.kind != "stop":
            return False
        self._conductor.take({"do": "stop_trial"})
        return True

    def drawn(self, drawn: DrawReport) -> None:
        """See `Feed`."""
        self._feed.drawn(drawn)


class StudyPages:
    """The study's pages and their WebSocket; see `deploy.page.server.PageExtension`.

    What is asked of the participant lies over the operator's page; in a trial it is a bar at its
    upper edge.

    Args:
        conductor: Of the sitting.
    """

    path = "/study"

    def __init__(self, conductor: Conductor) -> None:
        self._conductor = conductor
        kind, index = read_static_files("deploy.page")["/index.html"]
        self.files: Mapping[str, tuple[str, bytes]] = read_static_files("deploy.study") | {
            "/": (kind, index.replace(b"</head>", HEAD, 1))
        }

    async def run(self) -> None:
        """See `Annex`."""
        while True:
            self._conductor.tick()
            await asyncio.sleep(TICK_S)

    async def talk(self, connection: ServerConnection) -> None:
        """Sends what is to be shown whenever that changes, and takes what is said; see `Annex`."""
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
