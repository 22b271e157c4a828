"""The page's server without a browser: who is refused, and what slow ones cost."""

from __future__ import annotations

import asyncio
import json
import time
from typing import Any

from browser import TOKEN, Scripted, served, talk
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from deploy.page.connections import UNPROVEN, WATCHING
from deploy.page.protocol import PageState


def test_strangers_are_refused(feed: Scripted, port: int) -> None:
    ours = json.dumps({"token": TOKEN})
    assert talk(port, "/control", [ours]) == [{"ready": True}]
    assert talk(port, "/control", [ours], origin="http://evil.example") == 403
    assert talk(port, "/control", [ours], origin=None) == 403
    assert talk(port, "/state", ["x"], origin="http://evil.example") == 403
    assert talk(port, "/control", ['{"token": "wrong"}']) == "token"
    assert talk(port, "/control", ["[]"]) == "token"
    refused = {"refused": "malformed", "kind": ""}
    assert talk(port, "/control", [ours, "nonsense"]) == [{"ready": True}, refused]
    assert talk(port, "/elsewhere", ["x"]) == 404
    assert feed.requests == []


def test_the_feed_is_asked_for_everything_no_faster_than_the_page_is_fed() -> None:
    class Counted(Scripted):
        asked = 0

        def read_state(self) -> PageState:
            self.asked += 1
            return super().read_state()

    feed = Counted()
    with served(feed):
        before = feed.asked
        time.sleep(0.6)
        assert 1 < feed.asked - before <= 0.7 * 50


def test_who_never_reads_or_answers_costs_the_others_nothing(feed: Scripted, port: int) -> None:
    async def run() -> tuple[int, int]:
        async with (
            connect(f"ws://localhost:{port}/state", proxy=None) as slow,
            connect(f"ws://localhost:{port}/state", proxy=None) as quick,
        ):
            last, end_s, count = 0, time.monotonic() + 1.5, 0
            while time.monotonic() < end_s:
                feed.advise(count)
                last = json.loads(await quick.recv())["number"]
                await quick.send(str(last))
                count += 1
            waiting = 0
            while True:
                try:
                    await asyncio.wait_for(slow.recv(), 0.2)
                    waiting += 1
                except TimeoutError:
                    return count, waiting

    count, waiting = asyncio.run(run())
    assert waiting == 4, "newest values only, and no more than four that were not drawn"
    assert count > 10


def test_connections_that_come_together_do_not_exceed_the_limit(feed: Scripted) -> None:
    async def count(port: int) -> int:
        address = f"ws://localhost:{port}/state"
        sockets = await asyncio.gather(*(connect(address, proxy=None) for _ in range(12)))
        closed = await asyncio.gather(*(drain(socket) for socket in sockets))
        await asyncio.gather(*(socket.close() for socket in sockets))
        return closed.count("too many pages; see page.clients")

    async def drain(socket: ClientConnection) -> str:
        try:
            while True:
                await asyncio.wait_for(socket.recv(), 0.5)
        except (TimeoutError, ConnectionClosed):
            return socket.close_reason or ""

    with served(feed, clients=2) as port:
        assert asyncio.run(count(port)) == 12 - 2 * WATCHING


def test_two_dozen_mute_sockets_lock_nobody_out(feed: Scripted) -> None:
    async def run(port: int) -> list[Any]:
        own, ours = f"http://localhost:{port}", json.dumps({"token": TOKEN})
        mute = []
        for path in ("/control", "/state", "/frames"):
            for _ in range(24):
                address = f"ws://localhost:{port}{path}"
                mute.append(await connect(address, origin=own, proxy=None))  # type: ignore[arg-type]
        await asyncio.sleep(2.1)
        control = await connect(f"ws://localhost:{port}/control", origin=own, proxy=None)  # type: ignore[arg-type]
        answers = []
        for text in (ours, '{"kind": "stop", "value": ""}'):
            await control.send(text)
            answers.append(json.loads(await asyncio.wait_for(control.recv(), 1.0)))
        async with connect(f"ws://localhost:{port}/state", proxy=None) as state:
            answers.append("number" in json.loads(await asyncio.wait_for(state.recv(), 1.0)))
        await asyncio.gather(control.close(), *(one.close() for one in mute))
        return answers

    with served(feed) as port:
        assert asyncio.run(run(port)) == [{"ready": True}, {"done": "stop", "kind": "stop"}, True]
    assert [one.kind for one in feed.requests] == ["stop"]


def test_a_page_that_has_not_shown_its_token_is_not_thrown_out_by_few_others(port: int) -> None:
    async def run() -> dict[str, bool]:
        own = f"http://localhost:{port}"
        sockets = []
        for _ in range(UNPROVEN):
            address = f"ws://localhost:{port}/control"
            sockets.append(await connect(address, origin=own, proxy=None))  # type: ignore[arg-type]
        await sockets[0].send(json.dumps({"token": TOKEN}))
        answer = json.loads(await asyncio.wait_for(sockets[0].recv(), 1.0))
        await asyncio.gather(*(one.close() for one in sockets))
        return answer

    assert asyncio.run(run()) == {"ready": True}


def test_a_stop_is_done_when_the_guard_says_so(feed: Scripted, port: int) -> None:
    feed.confirms = False
    said = [json.dumps({"token": TOKEN}), '{"kind": "stop", "value": ""}']
    begun_s = time.monotonic()
    assert talk(port, "/control", said)[1] == {"refused": "unconfirmed", "kind": "stop"}
    assert time.monotonic() - begun_s >= 0.3
    feed.confirms = True
    assert talk(port, "/control", said)[1] == {"done": "stop", "kind": "stop"}


def test_a_page_that_says_nonsense_is_closed(port: int) -> None:
    async def run() -> str:
        async with connect(f"ws://localhost:{port}/state", proxy=None) as socket:
            await socket.send("[1, 2]")
            try:
                while True:
                    await asyncio.wait_for(socket.recv(), 5)
            except ConnectionClosed as error:
                return error.rcvd.reason if error.rcvd else ""

    assert asyncio.run(run()) == "malformed"
