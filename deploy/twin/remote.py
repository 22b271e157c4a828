"""The radio remote as a node of its own, and who holds it: a simulated operator, or a gamepad."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from brokk_rl.contracts.actuator import Follower
from brokk_rl.errors import ConfigError
from brokk_rl.gamepad import Gamepad
from brokk_rl.machine import Machine
from brokk_rl.spec import Index, spec
from deploy.bus.can_bus import CanBus, CanFrame, OpenCanBus
from deploy.bus.description import LEVER_AXES, STAMP, BusDescription
from deploy.guidance import AXES, LeverMap
from deploy.kernel.protection import MessageFault
from deploy.runtime.process import CycleTimer, Stop
from deploy.runtime.shm_layout import LoopMemory

log = logging.getLogger(__name__)

STALE_S = 0.5
"""Age of an advice from which the operator does not follow it. Chosen by hand: a person notices."""


class RadioRemote:
    """The remote's side of the bus.

    Args:
        description: The bus.
        machine: The machine.

    Attributes:
        machine: The machine.
        map: Its mapping of levers to commands.
        levers: Deflections of the four axes, of full.
        button_right: Whether the right button is held.
        deadman: Whether the dead-man is held.
        on: Whether it is switched on.
        is_ready: Whether it has heard the gateway's clock. Before that its stamps would look like
            those of late copies, so it sends nothing.
    """

    def __init__(self, description: BusDescription, machine: Machine) -> None:
        self.machine, self.map = machine, LeverMap(machine)
        self._description = description
        self._layout = description.layouts[description.message_of("DeadMan")]
        self.period_s = self._layout.period_s
        self.levers: Sequence[float] = (0.0,) * len(AXES)
        self.button_right = self.deadman = False
        self.on = True
        self._counter, self._stamp_s = 0, 0.0
        self._heard = description.layouts[description.message_of("EStop")]
        self.is_ready = not self._heard.stamp_wrap_s

    @property
    def frame_ids(self) -> list[int]:
        """Identifier of the message from which it takes the gateway's clock."""
        return [self._heard.frame_id]

    def move_levers(self, u: np.ndarray) -> None:
        """Move the levers to where they stand for commands, `(J,)`; press the button with them."""
        angles_rad, self.button_right = self.map.levers(u)
        self.levers = (angles_rad / self.map.axis_full_rad).clip(-1.0, 1.0).tolist()

    def hear(self, frame: CanFrame) -> None:
        """Take the gateway's clock from its status; other frames are ignored."""
        if frame.frame_id != self._heard.frame_id or not self._heard.stamp_wrap_s:
            return
        values = self._description.decode(self._heard, frame.data)
        if not isinstance(values, MessageFault):
            # The last one, not the largest: the gateway's clock may be set back.
            self._stamp_s, self.is_ready = values[STAMP], True

    def iterate_cycles(self, stop: Stop, bus: OpenCanBus) -> Iterator[float]:
        """Yield the time at which each message is due, then send it, until told to stop; listen in between."""
        timer = CycleTimer(self.period_s)
        while not stop():
            while (left_s := timer.next_s - time.monotonic()) > 0:
                frame = bus.recv(left_s)
                if frame is not None:
                    self.hear(frame)
            timer.begin()
            yield time.monotonic()
            if self.is_ready:
                bus.send(self.build_frame())

    def build_frame(self, frozen: int | None = None) -> CanFrame:
        """Return the next message; `frozen` is a counter that stands still, a fault."""
        values: dict[str, float] = {}
        for axis, value in zip(LEVER_AXES, self.levers, strict=True):
            values[f"Lever_{axis}"] = value
        values |= {"ButtonRight": self.button_right, "DeadMan": self.deadman, "RemoteOn": self.on}
        values[STAMP] = self._stamp_s
        self._counter = self._counter + 1 if frozen is None else frozen
        return CanFrame(
            self._layout.frame_id,
            self._description.encode(self._layout.name, values, self._counter),
            self._layout.extended,
        )


