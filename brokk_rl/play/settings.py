"""Settings of `mode=play`."""

from __future__ import annotations

from typing import Literal

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

SPEEDS = (0.1, 10.0)
"""Slowest and fastest time; chosen by hand."""
PORTS = (1024, 65535)
"""Ports that a person without special rights may use."""


@spec
class PlaySettings:
    """Viewer, worlds and pace of `mode=play`.

    Attributes:
        viewer: A page in a browser, or MuJoCo's window.
        port: Port of the page, on this computer only.
        worlds: Machines that are simulated side by side.
        speed: Share of real time at first.
        driver: Who drives at first: `policy`, `classical` or `person`.
        neutral: Whether effects begin switched off instead of drawn as in training.
        gamepad: Device of a gamepad of this computer; `null` for none.
        gamepad_axes: Axis of the gamepad for each joint, in machine order.
        seed: Seed of starts and noise.
        device: Where to simulate, as `session.device`.
        seconds: Time until it ends by itself; `null` for until it is interrupted.
    """

    viewer: Literal["browser", "window"]
    port: int
    worlds: int
    speed: float
    driver: Literal["policy", "classical", "person"]
    neutral: bool
    gamepad: str | None
    gamepad_axes: tuple[int, ...]
    seed: int
    device: str
    seconds: float | None

    def check(self) -> None:
        if not PORTS[0] <= self.port <= PORTS[1]:
            raise ConfigError(f"play.port: expected {PORTS[0]} to {PORTS[1]}, got {self.port}")
        if self.worlds < 1:
            raise ConfigError(f"play.worlds: expected 1 or more, got {self.worlds}")
        if not SPEEDS[0] <= self.speed <= SPEEDS[1]:
            raise ConfigError(f"play.speed: expected {SPEEDS[0]} to {SPEEDS[1]}, got {self.speed}")
        if self.seed < 0:
            raise ConfigError(f"play.seed: expected 0 or more, got {self.seed}")
        if self.seconds is not None and self.seconds <= 0:
            raise ConfigError(f"play.seconds: expected more than 0 or null, got {self.seconds}")
