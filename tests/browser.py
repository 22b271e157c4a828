"""A page's server in a thread, a feed that shows what a test says, and a headless Chromium."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE, option
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from deploy.guidance import LeverPositions
from deploy.page.protocol import (
    BoreholeChoice,
    InsertionReading,
    LoopHealth,
    OperatorRequest,
    PageState,
    RecordingStatus,
    ShownAdvice,
    SourceAge,
)
from deploy.page.server import PageServer
from deploy.page.settings import PageSettings
from deploy.runtime.operator_state import OperatorState
from deploy.runtime.shared_memory import RecordLayout

TOKEN = "correct horse battery staple"
SIZE = {"width": 1280, "height": 800}
INSTALLED = shutil.which("chromium") or shutil.which("chromium-headless-shell")
CHROMIUM = os.environ.get("CHROMIUM") or INSTALLED
# the page itself is painted by the processor: a card that is only simulated would be kept busy with
# it
FLAGS = [
    "--no-sandbox",
    "--disable-gpu-compositing",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]

LEVERS = LeverPositions(0.0, 0.0, 0.0, 0.0, False)
POSE = np.array([0.0, -0.95, 0.55, 1.15, 0.6])
STATE = replace(RecordLayout(OperatorState, 5).new(), q=POSE, deadman=True, bus_up=True)
"""A guard that sends nothing and a dead-man that is held; all levers in neutral."""
SHOWN = PageState(
    t_s=0.0, alive=True, guiding=True, advice=ShownAdvice(True, "valid", 1, LEVERS, None), state=STATE,
    commands=False,
    streams=tuple(SourceAge(name, 0.0, 1e6) for name in ("positions", "levers", "advice", "borehole")),
    recording=RecordingStatus(False, 0.0, 0, failed=False),
    health=LoopHealth(0.0, 0.15, log_behind=False, supervisor_silent=False), insertion=None,
    targets=(
        BoreholeChoice("A", (2.6, 0.0, 0.75), (0.0, 0.0, 1.0), 0.05, 0.002, 0.97, True),
        BoreholeChoice("B", (2.2, 0.4, 0.75), (0.0, 0.0, 1.0), 0.05, None, None, False),
    ),
    path_in_base_m=((2.6, 0.3, 1.2), (2.6, 0.0, 1.05), (2.6, 0.0, 0.65)),
)  # fmt: skip
"""All is well, all levers in neutral."""
READING = InsertionReading(
    depth_m=-0.12, lateral_m=0.034, angle_rad=0.05, wanted_m=0.1, inserted=False,
    center_in_view_m=(0.03, 0.016, 0.12), axis_in_view=(0.05, 0.0, -0.99875),
)  # fmt: skip
"""A tool 12 cm above a borehole, 34 mm beside its axis, and leaning by 0.05 rad."""


def change_state(shown: PageState, **changes: Any) -> PageState:
    """Return what is shown with changes of the machine's, operator's or guard's state."""
    return replace(shown, state=replace(shown.state, **changes))


def lever(
    left_theta: float = 0.0, left_psi: float = 0.0, right_theta: float = 0.0, right_psi: float = 0.0
) -> np.ndarray:
    """Return positions of the operator's own levers."""
    return np.array([left_theta, left_psi, right_theta, right_psi])


def talk(
    port: int, path: str, said: list[str], origin: str | None = "own", host: str | None = None
) -> Any:
    """Send a message over a WebSocket; return the answers, or the refusal."""

    async def run() -> Any:
        headers = {"Host": host} if host else {}
        try:
            own = f"http://localhost:{port}" if origin == "own" else origin
            async with connect(
                f"ws://localhost:{port}{path}", origin=own, additional_headers=headers, proxy=None
            ) as socket:  # type: ignore[arg-type]
                answers = []
                for text in said:
                    await socket.send(text)
                    answers.append(json.loads(await asyncio.wait_for(socket.recv(), 5)))
                return answers
        except InvalidStatus as error:
            return error.response.status_code
        except ConnectionClosed as error:
            return error.rcvd.reason if error.rcvd else "closed"

    return asyncio.run(run())


