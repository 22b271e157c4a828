"""How the page is served and what it looks like: the spec in `conf/page`."""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.page.protocol import PageFeed
from deploy.page.scene import describe_geometry
from deploy.page.server import PageExtension, PageServer

LINK = "page.url"
"""File in the run folder with the address that carries the token; only its owner may read it."""


@spec
class PageSettings:
    """The operator's page.

    Attributes:
        host: Address to listen on. 127.0.0.1: this computer only; anything else opens it to a
            network, unencrypted.
        port: TCP port; 0: any free one.
        names: Further names that browsers may use for this computer, where `host` is not this
            computer's alone.
        token: What a browser must show to have something done; `null`: a new one each time, in the
            link that is shown at the start.
        language: `auto`: the browser's.
        rate_hz: Fastest rate of levers and state; what changes is sent at once up to that.
        frames_hz: Fastest rate of camera pictures and point clouds.
        picture_px: Width of what is sent of them.
        jpeg_quality: Of the picture, 1 to 100.
        points: Points to draw at most; every second pixel, third, … is drawn until that is kept.
        tolerance: Distance of own lever and advice, of full, up to which they count as together.
        borehole_radius_m: Of boreholes of which only the centre is known.
        stale_s: Silence of the server from which the page greys everything.
        clients: Pages that can be open at once.
    """

    host: str
    port: int
    names: tuple[str, ...]
    token: str | None
    language: Literal["auto", "en", "de"]
    rate_hz: float
    frames_hz: float
    picture_px: int
    jpeg_quality: int
    points: int
    tolerance: float
    borehole_radius_m: float
    stale_s: float
    clients: int

    def check(self) -> None:
        if not 0 <= self.port < 65536:
            raise ConfigError(f"page.port: expected 0 to 65535, got {self.port}")
        if self.token is not None and len(self.token) < 16:
            raise ConfigError(
                "page.token: expected at least 16 characters, or null for a new one each time"
            )
        if (
            min(self.rate_hz, self.frames_hz, self.stale_s, self.tolerance) <= 0
            or min(self.points, self.clients) < 1
        ):
            raise ConfigError("page: rates, stale_s, tolerance, points and clients are more than 0")
        if not 1 <= self.jpeg_quality <= 100 or not 16 <= self.picture_px <= 4096:
            raise ConfigError("page: expected jpeg_quality in 1 … 100 and picture_px in 16 … 4096")

    def serve(
        self,
        stop: Callable[[], bool],
        machine: Machine,
        feed: PageFeed,
        session: Session,
        tell: Callable[[str], None],
        annex: PageExtension | None = None,
    ) -> None:
        """Serves the page, and what `annex` has, until `stop` says so or a person stops it.

        It tells the link to open, and leaves it in `page.url`.

        Raises:
            LinkError: the address is taken or not this computer's.
        """
        token = self.token or secrets.token_urlsafe(24)

        def ready(port: int) -> None:
            address = build_link(self, port, token)
            write_link(session, address)
            tell(address)

        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(PageServer(self, machine, feed, token, annex).run(stop, ready))

    def setup(self, machine: Machine) -> dict[str, Any]:
        """Returns what a page needs to know once, as plain data; nothing secret."""
        return {
            "machine": machine.name, "title": machine.title, "joints": list(machine.joint_names),
            "exclusive": list(machine.exclusive), "geometry": describe_geometry(machine), "language": self.language,
            "tolerance": self.tolerance, "stale_s": self.stale_s, "points": self.points,
            "axes": {f"{lever.side}_{lever.axis}": lever.max_angle_rad for lever in machine.levers},
            "shared": {
                f"{side}_{axis}": [lever.joint for lever in machine.levers if (lever.side, lever.axis) == (side, axis)]
                for side in ("left", "right") for axis in ("theta", "psi")
            },
        }  # fmt: skip


def build_link(page: PageSettings, port: int, token: str) -> str:
    """Returns the address to open; the token stands behind `#`, which browsers keep to themselves."""
    host = (
        "localhost"
        if page.host in ("127.0.0.1", "::1")
        else (page.names[0] if page.names else page.host)
    )
    return f"http://{host}:{port}/#token={token}"


def write_link(session: Session, address: str) -> Path:
    """Writes the link into the run folder for its owner alone; returns the file."""
    path = session.folder / LINK
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        file.write(address + "\n")
    return path
