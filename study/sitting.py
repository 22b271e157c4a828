"""`study.do=run`: the loop with the process beside it that leads sittings, on the machine or with a twin.

That process serves the operator's page, with the study's pages over it. Advice is shown in guided
trials alone, and left out here, not in the browser. While a sitting goes on nothing but `stop` is
taken from the operator's page: recording and borehole are the study's.
"""

from __future__ import annotations

import asyncio
import fcntl
import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from websockets.asyncio.server import ServerConnection

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from deploy.page.files import read_static_files
from deploy.page.loop_feed import LoopFeed, PageProcessConfig
from deploy.page.protocol import OperatorRequest, PageFeed, PageState
from deploy.page.server import serve_page
from deploy.page.settings import LINK, PageSettings
from deploy.runtime.process import Stop
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.supervisor import CompanionProcess, DeploymentLoop
from deploy.runtime.target import FileTarget
from deploy.twin.bench import TwinBench
from study import study_folder as folders
from study.conductor import Conductor, Consent
from study.trial import LoopStage, Times

log = logging.getLogger(__name__)

LOCK, TARGET = ".sitting", "target.json"
"""File in the study's folder that one program at a time holds; file in the run folder that says to
the loop where the hole is."""
TICK_S = 0.05
SHOW_S = 0.1
"""Between two looks at the view; pages get changes only."""
HEAD = (
    b'<link rel="stylesheet" href="study.css"><script type="module" src="study.js"></script></head>'
)


@spec
class Sitting:
    """Settings of a sitting.

    Attributes:
        loop: The loop on the machine's computer; listens, shows, records.
        bench: The twin in place of the machine; `null` on a
            machine.
        page: The operator's page.
        consent: Text of the consent.
        times: How a trial begins and ends.
    """

    loop: DeploymentLoop
    bench: TwinBench | None
    page: PageSettings
    consent: Consent
    times: Times

    def check(self) -> None:
        if self.loop.commands:
            raise ConfigError(
                "study.do=run: in a study people move the machine; deploy=listen, not deploy=auto"
            )
        if self.bench is not None and self.bench.operator is not None:
            raise ConfigError(
                "study.do=run: that operator follows advice that is not shown; bench=twin"
            )

    def run(
        self, machine: Machine, session: Session, folder: Path, participant: str | None
    ) -> None:
        """Lead sittings until a person stops the program.

        Raises:
            ConfigError: the folder holds no study of this machine, the plan has no such
                participant, or another program leads sittings of this study.
        """
        data = folders.read_study(folder, machine)
        if participant is not None:
            data.require_participant(participant)
        target = FileTarget(path=str(session.folder / TARGET))
        loop = replace(self.loop, page=None, video=None, record=False, target=target)
        page = loop.build_page_config(self.page, machine, session)
        arguments = (self, page, folder.resolve(), participant)
        beside = self.bench.companions(machine, session) if self.bench else []
        beside.append(CompanionProcess("study", "study.sitting:run_server", arguments, None))
        with reserve_study(folder):
            loop.run(machine, session, beside)


@contextmanager
def reserve_study(folder: Path) -> Iterator[None]:
    """Keep others from leading sittings of the same study, as long as this process lives."""
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigError(
                f"{folder}: sittings of this study go on already, in another program; end that one first"
            ) from error
        yield


def run_server(
    stop: Stop,
    sitting: Sitting,
    page: PageProcessConfig,
    folder: Path,
    participant: str | None,
    memory: LoopMemory,
) -> None:
    """Lead sittings until it is asked to stop.

    Args:
        stop: Returns whether to stop.
        sitting: Settings.
        page: The page, and how the loop is shown.
        folder: The study's.
        participant: Who comes first; `None`: chosen on the page.
        memory: Of the loop.

    Raises:
        LinkError: the page's address is taken.
    """
    machine, session, bench = page.machine, page.session, sitting.bench
    stage = LoopStage(memory, session.folder / TARGET, bench.twin.fault_port if bench else None)
    facts = {"twin": bench is not None, "run": session.folder.name}
    conductor = Conductor(folder, machine, stage, sitting.consent, sitting.times, facts)
    if participant:
        conductor.choose(participant)

    def announce(address: str) -> None:
        place = session.folder / LINK
        log.info("%s; the link that leads the sitting: %s", address.partition("#")[0], place)

    feed = StudyFeed(LoopFeed(page, memory), conductor)
    try:
        serve_page(page.page, stop, machine, feed, session, announce, StudyPages(conductor))
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
                answer = {"refused": refused, "study": self._conductor.view()}
                await connection.send(json.dumps(answer))
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
