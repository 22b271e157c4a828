"""Live video: what a test picture says, who may look, and what a browser shows of it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import SIZE, TOKEN, Scripted, eventually, served
from composed import option
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from deploy.page.video_relay import VideoRelay
from deploy.runtime.process import ChildProcess
from deploy.video.settings import SOCKET

READ_CODE = """name => {
    const camera = window.measured.video.cameras.find(one => one.name === name), { video } = camera;
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
    const context = canvas.getContext("2d");
    context.drawImage(video, 0, 0);
    const now_s = Date.now() / 1000, { data } = context.getImageData(0, 0, canvas.width, 12);
    return [now_s, canvas.width, Array.from({ length: data.length / 4 }, (_, at) => data[4 * at])];
}"""
"""Returns the time, the width and the red of the upper pixels of the picture that a camera shows now."""
ALARMS = "() => [...document.querySelectorAll('#alarms li:not(.over)')].map(one => one.textContent)"
CODECS = """async () => [...(await window.measured.video.peer.getStats()).values()]
    .filter(one => one.type === "codec" && !one.mimeType.endsWith("rtx")).map(one => one.mimeType)"""
SHOWS = (
    "() => (window.measured.video?.cameras ?? []).filter(one => one.shown && one.delay_ms).length"
)


CODE_BITS, CELL_PX = 40, 8
"""Bits of the time in `conf/video/pattern.yaml`, and the width of one in the picture."""


def read_time_code(picture: np.ndarray) -> float:
    """Return the wall clock in s, modulo 2^40 ms, that a grey picture carries."""
    # The middle of a cell: its edge is blurred by the coder.
    cells = picture[4:12, : CODE_BITS * CELL_PX].reshape(8, CODE_BITS, CELL_PX)[..., 2:6]
    bits = cells.mean((0, 2)) > 128
    return 1e-3 * float(bits @ (1 << np.arange(CODE_BITS)))


def test_who_has_no_token_does_not_reach_the_video_process(tmp_path: Path) -> None:
    reached = list[str]()

    async def run(port: int, token: str) -> str:
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            reached.append(token)
            writer.write(b'{"cameras": []}\n')
            await reader.read()  # until the relay goes
            writer.close()
            gone.set()

        own, gone = f"http://localhost:{port}", asyncio.Event()
        async with await asyncio.start_unix_server(answer, tmp_path / SOCKET):
            try:
                async with connect(
                    f"ws://localhost:{port}/video", origin=own, proxy=None
                ) as socket:  # type: ignore[arg-type]
                    await socket.send(json.dumps({"token": token}))
                    said = [str(await asyncio.wait_for(socket.recv(), 5)) for _ in range(2)]
                await asyncio.wait_for(gone.wait(), 5)
                return "".join(said)
            except ConnectionClosed as error:
                return error.rcvd.reason if error.rcvd else "closed"

    with served(Scripted(), extensions=(VideoRelay(str(tmp_path)),)) as port:
        assert asyncio.run(run(port, "wrong")) == "token" and reached == []
        assert asyncio.run(run(port, TOKEN)) == '{"ready": true}{"cameras": []}\n'
        assert reached == [TOKEN]


@pytest.fixture
def page(browser: Any, tmp_path: Path) -> Iterator[Any]:
    with served(Scripted(), extensions=(VideoRelay(str(tmp_path)),)) as port:
        context = browser.new_context(viewport=SIZE, locale="en-GB")
        page = context.new_page()
        page.route("**/scene.js", lambda route: route.fulfill(content_type="text/javascript"))
        page.goto(f"http://localhost:{port}/#token={TOKEN}")
        yield page
        context.close()


def test_a_page_without_its_video_says_so_and_goes_on(page: Any) -> None:
    eventually(lambda: any("NO LIVE PICTURE" in one for one in page.evaluate(ALARMS)))
    drawn = page.evaluate("window.measured.drawn")
    eventually(lambda: page.evaluate("window.measured.drawn") > drawn + 5)


def test_pictures_come_with_their_age_and_a_dead_process_is_an_alarm(
    page: Any, tmp_path: Path
) -> None:
    pytest.importorskip("aiortc", reason="the extra video is not installed")
    video = option("video", "pattern")
    child = ChildProcess("video", "deploy.video.video_process:run", (video, str(tmp_path)), ())
    try:
        eventually(lambda: page.evaluate(SHOWS) == 2)
        for index, name in enumerate(video.cameras):
            now_s, width, red = page.evaluate(READ_CODE, name)
            taken_s = read_time_code(np.reshape(red, (-1, width)))
            late_s = (now_s - taken_s) % (1e-3 * (1 << CODE_BITS))
            told_s = 1e-3 * page.evaluate(f"window.measured.video.cameras[{index}].delay_ms")
            # The code in the picture knows nothing of the page's own reckoning. The picture is
            # shown for a fifteenth of a second, and the machine may be busy.
            assert 0.0 < late_s < 3.0 and 0.0 < told_s < 3.0
            assert late_s == pytest.approx(told_s, abs=1.0)
        assert page.evaluate(CODECS) == ["video/H264"]
        eventually(lambda: page.evaluate(ALARMS) == [])
        page.keyboard.press("c")
        assert page.locator("figure.large .name").all_inner_texts() == ["front"]
    finally:
        child.end(3.0)
    eventually(lambda: any("NO LIVE PICTURE" in one for one in page.evaluate(ALARMS)))
