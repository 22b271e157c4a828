"""Relay between a page that wants video and the video process: an extension of the page's server.

The server asks the page for its token before any of this. The offer comes in pieces, since the
server takes no long message from anybody.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path

from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode

from deploy.video.settings import SOCKET

PATH = "/video"
LONGEST_OFFER = 1 << 16
"""Bytes of an offer in all."""
PATIENCE_S = 10.0
"""Time for the video process to answer. Chosen by hand: it starts its encoders meanwhile."""
IDLE_S = 3600.0


class VideoRelay:
    """WebSocket by which pages and video process exchange their offers; a `PageExtension`.

    Args:
        folder: Holds the socket of the video process.
    """

    def __init__(self, folder: str) -> None:
        self.files: Mapping[str, tuple[str, bytes]] = {}
        self.path = PATH
        self._socket = Path(folder) / SOCKET

    async def talk(self, connection: ServerConnection) -> None:
        """Hand on offers and answers; the pictures end with this connection."""
        try:
            reader, writer = await asyncio.open_unix_connection(self._socket, limit=LONGEST_OFFER)
        except OSError:
            await connection.close(CloseCode.TRY_AGAIN_LATER, "no video process")
            return
        try:
            await self._hand_on(connection, reader)
            pieces: list[str] = []
            async for piece in connection:
                pieces.append(str(piece))
                if sum(map(len, pieces)) > LONGEST_OFFER // 2:
                    break
                if piece:
                    continue
                writer.write(json.dumps({"sdp": "".join(pieces)}).encode() + b"\n")
                pieces.clear()
                await self._hand_on(connection, reader)
        except (OSError, TimeoutError):
            await connection.close(CloseCode.TRY_AGAIN_LATER, "the video process does not answer")
        finally:
            writer.close()

    async def _hand_on(self, connection: ServerConnection, reader: asyncio.StreamReader) -> None:
        line = await asyncio.wait_for(reader.readline(), PATIENCE_S)
        if not line:
            raise ConnectionError("the video process has gone")
        await connection.send(line.decode())

    async def run(self) -> None:
        """Do nothing until cancelled: there is nothing to do without a page."""
        while True:
            await asyncio.sleep(IDLE_S)