class Scripted:
    """A feed that shows `now` and remembers requests."""

    def __init__(self, now: PageState = SHOWN) -> None:
        self.now, self.picture, self.confirms = now, None, True
        self.requests: list[OperatorRequest] = []

    def read_advice_number(self) -> int | None:
        return self.now.advice.number if self.now.advice else None

    def read_state(self) -> PageState:
        return self.now

    def read_frame(self, after_s: float) -> Frame | None:
        return self.picture if self.picture is not None and self.picture.t_s > after_s else None

    def submit(self, request: OperatorRequest) -> bool:
        self.requests.append(request)
        return True

    def confirms_stop(self) -> bool:
        return self.confirms

    def advise(self, number: int, due_s: float | None = None, **axes: Any) -> None:
        """Advises these lever positions, of full."""
        advice = ShownAdvice(True, "valid", number, replace(LEVERS, **axes), due_s)
        self.now = replace(self.now, advice=advice)


@contextmanager
def served(
    feed: Any,
    port: int = 0,
    machine: Machine | None = None,
    extensions: tuple[Any, ...] = (),
    **changes: Any,
) -> Iterator[int]:
    """Serves the page of `conf/page/local.yaml` with `changes`, and the pages of `extensions`; yields the port."""
    page: PageSettings = replace(option("page", "local"), port=port, token=TOKEN, **changes)
    server = PageServer(page, machine or MACHINE, feed, TOKEN, *extensions)
    ready, ending = threading.Event(), threading.Event()
    found, failed = list[int](), list[BaseException]()

    def serve() -> None:
        try:
            asyncio.run(server.run(ending.is_set, lambda at: (found.append(at), ready.set())))
        except BaseException as error:
            failed.append(error)
            ready.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert ready.wait(20)
        if failed:
            raise failed[0]
        yield found[0]
    finally:
        ending.set()
        thread.join(20)
        assert not thread.is_alive()


@contextmanager
def chromium() -> Iterator[Any]:
    """Yields a headless Chromium."""
    if CHROMIUM is None:
        pytest.skip("no Chromium: apt-get install chromium, or set CHROMIUM to its path")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def opening(browser: Any, ready: str, **context: Any) -> Iterator[Callable[..., Any]]:
    """Yields a function that opens pages of a server and waits until they are `ready`.

    Whatever the browser complains about, and a request to elsewhere, fails the test.
    """
    contexts, complaints = [], []

    def open_page(
        port: int, token: str | None = TOKEN, scene: bool = False, query: str = "", **how: Any
    ) -> Any:
        how = context | how
        contexts.append(browser.new_context(viewport=SIZE, locale="en-GB", **how))
        page = contexts[-1].new_page()
        if not scene:  # nothing is drawn
            page.route(
                "**/scene.js", lambda route: route.fulfill(content_type="text/javascript", body="")
            )
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on(
            "requestfinished",
            lambda one: None if f":{port}/" in one.url else complaints.append(one.url),
        )
        page.goto(f"http://localhost:{port}/{query}" + (f"#token={token}" if token else ""))
        until(page, "() => window.measured?.drawn > 0")
        if token:  # what is wished before the page was let in is refused
            until(page, ready)
        return page

    yield open_page
    for one in contexts:
        one.close()
    assert complaints == []


def eventually(claim: Callable[[], bool], seconds: float = 30.0) -> None:
    """Waits until a claim is true."""
    end_s = time.monotonic() + seconds
    while not claim():
        assert time.monotonic() < end_s, "it did not come true"
        time.sleep(0.02)


def until(page: Any, claim: str, seconds: float = 20.0) -> None:
    """Waits for something on a page; Playwright's own way needs `eval`, which the page forbids."""
    eventually(lambda: page.evaluate(claim), seconds)