class RemoteHolder(Protocol):
    """Who holds the remote."""

    def hold_remote(self, remote: RadioRemote, cycles: Iterator[float], memory: LoopMemory) -> None:
        """Move levers, button and dead-man as long as there are cycles.

        Args:
            remote: The remote.
            cycles: Time of each cycle; what the remote is like after it is sent.
            memory: Shows what the loop shows and knows.
        """


def run_remote(
    stop: Stop, wire: CanBus, dbc: str, machine: Machine, person: RemoteHolder, memory: LoopMemory
) -> None:
    """Run the remote in the hands of a person.

    Args:
        stop: Returns whether to stop.
        wire: The bus.
        dbc: Its description.
        machine: The machine.
        person: Who holds the remote.
        memory: Of the loop.
    """
    remote = RadioRemote(BusDescription(dbc, machine), machine)
    with wire.open(remote.frame_ids) as bus:
        person.hold_remote(remote, remote.iterate_cycles(stop, bus), memory)


@dataclass(frozen=True)
class SimulatedOperator:
    """Moves the levers as `follower` follows the advice; lets go where it is stale or there is none.

    Attributes:
        follower: The operator.
        seed: Of the operator.
    """

    follower: Follower
    seed: int

    def hold_remote(self, remote: RadioRemote, cycles: Iterator[float], memory: LoopMemory) -> None:
        """See `RemoteHolder`."""
        import torch  # only here: the machine's computer has none

        torch.manual_seed(self.seed)
        hands = self.follower.build(remote.machine, 1, torch.device("cpu"))
        cycles_a_period = round(remote.machine.period_s / remote.period_s)
        remote.deadman = True
        for cycle, _ in enumerate(cycles):
            if cycle % cycles_a_period == 0:
                displayed = _read_displayed_command(memory, remote.map)
                proposed = torch.as_tensor(displayed, dtype=torch.float32)[None]
                with torch.inference_mode():
                    given = hands.step(proposed)[0].numpy().astype(float)
                remote.move_levers(given)


def _read_displayed_command(memory: LoopMemory, levers: LeverMap) -> np.ndarray:
    """Return the commands that the displayed lever positions stand for."""
    advice = memory.advice.read()
    if advice is None or time.monotonic() - advice.t_s > STALE_S:
        return np.zeros(len(levers.full_rad))
    return levers.command(advice.lever_rad, advice.button_right)


@spec
class GamepadRemote:
    """A gamepad in place of the radio remote: its sticks are the levers.

    Attributes:
        device: Of the gamepad, on this computer.
        axes: Axis of the gamepad for each of `deploy.guidance.AXES`, as in `Gamepad.read_axes`.
        deadman: Button that is the dead-man.
        button_right: Button that is the right lever's.
    """

    device: str
    axes: tuple[int, ...]
    deadman: Index
    button_right: Index

    def check(self) -> None:
        if len(self.axes) != len(AXES):
            raise ConfigError(
                f"gamepad.axes: expected an axis for each of {len(AXES)} lever axes, got {list(self.axes)}"
            )
        if self.deadman == self.button_right:
            raise ConfigError("gamepad: dead-man and right button are two buttons")

    def open_device(self) -> Gamepad:
        """Return the gamepad.

        Raises:
            ConfigError: it cannot be opened.
        """
        return Gamepad(Path(self.device), "bench.gamepad.device", "take bench=twin or bench=guided")

    def hold_remote(self, remote: RadioRemote, cycles: Iterator[float], memory: LoopMemory) -> None:
        """See `RemoteHolder`; a gamepad that is unplugged is a remote out of range: nothing more is sent."""
        gamepad = self.open_device()
        for _ in cycles:
            gamepad.poll()
            remote.levers = gamepad.read_axes(self.axes)
            remote.deadman = gamepad.is_pressed(self.deadman)
            remote.button_right = gamepad.is_pressed(self.button_right)
            if not gamepad.connected:
                log.warning("the gamepad %s is gone: the remote is silent", self.device)
                break
        gamepad.close()
