"""A stage for faults: twin, bus process and policy as they are, in one process, on a bus of air and a clock that is told the time.

What takes seconds with real processes takes milliseconds here and comes out the same each time;
times are exact to a millisecond.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from composed import option

from actuators.excite.player import NominalMachine
from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from deploy.bus.can_bus import CanBus, CanFrame
from deploy.policy.bundle import PolicyBundle
from deploy.policy.policy_process import PolicyAdviser, PolicyProcessConfig
from deploy.runtime.bus_process import BusProcess, BusProcessConfig
from deploy.runtime.operator_state import LoopSnapshot
from deploy.runtime.shm_layout import LoopMemory
from deploy.twin.faults import FaultPort
from deploy.twin.twin import RunningTwin, Twin

DBC = "deploy:dbc/example_gateway.dbc"
NO_WIRE = CanBus(interface="virtual", channel="air", bitrate=None, port=None)
BEGIN_S = 65.536 * 20 - 1.0
"""The gateway's clock wraps a second after the beginning."""
WANTED = (0.3, 0.0, -0.3, 0.0, 0.2)

Mode = Literal["listen", "auto", "collect"]
"""Nothing is ever sent; the policy commands; somebody else does, as `mode=collect link=can`."""


class Air:
    """What the bus process sees of the bus."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.inbox: deque[CanFrame] = deque()
        self.sent: list[CanFrame] = []
        self.broken = self.echo = False
        self.interface, self.channel = "air", "1"

    def open(self, frame_ids: Any) -> Air:
        if self.broken:
            raise LinkError("bus: cannot be opened")
        self.inbox.clear()
        return self

    def recv(self, timeout_s: float) -> CanFrame | None:
        end_ms = self._stage.ms + max(1, round(1e3 * timeout_s))
        while True:
            if self.broken:
                raise LinkError("bus: the controller has gone off the bus (bus-off)")
            if self.inbox:
                return self.inbox.popleft()
            if self._stage.ms >= end_ms:
                return None
            self._stage.tick()

    def send(self, frame: CanFrame) -> None:
        if self.broken:
            raise LinkError("bus: cannot send")
        self.sent.append(frame)
        self._stage.twin.hear(frame, self._stage.now_s)
        if self.echo:
            self.inbox.append(frame)

    def close(self) -> None: ...


class Gateway:
    """What the twin sees of it."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage

    def recv(self, timeout_s: float) -> None: ...

    def send(self, frame: CanFrame) -> None:
        self._stage.air.inbox.append(frame)


