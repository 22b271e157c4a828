"""Settings of the operator's page: the spec in `conf/page`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Interval

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Count, Positive, spec
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
        rate_hz: Rate of levers and state; a new advice is sent at once.
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
    port: Annotated[int, Interval(ge=0, le=LAST_PORT)]
    names: tuple[str, ...]
    token: str | None
    language: Literal["auto", "en", "de"]
    rate_hz: Positive
    frames_hz: Positive
    picture_px: Annotated[int, Interval(ge=LEAST_PX, le=MOST_PX)]
    jpeg_quality: Annotated[int, Interval(ge=1, le=100)]
    points: Count
    tolerance: Positive
    borehole_radius_m: Positive
    stale_s: Positive
    clients: Count

    def check(self) -> None:
        if self.token is not None and len(self.token) < LEAST_TOKEN:
            raise ConfigError(
                f"token: expected at least {LEAST_TOKEN} characters, or null for a new one each time"
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
