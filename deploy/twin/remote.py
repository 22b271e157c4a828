"""The radio remote as a node of its own, and a simulated operator who holds it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from brokk_rl.contracts.actuator import Follower
from brokk_rl.machine import Machine
from deploy.bus.can_bus import CanBus, CanFrame
from deploy.bus.description import LEVER_AXES, BusDescription
from deploy.guidance import AXES, LeverMap
from deploy.runtime.process import CycleTimer, Stop
from deploy.runtime.shm_layout import LoopMemory
from deploy.twin.gateway import find_axis_full_rad


class RadioRemote:
    """Makes the remote's messages.

    Args:
        description: The bus.

    Attributes:
        levers: Deflections of the four axes, of full.
        button_right: Whether the right button is held.
        deadman: Whether the dead-man is held.
        on: Whether it is switched on.
    """

    def __init__(self, description: BusDescription) -> None:
        self._description = description
        self._layout = description.layouts[description.message_of("DeadMan")]
        self.period_s = self._layout.period_s
        self.levers: Sequence[float] = (0.0,) * len(AXES)
        self.button_right = self.deadman = False
        self.on = True
        self._counter = 0

    def frame(self, frozen: int | None = None) -> CanFrame:
        """Return the next message; `frozen` is a counter that stands still, a fault."""
        values: dict[str, float] = {
            f"Lever_{axis}": value for axis, value in zip(LEVER_AXES, self.levers, strict=True)
        }
        values |= {"ButtonRight": self.button_right, "DeadMan": self.deadman, "RemoteOn": self.on}
        self._counter = self._counter + 1 if frozen is None else frozen
        return CanFrame(
            self._layout.frame_id,
            self._description.encode(self._layout.name, values, self._counter),
            self._layout.extended,
        )


def run_operator(
    stop: Stop,
    wire: CanBus,
    dbc: str,
    machine: Machine,
    follower: Follower,
    levers: LeverMap,
    seed: int,
    memory: LoopMemory,
) -> None:
    """Run a simulated operator: reads the outlet as a person reads the page, and moves the levers as `follower` says.

    He lets go of the levers where the advice is stale or none.
    """
    import torch

    torch.manual_seed(seed)
    description = BusDescription(dbc, machine)
    remote, hands = RadioRemote(description), follower.build(machine, 1, torch.device("cpu"))
    per_period = round(machine.period_s / remote.period_s)
    full_rad, pace, cycle = find_axis_full_rad(machine), CycleTimer(remote.period_s), 0
    remote.deadman = True
    own = LeverMap(
        machine.levers, machine
    )  # what he moves is the machine's remote, whatever pattern is shown
    with wire.open([]) as bus:
        while not stop():
            pace.wait()
            pace.begin()
            if cycle % per_period == 0:
                with torch.inference_mode():
                    proposed = torch.as_tensor(
                        _read_displayed_command(memory, levers), dtype=torch.float32
                    )[None]
                    given = hands.step(proposed)[0].numpy().astype(float)
                angles_rad, remote.button_right = own.levers(given)
                remote.levers = (angles_rad / full_rad).clip(-1.0, 1.0).tolist()
            cycle += 1
            bus.send(remote.frame())


def _read_displayed_command(memory: LoopMemory, levers: LeverMap) -> np.ndarray:
    """Return the commands that the shown lever positions stand for."""
    advice: Any = memory.advice.read()
    if advice is None or time.monotonic() - float(advice["t_s"]) > 0.5:
        return np.zeros(len(levers.full_rad))
    return levers.command(np.array(advice["lever_rad"]), bool(advice["button_right"]))
