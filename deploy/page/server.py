"""The page's server: one process, one port; files, and three WebSockets.

`/state` sends the newest `PageState` as JSON, `/frames` the newest frame, `/control` takes
requests. A page answers every message when it has drawn it, and gets no more while a few are not
drawn. A page that is slow, asleep or not reading gets fewer messages and always the newest, and
costs neither memory nor the loop anything. The files are read once at the start: nothing on the disk
can be reached through the server.

Watchers, connections without their token yet, and those of the operator are counted apart. Mute
watchers give way to new ones, and the operator's requests always find a place.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import secrets
import time
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import asdict
from functools import partial
from http import HTTPStatus
from typing import Any, Protocol

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from brokk_rl.errors import LinkError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from deploy.page import access, frame_codec
from deploy.page.alarms import list_alarms
from deploy.page.connections import (
    MUTE_S,
    OPERATING,
    UNPROVEN,
    WATCHING,
    LatestValue,
    Places,
    SendWindow,
)
from deploy.page.files import FILES, SECURITY, load_files
from deploy.page.protocol import PageFeed
from deploy.page.settings import LINK, PageSettings

log = logging.getLogger(__name__)

POLL_S = 0.004
"""Between looks for a new advice. Chosen by hand: a quarter of a screen's frame."""
HEARTBEAT_S = 0.1
"""Longest time between two states, whatever the rate: a third of the silence that greys a page."""
FRAME_POLL_S = 0.02
"""Between looks for a frame of the camera."""
STOP_POLL_S = 0.05
"""Between looks whether to stop."""
EARLY = 0.9
"""Part of a camera's period from which the next frame is on time: the period is not exact."""
UNDRAWN_STATES, UNDRAWN_FRAMES = 4, 2
"""Messages that a page may not have drawn yet before it gets more. Chosen by hand: more are older
when they are drawn, fewer leave the network idle."""
WRONG_TOKEN_S = 0.5
"""Delay after a wrong token, one guess at a time: two guesses a second for all who guess."""
TOKEN_PATIENCE_S = 5.0
"""Time that a page gets to send its token."""
TOKEN_BYTES = 24
"""Of a new token: 192 bits."""
BUFFER_BYTES = 1 << 16
"""Of a connection: about a third of a frame."""
CONFIRM_S, CONFIRM_POLL_S = 0.3, 0.005
"""Time for the guard to confirm a stop, and between looks. Its cycle is 10 ms; the person is told
within 0.3 s that the stop is not confirmed."""
STATE, FRAMES, CONTROL = "/state", "/frames", "/control"
Handler = Callable[[ServerConnection], Coroutine[None, None, None]]


class PageExtension(Protocol):
    """Further pages or sockets on the same server: those of a study, and the video.

    Attributes:
        files: Type and content by path; a path that is the page's own takes its place.
        path: Of its WebSocket, which needs the token.
    """

    files: Mapping[str, tuple[str, bytes]]
    path: str

    async def talk(self, connection: ServerConnection) -> None:
        """Talk to a browser until it goes."""

    async def run(self) -> None:
        """Run beside the server, as long as it does."""


def serve_page(
    page: PageSettings,
    stop: Callable[[], bool],
    machine: Machine,
    feed: PageFeed,
    session: Session,
    announce: Callable[[str], None],
    *extensions: PageExtension,
) -> None:
    """Serve the page until `stop` says so or a person stops it.

    The link to open is left in `page.url`.

    Args:
        page: Settings.
        stop: Returns whether to stop.
        machine: The machine.
        feed: Source of the state.
        session: Run folder.
        announce: Gets the link to open.
        extensions: Further pages.

    Raises:
        LinkError: the address is taken or not this computer's.
    """
    token = page.token or secrets.token_urlsafe(TOKEN_BYTES)

    def begin(port: int) -> None:
        address = build_link(page, port, token)
        # The token stands in a file that only its owner can read, not in the log.
        write_link(session, address)
        announce(address)

    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(PageServer(page, machine, feed, token, *extensions).run(stop, begin))


def build_link(page: PageSettings, port: int, token: str) -> str:
    """Return the address to open; the token stands behind `#`, which browsers do not send."""
    host = page.names[0] if page.names else page.host
    if page.host in ("127.0.0.1", "::1"):
        host = "localhost"
    return f"http://{host}:{port}/#token={token}"


def write_link(session: Session, address: str) -> None:
    """Write the link into the run folder, readable for its owner alone.

    Raises:
        StorageError: it cannot be written.
    """
    path = session.folder / LINK
    try:
        # Another's file, or a link to one, goes; a new file has the mode from its creation on.
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(address + "\n")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror}); remove it") from error


