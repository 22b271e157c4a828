"""A stage for faults: twin, bus process and policy as they are, in one process, on a bus of air and a clock that is told the time.

What takes seconds with real processes takes milliseconds here and comes out the same each time;
times are exact to a millisecond.
"""

from __future__ import annotations

import heapq
import itertools
import json
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from composed import option
from desk import build_twin
from motion import build_nominal_tables

from actuators.excite.player import NominalMachine
from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from deploy.bus.can_bus import CanBus, CanFrame
from deploy.bus.description import BusDescription
from deploy.kernel.bus_process import BusProcess, BusProcessConfig
from deploy.kernel.limits import StayOutBox
from deploy.policy.bundle import PolicyBundle
from deploy.policy.policy_process import PolicyAdviser, PolicyProcessConfig
from deploy.runtime.operator_state import LoopSnapshot
from deploy.runtime.shm_layout import LoopMemory
from deploy.twin.faults import FaultPort
from deploy.twin.remote import RadioRemote
from deploy.twin.twin import RunningTwin

DBC = "deploy:dbc/example_gateway.dbc"
NO_WIRE = CanBus(interface="virtual", channel="air", bitrate=None, port=None, hops=None)
BEGIN_S = 65.536 * 20 - 1.0
"""The gateway's clock wraps a second after the beginning."""
TURN_MS = 2048
"""After so long the stamp of the remote's messages begins anew."""
WANTED = (0.3, 0.0, -0.3, 0.0, 0.2)

Mode = Literal["listen", "auto", "collect"]
"""Nothing is ever sent; the policy commands; somebody else does, as `mode=collect link=can`."""


class Air:
    """What the bus process sees of the bus."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.inbox: deque[CanFrame] = deque()
        self.sent: list[CanFrame] = []
        self.broken = False
        self.interface, self.channel = "virtual", "air"

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
        self._stage.bridge.carry(frame, to_gateway=True)

    def close(self) -> None: ...


class Gateway:
    """What the twin sees of it."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage

    def recv(self, timeout_s: float) -> None: ...

    def send(self, frame: CanFrame) -> None:
        self._stage.bridge.carry(frame, to_gateway=False)


