"""The video process: sends each page its cameras by WebRTC, as H.264.

Pages reach it through the page's server only, which asks for the token: it hands on a page's offer
by a socket of the file system, and the answer back. When that connection ends, so do the pictures.
The process has a low priority and touches nothing of the loop.
If it hangs or dies, the page greys the pictures, and the loop feels nothing.

aiortc carries the pictures: lost packets are sent again on request, and the receiver's estimate of
the link sets the bit rate of its encoder. The page asks for H.264.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import time
from pathlib import Path
from typing import Any

from aiortc import MediaStreamTrack, RTCConfiguration, RTCPeerConnection, RTCSessionDescription  # pyright: ignore[reportMissingImports]

from deploy.runtime.process import Stop
from deploy.runtime.shm_layout import LoopMemory
from deploy.video.settings import SOCKET, VideoSettings
from deploy.video.sources import CameraReader

log = logging.getLogger(__name__)

NICENESS = 10
"""Below everything else on the computer: late pictures are harmless."""
POLL_S, STOP_POLL_S = 0.003, 0.05
"""Between looks for a new picture, a fifth of a screen's frame; and between looks whether to stop."""
LONGEST_OFFER = 1 << 16
"""Bytes of an offer; a browser's has 10 kB for two cameras."""


class CameraTrack(MediaStreamTrack):
    """The pictures of one camera for one page: always the newest one, none twice.

    Args:
        reader: The camera.
        report: Called with the number of a picture, in units of its RTP time, and the time at which
            it was taken.
    """

    kind = "video"

    def __init__(self, reader: CameraReader, report: Any) -> None:
        super().__init__()
        self._reader, self._report, self._number = reader, report, reader.number

    async def recv(self) -> Any:
        """Wait for the next picture and return it."""
        while self._reader.number == self._number:
            await asyncio.sleep(POLL_S)
        self._number = self._reader.number
        frame, t_s = self._reader.read_newest()
        # Its RTP time is that and an offset, which the page finds out.
        self._report(frame.pts, t_s)
        return frame


class VideoPeer:
    """One page that watches.

    Args:
        readers: The cameras.
    """

    def __init__(self, readers: list[CameraReader]) -> None:
        # An empty list: without one aiortc would ask a public STUN server for our address.
        self._connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._readers, self._channel = readers, None
        self._connection.on("datachannel", self._take_channel)

    async def answer(self, offer: str) -> str:
        """Return the answer to a page's offer; its video sections stand for the cameras in order."""
        await self._connection.setRemoteDescription(
            RTCSessionDescription(hide_local_names(offer), "offer")
        )
        waiting = [one for one in self._connection.getTransceivers() if one.kind == "video"]
        for index, (transceiver, reader) in enumerate(zip(waiting, self._readers, strict=False)):
            transceiver.sender.replaceTrack(CameraTrack(reader, self._make_report(index)))
            transceiver.direction = "sendonly"
        await self._connection.setLocalDescription(await self._connection.createAnswer())
        return self._connection.localDescription.sdp

    async def close(self) -> None:
        """End the pictures of this page."""
        await self._connection.close()

    def _take_channel(self, channel: Any) -> None:
        """Take the page's channel; it compares clocks and learns when pictures were taken."""
        self._channel = channel

        @channel.on("message")
        def answer_ping(text: Any) -> None:
            with contextlib.suppress(ValueError, TypeError, KeyError):
                at_ms = float(json.loads(text)["at_ms"])
                channel.send(json.dumps({"at_ms": at_ms, "now_s": time.monotonic()}))

    def _make_report(self, index: int) -> Any:
        def report(pts: int, taken_s: float) -> None:
            channel = self._channel
            # A channel that is behind would only report on pictures of the past.
            if channel is not None and channel.readyState == "open" and not channel.bufferedAmount:
                channel.send(json.dumps({"camera": index, "pts": pts, "taken_s": taken_s}))

        return report


def hide_local_names(offer: str) -> str:
    """Return an offer without candidates that have a name of mDNS in place of an address.

    A browser hides its addresses so. It finds the way by itself, from our addresses, and asking
    the network for the name would cost seconds.
    """
    lines = offer.splitlines(keepends=True)
    return "".join(one for one in lines if not (one.startswith("a=candidate") and ".local " in one))


def run(stop: Stop, video: VideoSettings, folder: str, memory: LoopMemory | None = None) -> None:
    """Send pictures until asked to stop.

    Args:
        stop: Returns whether to stop.
        video: The cameras.
        folder: For the socket; only its owner may enter.
        memory: Of the loop; not needed.
    """
    os.nice(NICENESS)
    logging.getLogger("aioice").setLevel(logging.WARNING)
    asyncio.run(_serve(stop, video, Path(folder) / SOCKET))


def _tell(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error of aiortc's own tasks in a line: a page that goes while it connects ends in one."""
    log.warning("%s", context.get("exception") or context["message"])


async def _serve(stop: Stop, video: VideoSettings, path: Path) -> None:
    asyncio.get_running_loop().set_exception_handler(_tell)
    readers = []
    for name, camera in video.cameras.items():
        readers.append(CameraReader(name, camera))
    watching: set[VideoPeer] = set()

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = VideoPeer(readers)
        try:
            full = len(watching) >= video.viewers
            watching.add(peer)
            hello = {"full": True} if full else {"cameras": list(video.cameras)}
            writer.write(json.dumps(hello).encode() + b"\n")
            while not full and (line := await reader.readline()):
                answer = await peer.answer(json.loads(line)["sdp"])
                writer.write(json.dumps({"sdp": answer}).encode() + b"\n")
        except (ValueError, KeyError, ConnectionError) as error:
            log.warning("refused a page's offer: %s", error)
        finally:
            watching.discard(peer)
            await peer.close()
            writer.close()

    async with await asyncio.start_unix_server(talk, path, limit=LONGEST_OFFER):
        log.info("%s by WebRTC", ", ".join(video.cameras))
        while not stop():
            await asyncio.sleep(STOP_POLL_S)
        await asyncio.gather(*(peer.close() for peer in watching))