class PageServer:
    """HTTP server of the operator's page, with its three WebSockets.

    Args:
        page: Settings.
        machine: The machine.
        feed: Source of the state.
        token: Secret that a browser must show with a request.
        extensions: Further pages.
    """

    def __init__(
        self,
        page: PageSettings,
        machine: Machine,
        feed: PageFeed,
        token: str,
        *extensions: PageExtension,
    ) -> None:
        self._page, self._feed, self._token, self._extensions = page, feed, token, extensions
        # The setup never changes during a run, so it is encoded once and served like a file.
        setup = page.describe_setup(machine) | {"extensions": [one.path for one in extensions]}
        self._files = load_files(json.dumps(setup).encode())
        self._state, self._frame = LatestValue(""), LatestValue(b"")
        self._handlers: dict[str, Handler] = {
            STATE: partial(self._send_newest, newest=self._state, most_undrawn=UNDRAWN_STATES),
            FRAMES: partial(self._send_newest, newest=self._frame, most_undrawn=UNDRAWN_FRAMES),
            CONTROL: self._take_requests,
        }
        for extension in extensions:
            self._files |= extension.files
            self._handlers[extension.path] = extension.talk
        self._names = access.list_own_names(page.host, page.names)
        self._watchers = Places[ServerConnection](WATCHING * page.clients, MUTE_S)
        self._unproven = Places[ServerConnection](UNPROVEN)
        self._operators = Places[ServerConnection](OPERATING * page.clients)
        self._guess, self._closing = asyncio.Lock(), set[asyncio.Task[None]]()

    async def run(self, stop: Callable[[], bool], begin: Callable[[int], None]) -> None:
        """Serve until `stop` says so; call `begin` with the port once browsers can connect.

        Raises:
            LinkError: the address is taken or not this computer's.
        """
        page = self._page
        socket_log = logging.getLogger("deploy.page.websockets")
        try:
            server = await serve(
                self._handle_connection,
                page.host,
                page.port,
                process_request=self._answer,
                # Compression would delay each small message by more than it saves on a local
                # network.
                compression=None,
                server_header=None,
                # Requests are short; a longer message is an error or an attack.
                max_size=2 * access.LONGEST,
                max_queue=4,
                write_limit=BUFFER_BYTES,
                # A tablet that leaves the network sends no goodbye: without pings its connection
                # would count as open.
                ping_interval=5,
                ping_timeout=10,
                close_timeout=1,
                open_timeout=5,
                logger=socket_log,
            )
        except OSError as error:
            raise LinkError(
                f"page: cannot listen on {page.host}:{page.port} ({error.strerror}); choose page.port=…"
            ) from error
        port = next(iter(server.sockets)).getsockname()[1]
        socket_log.setLevel(logging.WARNING)
        async with server, asyncio.TaskGroup() as group:
            tasks = [group.create_task(self._watch()), group.create_task(self._watch_frames())]
            tasks += [group.create_task(one.run()) for one in self._extensions]
            begin(port)
            while not stop():
                await asyncio.sleep(STOP_POLL_S)
            # The tasks wait for ever; without this the group would never end.
            for task in tasks:
                task.cancel()

    async def _watch(self) -> None:
        """Send states at the page's rate; one with a new advice goes out at once."""
        looked_s, advised = 0.0, None
        period_s = min(1.0 / self._page.rate_hz, HEARTBEAT_S)
        while True:
            now_s, number = time.monotonic(), self._feed.read_advice_number()
            # Also where nothing changes: a page that hears nothing cannot tell a calm machine from
            # a dead connection.
            if number != advised or now_s - looked_s >= period_s:
                looked_s, advised, state = now_s, number, self._feed.read_state()
                alarms = [asdict(one) for one in list_alarms(state)]
                shown = state.to_plain() | {"alarms": alarms}
                message = {"number": self._state.number + 1, "shown": shown}
                await self._state.put(json.dumps(message, separators=(",", ":")))
            await asyncio.sleep(POLL_S)

    async def _watch_frames(self) -> None:
        """Take frames while somebody looks; encode them in a thread, once for all pages."""
        taken_s, due_s = -1.0, 0.0
        page = self._page
        while True:
            # Pictures are large; they are encoded only while somebody looks.
            await asyncio.sleep(FRAME_POLL_S)
            if not len(self._watchers) or time.monotonic() < due_s:
                continue
            frame = self._feed.read_frame(taken_s)
            if frame is None:
                continue
            taken_s, due_s = frame.t_s, time.monotonic() + EARLY / page.frames_hz
            # In a thread: the event loop must go on sending states.
            message = await asyncio.to_thread(
                frame_codec.encode_frame, frame, page.picture_px, page.jpeg_quality
            )
            await self._frame.put(message)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer requests for files; `None` lets a WebSocket in."""
        path, host = request.path.partition("?")[0], request.headers.get("Host")
        if not access.is_own_host(host, self._names):
            # A browser that is led to this server by a foreign name (DNS rebinding) still sends
            # that name.
            return _build_refusal(
                HTTPStatus.MISDIRECTED_REQUEST, "unknown host name; see page.names"
            )
        if path not in self._handlers:
            found = self._files.get(path)
            if found is None:
                return _build_refusal(HTTPStatus.NOT_FOUND, "no such page")
            return _build_response(HTTPStatus.OK, *found)
        origin = request.headers.get("Origin")
        # programs send no origin; they may watch
        needs_origin = path not in (STATE, FRAMES)
        is_ours = access.is_same_origin(origin, host, self._names)
        if not is_ours or (needs_origin and origin is None):
            log.warning("refused a connection from another origin")
            return _build_refusal(HTTPStatus.FORBIDDEN, "another origin")
        return None

    async def _handle_connection(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        path = connection.request.path.partition("?")[0]
        with contextlib.suppress(ConnectionClosed):
            if path in (STATE, FRAMES):
                await self._serve(self._watchers, connection, self._handlers[path])
            elif await self._check_token(connection):
                await connection.send(json.dumps({"ready": True}))
                await self._serve(self._operators, connection, self._handlers[path])

    async def _serve(
        self, places: Places[ServerConnection], connection: ServerConnection, handle: Handler
    ) -> None:
        # Compared after the handshake: before it, handshakes at the same time would all be let in.
        admitted, evicted = places.admit(connection, time.monotonic())
        self._close_later(evicted)
        if not admitted:
            await connection.close(CloseCode.TRY_AGAIN_LATER, "too many pages; see page.clients")
            return
        try:
            await handle(connection)
        finally:
            places.release(connection)

    def _close_later(self, connection: ServerConnection | None) -> None:
        """Close a connection without waiting for its answer: a mute one gives none."""
        if connection is None:
            return
        task = asyncio.create_task(
            connection.close(CloseCode.TRY_AGAIN_LATER, "others need the place")
        )
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    async def _send_newest(
        self, connection: ServerConnection, newest: LatestValue[Any], most_undrawn: int
    ) -> None:
        """Send the newest values, no more than `most_undrawn` ahead of those that the page has drawn."""
        window = SendWindow(most_undrawn)

        async def listen() -> None:
            async for text in connection:
                self._watchers.note_heard(connection, time.monotonic())
                if not str(text).isdecimal():
                    await connection.close(CloseCode.POLICY_VIOLATION, "malformed")
                    return
                window.note_drawn(int(text))

        async def speak() -> None:
            number = sent = 0
            while True:
                await window.wait()
                number, message = await newest.wait_after(number)
                sent += 1
                window.note_sent(sent)
                await connection.send(message)

        await _run_both(listen(), speak())

    async def _take_requests(self, connection: ServerConnection) -> None:
        async for text in connection:
            await connection.send(json.dumps(await self._submit(text)))

    async def _check_token(self, connection: ServerConnection) -> bool:
        """Ask for the token; close the connection where it is wrong or does not come."""
        self._close_later(self._unproven.admit(connection, time.monotonic())[1])
        try:
            given = json.loads(await asyncio.wait_for(connection.recv(), TOKEN_PATIENCE_S))
        except (ValueError, TimeoutError):
            given = None
        finally:
            self._unproven.release(connection)
        token = given.get("token") if isinstance(given, dict) else None
        if access.compare_tokens(token, self._token):
            return True
        async with self._guess:  # one guess at a time, whoever guesses
            await asyncio.sleep(WRONG_TOKEN_S)
        log.warning("refused a page with a wrong token")
        await connection.close(CloseCode.POLICY_VIOLATION, "token")
        return False

    async def _submit(self, text: str | bytes) -> dict[str, str]:
        """Check a request against the state now, not the one on the page; return the answer."""
        request = access.parse_request(text)
        if request is None:
            return {"refused": "malformed", "kind": ""}
        reason = access.find_refusal(request, self._feed.read_state())
        if reason is None and not self._feed.submit(request):
            reason = "nowhere" if request.kind == "point" else "busy"
        if request.kind == "stop" and not await self._wait_for_stop():
            reason = "unconfirmed"
        log.info("%s %s: %s", request.kind, request.value, reason or "done")
        if reason:
            return {"refused": reason, "kind": request.kind}
        return {"done": request.kind, "kind": request.kind}

    async def _wait_for_stop(self) -> bool:
        """Return whether the guard confirms the stop in time."""
        until_s = time.monotonic() + CONFIRM_S
        while not self._feed.confirms_stop():
            if time.monotonic() > until_s:
                return False
            await asyncio.sleep(CONFIRM_POLL_S)
        return True


async def _run_both(
    listen: Coroutine[None, None, None], speak: Coroutine[None, None, None]
) -> None:
    """Run both directions of a connection until one ends."""
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
