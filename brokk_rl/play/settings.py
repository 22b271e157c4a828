"""Settings of `mode=play`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from brokk_rl.errors import ConfigError
from brokk_rl.gamepad import Gamepad
from brokk_rl.machine import Machine
from brokk_rl.session import Session
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
        gamepad: Device of a gamepad of this computer; `null` for none.
        gamepad_axes: Axis of the gamepad for each joint, in machine order.
        seed: Seed of starts and noise.
        device: Where to simulate, as `session.device`.
        seconds: Time until it ends by itself; `null` for until it is interrupted.
    """

    port: Annotated[int, Interval(ge=PORTS[0], le=PORTS[1])]
    worlds: WorldCount
    speed: Annotated[float, Interval(ge=SPEEDS[0], le=SPEEDS[1])]
    driver: Literal["policy", "classical", "person"]
    neutral: bool
    gamepad: str | None
    gamepad_axes: tuple[int, ...]
    seed: Seed
    device: str
    seconds: Positive | None

    def check(self) -> None:
        Session(out=".", seed=self.seed, device=self.device)  # refuses an unknown device
        if self.gamepad is not None:
            Gamepad(Path(self.gamepad), "play.gamepad").close()

    def check_machine(self, machine: Machine) -> None:
        """Refuse a gamepad without an axis for each joint."""
        if self.gamepad is not None and len(self.gamepad_axes) != machine.num_joints:
            raise ConfigError(
                f"play.gamepad_axes: expected an axis for each of "
                f"{', '.join(machine.joint_names)}, got {len(self.gamepad_axes)}: "
                f"{list(self.gamepad_axes)}"
            )
