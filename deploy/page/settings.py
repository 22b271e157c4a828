"""Settings of the operator's page: the spec in `conf/page`."""

from __future__ import annotations

from typing import Any, Literal

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from deploy.guidance import AXES
from deploy.page.scene import describe_geometry

LINK = "page.url"
"""File in the run folder with the address that carries the token; only its owner may read it."""
LAST_PORT = 65535
LEAST_TOKEN = 16
"""Characters of a token; 16 of base64 are 96 bits."""
LEAST_PX, MOST_PX = 16, 4096
"""Width of a picture that is sent. Chosen by hand: no camera is narrower or wider."""


@spec
class PageSettings:
    """The operator's page.

    Attributes:
        host: Address to listen on. 127.0.0.1: this computer only; anything else opens it to a
            network, unencrypted.
        port: TCP port; 0: any free one.
        names: Further names that browsers may use for this computer, where `host` is not this
            computer's alone.
        token: Secret that a browser must show with a request; `null`: a new one each time, in the
            link that is shown at the start.
        language: `auto`: the browser's.
        rate_hz: Fastest rate of levers and state; changes are sent at once up to that.
        frames_hz: Fastest rate of camera pictures and point clouds.
        picture_px: Width to which they are shrunk.
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
        if not 0 <= self.port <= LAST_PORT:
            raise ConfigError(f"page.port: expected 0 to {LAST_PORT}, got {self.port}")
        if self.token is not None and len(self.token) < LEAST_TOKEN:
            raise ConfigError(
                f"page.token: expected at least {LEAST_TOKEN} characters, or null for a new one each time"
            )
        smallest = min(self.rate_hz, self.frames_hz, self.stale_s, self.tolerance)
        if smallest <= 0 or min(self.points, self.clients) < 1:
            raise ConfigError("page: rates, stale_s, tolerance, points and clients are more than 0")
        if not 1 <= self.jpeg_quality <= 100 or not LEAST_PX <= self.picture_px <= MOST_PX:
            raise ConfigError(
                f"page: expected jpeg_quality in 1 … 100 and picture_px in {LEAST_PX} … {MOST_PX}"
            )

    def describe_setup(self, machine: Machine) -> dict[str, Any]:
        """Return the plain data that a page needs once; nothing secret."""
        shared: dict[str, list[str]] = {f"{side}_{axis}": [] for side, axis in AXES}
        for lever in machine.levers:
            shared[f"{lever.side}_{lever.axis}"].append(lever.joint)
        return {
            "machine": machine.name,
            "title": machine.title,
            "joints": list(machine.joint_names),
            "parts": {joint.name: joint.part for joint in machine.joints},
            "exclusive": list(machine.exclusive),
            "button": any(lever.joint in machine.exclusive for lever in machine.levers),
            "geometry": describe_geometry(machine),
            "language": self.language,
            "tolerance": self.tolerance,
            "stale_s": self.stale_s,
            "points": self.points,
            "axes": {f"{lever.side}_{lever.axis}": lever.max_angle_rad for lever in machine.levers},
            "shared": shared,
        }
