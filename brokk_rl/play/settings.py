"""Settings of `mode=play`."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Interval

from brokk_rl.session import Device
from brokk_rl.spec import Positive, Seed, WorldCount, spec

SPEEDS = (0.1, 10.0)
"""Slowest and fastest time; chosen by hand."""
PORTS = (1024, 65535)
"""Ports that a person without special rights may use."""


@spec
class PlaySettings:
    """Page, worlds and pace of `mode=play`.

    Attributes:
        port: Port of the page, on this computer only.
        worlds: Machines that are simulated side by side.
        speed: Share of real time at first.
        driver: Who drives at first: `policy`, `classical` or `person`.
        neutral: Whether effects begin switched off instead of drawn as in training.
        seed: Seed of starts and noise.
        device: Where to simulate, as `session.device`.
        seconds: Time until it ends by itself; `null` for until it is interrupted.
    """

    port: Annotated[int, Interval(ge=PORTS[0], le=PORTS[1])]
    worlds: WorldCount
    speed: Annotated[float, Interval(ge=SPEEDS[0], le=SPEEDS[1])]
    driver: Literal["policy", "classical", "person"]
    neutral: bool
    seed: Seed
    device: Device
    seconds: Positive | None