class Bridge:
    """A bridge between gateway and PC, as a radio link, a repeater or a stranger would be.

    Attributes:
        delay_s: Of frames by message name, or by a direction ("to_pc", "to_gateway"): a time, or a
            function of the time since the bridge was told.
        echo_s: Delay after which a message comes once more.
        half: Message of which every second frame has a wrong bit.
        second_remote: Whether a second remote sends, its dead-man held.
        foreign: Values of a foreign sender of `ValveCmd`; `None`: there is none.
        alter: By message: changes its values on the way, with counter and CRC as they have to be.
            The gateway has heard its own remote before.
        lose: By message: how many of the next ones are lost.
        held_s: Time for which all messages to the PC are held, to come at once; 0: none are.
        inserted: Data of a message that a stranger inserts every 20 ms, by its name.
        replayed: Whether a stranger sends recorded messages of the remote, one turn of their stamp
            old.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._waiting: list[tuple[int, int, CanFrame, bool]] = []
        self._order, self._counts = itertools.count(), Counter[int]()
        self._remote = RadioRemote(BusDescription(DBC, stage.machine), stage.machine)
        self._remote.deadman = True
        layouts = self._remote._description.layouts.values()
        self._layouts = {one.frame_id: one for one in layouts}
        self._names = {one.frame_id: one.name for one in layouts}
        self._foreign_counter = 0
        self.clear()

    def clear(self) -> None:
        """Carry everything as it is."""
        self._waiting.clear()
        self.delay_s: dict[str, float | Callable[[float], float]] = {}
        self.echo_s: dict[str, float] = {}
        self.half, self.second_remote, self.begun_ms = "", False, self._stage.ms
        self.foreign: dict[str, float] | None = None
        self.remote_offset = 0
        self.alter: dict[str, Callable[[dict[str, float]], None]] = {}
        self.lose = Counter[str]()
        self.held_s, self.inserted, self.replayed = 0.0, dict[str, bytes](), False
        self._recorded: deque[tuple[int, CanFrame]] = deque()

    def carry(self, frame: CanFrame, to_gateway: bool) -> None:
        """Carry a frame."""
        name = self._names.get(frame.frame_id, "")
        if not to_gateway and hasattr(self._remote, "hear"):
            self._remote.hear(frame)
        self._counts[frame.frame_id] += 1
        if name and name == self.half and self._counts[frame.frame_id] % 2:
            frame = CanFrame(frame.frame_id, bytes([frame.data[0] ^ 1, *frame.data[1:]]))
        if self.lose[name] > 0:
            self.lose[name] -= 1
            return
        if name in self.alter:
            layout = self._layouts[frame.frame_id]
            values = self._remote._description.decode(layout, frame.data)
            counter = int(values["Counter"])
            self.alter[name](values)
            data = self._remote._description.encode(name, values, counter)
            frame = CanFrame(frame.frame_id, data)
        if name == "LeverState":
            self._recorded.append((self._stage.ms, frame))
        way = "to_gateway" if to_gateway else "to_pc"
        delay = self.delay_s.get(name, self.delay_s.get(way, 0.0))
        since_s = (self._stage.ms - self.begun_ms) / 1e3
        if self.held_s and not to_gateway:
            delay = self.held_s - since_s % self.held_s
        self._deliver(frame, to_gateway, delay(since_s) if callable(delay) else delay)
        if name in self.echo_s:
            self._deliver(frame, to_gateway, self.echo_s[name])

    def tick(self) -> None:
        """Deliver what is due, and let strangers send."""
        stage = self._stage
        while self._waiting and self._waiting[0][0] <= stage.ms:
            _, _, frame, to_gateway = heapq.heappop(self._waiting)
            self._arrive(frame, to_gateway)
        for name, data in self.inserted.items():
            if stage.ms % 20 == 5:
                frame_id = self._remote._description.layouts[name].frame_id
                for to_gateway in (True, False):
                    self._arrive(CanFrame(frame_id, data), to_gateway)
        while self._recorded and self._recorded[0][0] + TURN_MS <= stage.ms:
            _, frame = self._recorded.popleft()
            for to_gateway in (True, False):
                if self.replayed:
                    self._arrive(frame, to_gateway)
        if self.second_remote and stage.ms % 20 == 7:
            counter = stage.twin._remote._counter + self.remote_offset
            self._arrive(self._remote.build_frame(counter % 16), to_gateway=True)
            self._arrive(self._remote.build_frame(counter % 16), to_gateway=False)
        if self.foreign is not None and stage.ms % 20 == 9:
            self._foreign_counter += 1
            description, command = self._remote._description, "ValveCmd"
            values = self.foreign | {"Stamp": stage.now_s}
            data = description.encode(command, values, self._foreign_counter)
            frame = CanFrame(description.layouts[command].frame_id, data)
            self._arrive(frame, to_gateway=True)
            self._arrive(frame, to_gateway=False)

    def _deliver(self, frame: CanFrame, to_gateway: bool, delay_s: float) -> None:
        if delay_s <= 0:
            self._arrive(frame, to_gateway)
            return
        due_ms = self._stage.ms + round(1e3 * delay_s)
        heapq.heappush(self._waiting, (due_ms, next(self._order), frame, to_gateway))

    def _arrive(self, frame: CanFrame, to_gateway: bool) -> None:
        stage = self._stage
        if not to_gateway:
            stage.air.inbox.append(frame)
        elif self._names.get(frame.frame_id) == "LeverState":
            # The twin takes its own remote's messages for its own; the gateway hears all of them.
            stage.twin._gateway.take(frame, stage.machine_s)
            stage.twin._apply_flow(stage.machine_s)
        else:
            stage.twin.hear(frame, stage.machine_s)


def write_nominal_observer(machine: Machine, folder: Path) -> Path:
    """Writes the file of an observer that expects the nominal machine: dead time, speed times command."""
    content = {"schema": 2, "machine": machine.name, "fingerprint": machine.fingerprint()}
    content |= {
        "sources": ["nominal machine"],
        "model": build_nominal_tables(machine, machine.dead_time_s),
    }
    thresholds = {
        "window_s": 1.0,
        "share": 0.25,
        "slack_s": [0.06] * machine.num_joints,
        "minutes": 0.0,
    }
    path = folder / "nominal_observer.json"
    path.write_text(json.dumps(content | {"thresholds": thresholds}))
    return path


class Stage:
    """The parts together.

    Args:
        machine: The machine.
        mode: Who commands.
        folder: Where a session may write.
        again_s: When the operator who is not followed presses the dead-man again.
        watched: Whether the guard has its envelope and its observer.
        stay_out: Boxes that the envelope knows.
        dbc: Description by which the PC goes.
        twin_dbc: Description by which the gateway goes.

    Attributes:
        meddle: Called each millisecond, for what else goes wrong.
        clock_jump_s: By which the gateway's clock is ahead.
    """

    def __init__(
        self,
        machine: Machine,
        mode: Mode,
        folder: Path,
        again_s: float | None = None,
        watched: bool = True,
        stay_out: dict[str, StayOutBox] | None = None,
        dbc: str = DBC,
        twin_dbc: str = DBC,
    ) -> None:
        self.machine, self.mode, self.ms = machine, mode, 0
        self.memory = LoopMemory(machine.num_joints, commands=mode != "listen")
        self.air, self.request_s, self.wanted = Air(self), 0.05, WANTED
        self.bridge, self.supervised = Bridge(self), True
        self.stopped_ms: int | None = None
        self.meddle: Callable[[], None] | None = None
        self.clock_jump_s, self._times = 0.0, 0
        with self._time():
            self._twin_settings = build_twin(NO_WIRE, dbc=twin_dbc, again_s=again_s)
            session = Session(out=str(folder), seed=0, device="cpu")
            self._link = NominalMachine().build(machine, 1, session)
            self.start_twin()
            limits, wire = option("guard", "default"), self.air
            observer = replace(limits.observer, path=str(write_nominal_observer(machine, folder)))
            limits = replace(limits, observer=observer)
            if not watched:
                limits = replace(limits, observer=None, envelope=None)
            if stay_out:
                envelope = replace(limits.envelope, stay_out=stay_out, ground_m=None)
                limits = replace(limits, envelope=envelope)
            config = BusProcessConfig(wire, dbc, machine, limits, needs_page=False)  # type: ignore[arg-type]
            self.bus_process = BusProcess(config, self.memory)
            policy = "tasks:policies/borehole_insertion"
            guidance = option("guidance", "machine")
            counsel = PolicyProcessConfig(machine, policy, guidance, limits.joints_s, 600.0, None)
            self.adviser = PolicyAdviser(counsel, PolicyBundle(policy, machine), self.memory)
            if mode == "collect":
                self.adviser = None
            self._write("target", t_s=self.now_s, center_in_base_m=(2.6, 0.0, 0.75))
            self.arm()

    @property
    def now_s(self) -> float:
        return BEGIN_S + self.ms / 1e3

    @property
    def machine_s(self) -> float:
        """Time by the clock of the gateway."""
        return self.now_s + self.clock_jump_s

    def start_twin(self) -> None:
        """Starts gateway and remote, or starts them anew; the machine stays where it is."""
        settings, port = self._twin_settings, FaultPort(None)
        self.twin = RunningTwin(settings, self.machine, self._link, Gateway(self), port)

    def go(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Lets time go by."""
        end_ms = self.ms + round(1e3 * seconds)
        with self._time():
            while self.ms < end_ms and not until():
                self.bus_process.receive()
                self.bus_process._timer.begin()
                self.bus_process.run_cycle()

    def tick(self) -> None:
        """Lets a millisecond go by."""
        self.ms += 1
        self.bridge.tick()
        if self.meddle is not None:
            self.meddle()
        if self.ms % 10 == 0:
            self.twin.cycle(self.machine_s)
        if self.ms % 20 == 1 and self.supervised:
            self._write("controls", t_s=self.now_s, **self._switches)
        if self.mode != "collect" and self.ms % 50 == 3 and self.adviser is not None:
            self.adviser.run_cycle(0, self.now_s)
        if self.mode == "collect" and self.ms % round(1e3 * self.request_s) == 3:
            self._write("request", t_s=self.now_s, u=self.wanted)
        if not self.moves:
            self.stopped_ms = self.ms if self.stopped_ms is None else self.stopped_ms
        else:
            self.stopped_ms = None

    def arm(self, armed: bool | None = None) -> None:
        """Arm or disarm, as the supervisor does; without a word as the mode has it."""
        armed = self.mode != "listen" if armed is None else armed
        self._switches: dict[str, Any] = {"armed": armed, "armed_t_s": self.now_s}
        self._write("controls", t_s=self.now_s, **self._switches)

    def stop(self) -> None:
        """Press the page's stop: straight to the bus process."""
        self._write("page", t_s=self.now_s, stopped_s=self.now_s)

    @property
    def moves(self) -> bool:
        """Whether the valves get anything now."""
        return bool(self.twin._flow.any())

    def fault(self, fault: str, message: str = "") -> None:
        """Switches a fault on, or all off (`none`)."""
        text = json.dumps({"fault": fault, "message": message}).encode()
        self.twin._faults.request(text, self.machine_s)

    def get_going(self) -> None:
        """Goes the operator's way until the machine moves; where nothing is sent, until there is an advice."""
        self.fault("none")
        self._times += 1
        # To and fro: no joint comes to its end, no policy to its goal.
        side = 1 - 2 * (self._times % 2)
        self.air.broken, self.request_s = False, 0.05
        self.bridge.clear()
        self.supervised, self.meddle = True, None
        self.arm()
        self.wanted = tuple(side * u for u in WANTED)
        self._write("target", t_s=self.now_s, center_in_base_m=(2.5, 0.7 * side, 0.75))
        # A channel that was disturbed needs half a second, a second sender is remembered for one.
        self.go(0.7)
        self.go(1.2, lambda: all(map(self.memory.state.peek, ("alone", "trusted"))))
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
            patch.setattr(time, "clock_gettime", lambda clock: self.now_s)
            patch.setattr(
                time,
                "sleep",
                lambda seconds: [self.tick() for _ in range(max(1, round(1e3 * seconds)))],
            )
            yield
