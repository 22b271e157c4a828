"""The page's server: one process, one port; files, and three WebSockets.

`/state` sends the newest `Shown` as JSON, `/frames` the newest frame, `/control` takes wishes. A
page says of every message when it
has drawn it, and has at most a few that it has not drawn: whoever is slow, asleep or not reading
gets fewer and always the newest, and costs neither memory nor the loop anything.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from http import HTTPStatus
from importlib.resources import files
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from deploy.page import access, frame_codec
from deploy.page.clock import PageClock
from deploy.page.protocol import DrawReport, PageFeed, PageState

if TYPE_CHECKING:
    from deploy.page.settings import PageSettings


class PageExtension(Protocol):
    """What else a server serves: the pages of a study."""

    files: Mapping[str, tuple[str, bytes]]
    """Type and content by path; a path that is the page's own takes its place."""
    path: str
    """Of its WebSocket, to which only those come who know the token."""

    async def talk(self, connection: ServerConnection) -> None:
        """Talks to a browser until it goes."""
        ...

    async def run(self) -> None:
        """Runs beside the server, as long as it does."""
        ...


log = logging.getLogger(__name__)

POLL_S, CLOSE_S, FRAME_POLL_S = 0.004, 0.001, 0.02
"""Between looks at the feed: for a new advice, the same when one is expected, and for a frame."""
FRAME_S = 0.018
"""Of a screen of 60 Hz, and what a message takes there."""
HEARTBEAT_S = 0.1
"""Between messages when nothing changes, so that a page knows that it is connected."""
UNDRAWN_STATES, UNDRAWN_FRAMES = 4, 2
"""Messages that a page may not have drawn yet before it gets more."""
WRONG_TOKEN_S = 0.5
BUFFER_BYTES = 1 << 16
STATE, FRAMES, CONTROL = "/state", "/frames", "/control"