class Stage:
    """The parts together.

    Args:
        machine: The machine.
        mode: Who commands.
        folder: Where a session may write.
        again_s: When the operator who is not followed presses the dead-man again.
    """

    def __init__(
        self, machine: Machine, mode: Mode, folder: Path, again_s: float | None = None
    ) -> None:
        self.machine, self.mode, self.ms = machine, mode, 0
        self.memory = LoopMemory.new(machine.num_joints, commands=mode != "listen")
        self.air, self.request_s, self.wanted = Air(self), 0.05, WANTED
        self.stopped_ms: int | None = None
        self._times = 0
        with self._time():
            twin = Twin(
                wire=NO_WIRE,
                dbc=DBC,
                remote=True,
                deadman=True,
                again_s=again_s,
                fault_port=None,
                seconds=None,
                realtime=False,
            )
            link = NominalMachine().build(
                machine, 1, Session(out=str(folder), seed=0, device="cpu")
            )
            self.twin = RunningTwin(twin, machine, link, Gateway(self), FaultPort(None))
            limits, wire = option("guard", "default"), self.air
            self.bus_process = BusProcess(BusProcessConfig(wire, DBC, machine, limits), self.memory)  # type: ignore[arg-type]
            policy = "tasks:policies/borehole_insertion"
            counsel = PolicyProcessConfig(
                machine, policy, option("guidance", "machine"), limits.joints_s, 600.0, None
            )
            self.adviser = PolicyAdviser(counsel, PolicyBundle(policy, machine), self.memory)
            if mode == "collect":
                self.adviser = None
            self._write("target", t_s=self.now_s, center_in_base_m=(2.6, 0.0, 0.75))
            self._write("controls", t_s=self.now_s, armed=mode != "listen")

    @property
    def now_s(self) -> float:
        return BEGIN_S + self.ms / 1e3

    def go(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Lets time go by."""
        end_ms = self.ms + round(1e3 * seconds)
        with self._time():
            while self.ms < end_ms and not until():
                self.bus_process.receive()
                self.bus_process._timer.begin()
                self.bus_process.run_cycle()

    def pause(self, seconds: float) -> None:
        """Lets time go by in which the bus process stands still: stopped, asleep, or without a processor."""
        with self._time():
            for _ in range(round(1e3 * seconds)):
                self.tick()

    def tick(self) -> None:
        """Lets a millisecond go by."""
        self.ms += 1
        if self.ms % 10 == 0:
            self.twin.cycle(self.now_s)
        if self.mode != "collect" and self.ms % 50 == 3 and self.adviser is not None:
            self.adviser.run_cycle(0, self.now_s)
        if self.mode == "collect" and self.ms % round(1e3 * self.request_s) == 3:
            self._write("request", t_s=self.now_s, u=self.wanted)
        if not self.moves:
            self.stopped_ms = self.ms if self.stopped_ms is None else self.stopped_ms
        else:
            self.stopped_ms = None

    @property
    def moves(self) -> bool:
        """Whether the valves get anything now."""
        return bool(self.twin._flow.any())

    def fault(self, fault: str, message: str = "") -> None:
        """Switches a fault on, or all off (`none`)."""
        text = json.dumps({"fault": fault, "message": message}).encode()
        self.twin._faults.request(text, self.now_s)

    def get_going(self) -> None:
        """Goes the operator's way until the machine moves; where nothing is sent, until there is an advice."""
        self.fault("none")
        self._times += 1
        side = 1 - 2 * (
            self._times % 2
        )  # to and fro: no joint comes to its end, no policy to its goal
        self.air.broken, self.air.echo, self.request_s = False, False, 0.05
        self.wanted = tuple(side * u for u in WANTED)
        self._write("target", t_s=self.now_s, center_in_base_m=(2.5, 0.7 * side, 0.75))
        self.go(0.4)
        self.go(
            1.2, lambda: bool(self.memory.state.peek("alone"))
        )  # a second sender is remembered for a second
        if self.mode != "collect":
            self.go(2.0, lambda: self.advised)
            assert self.advised, self.view
        if self.mode == "listen":
            return
        self.fault("deadman_released")
        self.go(0.1)
        self.fault("none")
        self.go(3.0, lambda: self.moves)
        self.go(0.3)
        assert self.moves, self.view

    def stops_within_s(self, seconds: float = 0.6) -> float:
        """Returns how long it takes from now until the valves get nothing any more, for good."""
        begun_ms = self.ms
        self.go(seconds)
        assert self.stopped_ms is not None, f"moves after {seconds} s: {self.view}"
        return max(0, self.stopped_ms - begun_ms) / 1e3

    @property
    def view(self) -> LoopSnapshot:
        with self._time():
            return self.memory.read_snapshot()

    @property
    def advised(self) -> bool:
        """Whether an advice is shown."""
        advice = self.view.advice
        return advice is not None and advice.valid

    def close(self) -> None:
        self.memory.close()

    def _write(self, name: str, **values: Any) -> None:
        slot = getattr(self.memory, name)
        record = slot.new()
        if name == "target":
            for key, value in values.items():
                record[key] = np.asarray(value)
        else:
            record = replace(record, **values)
        slot.write(record)

    @contextmanager
    def _time(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(time, "monotonic", lambda: self.now_s)
            patch.setattr(
                time,
                "sleep",
                lambda seconds: [self.tick() for _ in range(max(1, round(1e3 * seconds)))],
            )
            yield