class PageServer:
    """See the module.

    Args:
        page: How to serve.
        machine: The machine.
        feed: What to show.
        token: What a browser must show to have something done.
        annex: What else is served; `None`: nothing.
    """

    def __init__(
        self,
        page: PageSettings,
        machine: Machine,
        feed: PageFeed,
        token: str,
        annex: PageExtension | None = None,
    ) -> None:
        self._page, self._feed, self._token, self._annex = page, feed, token, annex
        self._files = load_files(json.dumps(page.setup(machine)).encode())
        self._talks = {STATE: self._states, FRAMES: self._frames, CONTROL: self._control}
        if annex is not None:
            self._files |= annex.files
            self._talks[annex.path] = self._visit
        self._names: frozenset[str] = frozenset()
        self._state: LatestValue[tuple[PageState | None, str]] = LatestValue((None, ""))
        self._frame = LatestValue(b"")
        self._open, self._pages = 0, 0
        self._guess = asyncio.Lock()

    async def run(self, stop: Callable[[], bool], ready: Callable[[int], None]) -> None:
        """Serves until `stop` says so; calls `ready` with the port once browsers can connect.

        Raises:
            LinkError: the address is taken or not this computer's.
        """
        page = self._page
        try:
            server = await serve(
                self._connection, page.host, page.port, process_request=self._answer, compression=None, server_header=None,
                max_size=2 * access.LONGEST, max_queue=4, write_limit=BUFFER_BYTES, ping_interval=5, ping_timeout=10,
                close_timeout=1, open_timeout=5, logger=logging.getLogger("deploy.page.websockets"),
            )  # fmt: skip
        except OSError as error:
            raise LinkError(
                f"page: cannot listen on {page.host}:{page.port} ({error.strerror}); choose page.port=…"
            ) from error
        port = next(iter(server.sockets)).getsockname()[1]
        self._names = access.list_own_hosts(page.host, port, page.names)
        logging.getLogger("deploy.page.websockets").setLevel(logging.WARNING)
        async with server, asyncio.TaskGroup() as group:
            tasks = [group.create_task(self._watch()), group.create_task(self._watch_frames())]
            tasks += [group.create_task(self._annex.run())] if self._annex else []
            ready(port)
            while not stop():
                await asyncio.sleep(0.05)
            for task in tasks:
                task.cancel()

    async def _watch(self) -> None:
        """Looks at the feed. A new advice goes out at once, what else is new no faster than the rate.

        A browser draws one frame in `FRAME_S`: what would take the frame of an advice that is
        expected waits and goes with it.
        """
        sent_s = looked_s = advised_s = apart_s = 0.0
        before = advised = None
        while True:
            now_s, number = time.monotonic(), self._feed.news()
            until_s = advised_s + apart_s - now_s
            expected = -POLL_S < until_s < FRAME_S
            silent = now_s - sent_s >= HEARTBEAT_S
            if (
                number != advised
                or silent
                or (now_s - looked_s >= 1.0 / self._page.rate_hz and not expected)
            ):
                looked_s, shown = now_s, self._feed.shown()
                safe = (shown.safety, shown.alive, shown.guiding)
                facts = (shown.advice, shown.own, shown.q, *safe, shown.recording.on, shown.targets)
                number = shown.advice.number if shown.advice else None
                if number != advised:
                    apart_s, advised_s = now_s - advised_s, now_s
                if silent or facts != before:
                    sent_s, before, advised = now_s, facts, number
                    text = json.dumps(
                        {"number": self._state.number + 1, "shown": shown.plain()},
                        separators=(",", ":"),
                    )
                    await self._state.put((shown, text))
            await asyncio.sleep(CLOSE_S if abs(until_s) < POLL_S else POLL_S)

    async def _watch_frames(self) -> None:
        """Takes frames while somebody looks; they are coded in a thread, once for all pages."""
        taken_s, due_s = -1.0, 0.0
        while True:
            await asyncio.sleep(FRAME_POLL_S)
            frame = self._feed.frame(taken_s) if self._open and time.monotonic() >= due_s else None
            if frame is not None:
                taken_s, due_s = (
                    frame.t_s,
                    time.monotonic() + 0.9 / self._page.frames_hz,
                )  # a camera's period is not exact
                await self._frame.put(
                    await asyncio.to_thread(
                        frame_codec.encode_frame,
                        frame,
                        self._page.picture_px,
                        self._page.jpeg_quality,
                    )
                )

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answers requests for files; `None` lets a WebSocket in."""
        path, host = request.path.partition("?")[0], request.headers.get("Host")
        if host not in self._names:
            return _build_refusal(
                HTTPStatus.MISDIRECTED_REQUEST, "unknown host name; see page.names"
            )
        if path not in self._talks:
            found = self._files.get(path)
            return (
                _build_refusal(HTTPStatus.NOT_FOUND, "no such page")
                if found is None
                else _build_response(HTTPStatus.OK, *found)
            )
        origin = request.headers.get("Origin")
        if not access.is_same_origin(origin, host, self._names) or (
            path not in (STATE, FRAMES) and origin is None
        ):
            log.warning("refused a connection from another origin")
            return _build_refusal(HTTPStatus.FORBIDDEN, "another origin")
        if self._open >= 3 * self._page.clients:
            return _build_refusal(
                HTTPStatus.SERVICE_UNAVAILABLE, "too many pages; see page.clients"
            )
        return None

    async def _connection(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        talk = self._talks[connection.request.path.partition("?")[0]]
        self._open += 1
        try:
            with suppress(ConnectionClosed):
                await talk(connection)
        finally:
            self._open -= 1

    async def _states(self, connection: ServerConnection) -> None:
        self._pages += 1
        clock, page = PageClock(), self._pages
        room = SendWindow(UNDRAWN_STATES)

        async def listen() -> None:
            async for text in connection:
                if (said := clock.heard(text, time.monotonic())) is None:
                    await connection.close(1008, "malformed")
                    return
                room.drawn(said.number)
                if said.advice is not None:
                    self._feed.drawn(
                        DrawReport(said.advice, said.drawn_s, clock.round_trip_s, page)
                    )

        async def speak() -> None:
            number = 0
            while True:
                await room.wait()
                number, (shown, text) = await self._state.after(number)
                advice = shown.advice if shown else None
                clock.sent(number, advice.number if advice else None, time.monotonic())
                room.sent(number)
                await connection.send(text)

        await _run_both(listen(), speak())

    async def _frames(self, connection: ServerConnection) -> None:
        room = SendWindow(UNDRAWN_FRAMES)

        async def listen() -> None:
            async for text in connection:
                if not str(text).isdecimal():
                    await connection.close(1008, "malformed")
                    return
                room.drawn(int(text))

        async def speak() -> None:
            number = sent = 0
            while True:
                await room.wait()
                number, message = await self._frame.after(number)
                sent += 1
                room.sent(sent)
                await connection.send(message)

        await _run_both(listen(), speak())

    async def _visit(self, connection: ServerConnection) -> None:
        if self._annex and await self._let_in(connection):
            await self._annex.talk(connection)

    async def _control(self, connection: ServerConnection) -> None:
        if await self._let_in(connection):
            async for text in connection:
                await connection.send(json.dumps(self._hand_on(text)))

    async def _let_in(self, connection: ServerConnection) -> bool:
        """Asks for the token, and says that it fits; closes the connection where it does not."""
        try:
            given = json.loads(await asyncio.wait_for(connection.recv(), 5.0))
        except (ValueError, TimeoutError):
            given = None
        if not access.matches_token(
            given.get("token") if isinstance(given, dict) else None, self._token
        ):
            async with self._guess:  # one guess at a time, whoever guesses
                await asyncio.sleep(WRONG_TOKEN_S)
            log.warning("refused a page with a wrong token")
            await connection.close(1008, "token")
            return False
        await connection.send(json.dumps({"ready": True}))
        return True

    def _hand_on(self, text: str | bytes) -> dict[str, str]:
        """Checks a wish against what holds now, not against what the page showed; returns the answer."""
        wish = access.parse_request(text)
        if wish is None:
            return {"refused": "malformed", "kind": ""}
        reason = access.find_refusal(wish, self._feed.shown())
        if reason is None and not self._feed.wish(wish):
            reason = "nowhere" if wish.kind == "point" else "busy"
        log.info("%s %s: %s", wish.kind, wish.value, reason or "done")
        return (
            {"refused": reason, "kind": wish.kind}
            if reason
            else {"done": wish.kind, "kind": wish.kind}
        )


async def _run_both(
    listen: Coroutine[None, None, None], speak: Coroutine[None, None, None]
) -> None:
    """Runs both ways of a connection until one ends."""
    tasks = [asyncio.create_task(listen), asyncio.create_task(speak)]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _build_response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers(
        {**SECURITY, "Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close"}
    )
    return Response(status.value, status.phrase, headers, body)


def _build_refusal(status: HTTPStatus, why: str) -> Response:
    return _build_response(status, FILES[".txt"], f"{why}\n".encode())


T = TypeVar("T")


class LatestValue(Generic[T]):
    """One value that is replaced and never queued.

    Args:
        value: The first.
    """

    def __init__(self, value: T) -> None:
        self.value, self.number = value, 0
        self._news = asyncio.Condition()

    async def put(self, value: T) -> None:
        """Replaces it."""
        self.value, self.number = value, self.number + 1
        async with self._news:
            self._news.notify_all()

    async def after(self, number: int) -> tuple[int, T]:
        """Waits for one that is newer than the `number`-th; returns its number and it."""
        async with self._news:
            await self._news.wait_for(lambda: self.number > number)
        return self.number, self.value


class SendWindow:
    """Keeps a page from having more than `limit` messages that it has not drawn."""

    def __init__(self, limit: int) -> None:
        self._limit, self._undrawn, self._free = limit, list[int](), asyncio.Event()
        self._free.set()

    def sent(self, number: int) -> None:
        """Notes that message `number` went out."""
        self._undrawn.append(number)
        if len(self._undrawn) >= self._limit:
            self._free.clear()

    def drawn(self, number: int) -> None:
        """Notes that it was drawn: whoever has drawn one has no use for those before."""
        self._undrawn = [one for one in self._undrawn if one > number]
        if len(self._undrawn) < self._limit:
            self._free.set()

    async def wait(self) -> None:
        """Waits until there is room."""
        await self._free.wait()


FILES = {
    ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8",
    ".json": "application/json; charset=utf-8", ".txt": "text/plain; charset=utf-8", ".svg": "image/svg+xml",
}  # fmt: skip
SECURITY = {
    # nothing but this server's own files, no code or style in the page itself, no frame around it
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; worker-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def load_files(setup: bytes) -> dict[str, tuple[str, bytes]]:
    """Returns type and content of each file by its path; `/setup.json` is `setup`."""
    found = {"/setup.json": (FILES[".json"], setup)} | read_static_files("deploy.page")
    found["/"] = found["/index.html"]
    return found


def read_static_files(package: str) -> dict[str, tuple[str, bytes]]:
    """Returns type and content of each file in the folder `static` of a package, by its path."""
    found = {}
    for entry in files(package).joinpath("static").iterdir():
        kind = FILES.get("." + entry.name.rpartition(".")[2])
        if kind and entry.is_file():
            found[f"/{entry.name}"] = (kind, entry.read_bytes())
    return found
