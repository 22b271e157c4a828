"""The bus process: reads the bus, runs the guard, and sends the commands that the guard allows.

It waits for no other process. One cycle of 10 ms: receive until the deadline, let the guard decide,
send, publish. All decisions are those of `deploy.kernel.bus_logic`; here are bus, clock and shared
memory. Where nothing is ever commanded there is no request slot, and nothing is ever sent.
"""

from __future__ import annotations

import json
import logging
import math
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from deploy.bus.can_bus import CanBus, CanFrame, OpenCanBus
from deploy.bus.description import BusDescription
from deploy.guard_setup import build_envelope, build_observer
from deploy.kernel.bus_logic import CYCLE_S, BusInputs, BusLogic
from deploy.kernel.guard import GuardDecision
from deploy.kernel.limits import GuardLimits
from deploy.kernel.target_check import SeenTarget
from deploy.runtime.operator_state import PageSignal
from deploy.runtime.process import CycleTimer, Stop, read_steady_s
from deploy.runtime.shm_layout import LoopMemory, log_text
from deploy.runtime.target import read_holes

log = logging.getLogger(__name__)

REOPEN_S = 0.2
"""Time between attempts to open a bus that went down. Chosen by hand: quick for a person, rare
enough not to load the computer."""
FRAME = struct.Struct("<dIBB")
"""Header of a frame in the log's pipe.

Time, identifier, 1 where it was sent from here, and the number of data bytes that follow."""
FRAMES = b"F"
"""First byte of an entry with frames in the log's pipe; others are texts (`log_text`)."""


@dataclass(frozen=True)
class BusProcessConfig:
    """Settings of a bus process.

    Attributes:
        wire: The bus.
        dbc: Its description.
        machine: The machine.
        limits: Of the guard.
        needs_page: Whether commands are sent only while the operator's page lives.
    """

    wire: CanBus
    dbc: str
    machine: Machine
    limits: GuardLimits
    needs_page: bool


def run(stop: Stop, config: BusProcessConfig, memory: LoopMemory) -> None:
    """Run until asked to stop; then send zero, where anything is sent, and close the bus."""
    BusProcess(config, memory).run(stop)


class BusProcess:
    """The bus process at work: bus, clock and shared memory around a `BusLogic`."""

    def __init__(self, config: BusProcessConfig, memory: LoopMemory) -> None:
        self._wire, self._memory = config.wire, memory
        description = BusDescription(config.dbc, config.machine)
        commands = memory.request is not None
        limits, machine = config.limits, config.machine
        envelope = build_envelope(limits, machine, commands)
        observer = build_observer(limits, machine, config.wire.interface, commands)
        checks = (envelope, observer)
        self._logic = BusLogic(description, machine, limits, *checks, commands, config.needs_page)
        self._seen_s = limits.target.seen_s
        self._joint_names = machine.joint_names
        self._gap_s = config.limits.gap_s
        self._bus: OpenCanBus | None = None
        self._was_down, self._reopen_s = False, -math.inf
        self._log: list[bytes] = []
        self._timer = CycleTimer(CYCLE_S)

    def run(self, stop: Stop) -> None:
        """Run cycles until asked to stop."""
        while not stop():
            self.receive()
            self._timer.begin()
            self.run_cycle()
        self._shut_down()

    def receive(self) -> None:
        """Take frames until the deadline."""
        # The computer was asleep: old frames in the queue would be taken for present ones.
        late_s = time.monotonic() - self._timer.next_s
        if self._bus is not None and late_s > self._gap_s:
            log.warning(
                "time stood still for %.1f s; frames received meanwhile are dropped", late_s
            )
            self._bus.close()
            self._bus = None
        if self._bus is None and time.monotonic() >= self._reopen_s:
            self._open()
        if self._bus is None:
            self._timer.wait()
            return
        try:
            # The rest of the cycle is spent receiving, so that a stop takes effect at once.
            while self._bus is not None and (left_s := self._timer.next_s - time.monotonic()) > 0:
                frame = self._bus.recv(left_s)
                if frame is not None:
                    self._take(frame, time.monotonic())
        except LinkError as error:
            self._close_after_error(error)

    def _take(self, frame: CanFrame, now_s: float) -> None:
        """Take in a frame; one that ends a motion takes effect at once."""
        fault, is_urgent = self._logic.take(frame, now_s, read_steady_s())
        self._log_frame(frame, now_s, sent=False)
        if fault is not None:
            log_text(
                self._memory.bus_log,
                "fault",
                now_s,
                {"frame_id": frame.frame_id, "fault": fault.value},
            )
        if is_urgent:
            self.run_cycle()

    def run_cycle(self) -> None:
        """Decide, send and publish."""
        now_s, memory, logic = time.monotonic(), self._memory, self._logic
        request = None if memory.request is None else memory.request.read()
        page = memory.page.read()
        if page is None and memory.page.number:
            # Damaged memory may hold a stop.
            page = PageSignal(now_s, stopped_s=now_s, present_s=0.0)
        inputs = BusInputs(memory.controls.read(), page, request, self._read_target(now_s))
        before = logic.decision
        frames = logic.decide(now_s, self._bus is not None, inputs, self._timer.missed)
        self._send(frames, now_s)
        assert logic.decision is not None
        self._log_change(before, logic.decision, now_s)
        state = logic.build_state(now_s, self._bus is not None, self._timer.missed)
        memory.state.write(state)
        self._flush_log()

    def _read_target(self, now_s: float) -> SeenTarget | None:
        """Return the chosen borehole; its place is NaN where it was written and cannot be read."""
        target = self._memory.target.read()
        if target is None:
            return SeenTarget((math.nan,) * 3, 0.0, ()) if self._memory.target.number else None
        seen_m = []
        for hole in read_holes(self._memory.holes):
            place_m = tuple(hole["center_in_base_m"].tolist())
            # A place that is no number shows no face.
            if abs(now_s - float(hole["t_s"])) <= self._seen_s and all(map(math.isfinite, place_m)):
                seen_m.append(place_m)
        center_m, age_s = target["center_in_base_m"].tolist(), now_s - float(target["t_s"])
        return SeenTarget(tuple(center_m), age_s, tuple(seen_m))

    def _log_change(self, before: GuardDecision | None, after: GuardDecision, now_s: float) -> None:
        """Log a change of the guard; the state itself stands in every record."""
        if before is not None and (after.state, after.trip) == (before.state, before.trip):
            return
        values = {"state": after.state.name, "trip": after.trip.value, "cause": after.cause.value}
        observed = self._logic.receiver.found
        if observed.joint >= 0:
            values["joint"] = self._joint_names[observed.joint]
        self._log_text("guard", now_s, values)

    def _send(self, frames: Sequence[CanFrame], now_s: float) -> None:
        for frame in frames:
            # What could not be sent now is outdated later.
            if self._bus is None:
                return
            try:
                self._bus.send(frame)
            except LinkError as error:
                self._close_after_error(error)
            self._log_frame(frame, now_s, sent=True)

    def _open(self) -> None:
        try:
            self._bus = self._wire.open(self._logic.receiver.frame_ids)
            log.info("bus %s %s is open", self._wire.interface, self._wire.channel)
        except LinkError as error:
            self._close_after_error(error)

    def _close_after_error(self, error: LinkError) -> None:
        """Close the bus: frames still in its queues must not be sent when it comes back."""
        if self._bus is not None or not self._was_down:
            log.warning("%s; trying again every %g s", error, REOPEN_S)
            self._log_text("bus", time.monotonic(), {"down": str(error)})
        if self._bus is not None:
            self._bus.close()
        self._bus, self._was_down, self._reopen_s = None, True, time.monotonic() + REOPEN_S

    def _shut_down(self) -> None:
        """Send zero, report on timing, and close the bus."""
        now_s = time.monotonic()
        self._send(self._logic.end(now_s, self._timer.missed), now_s)
        report = {"process": "bus"} | self._timer.report()
        self._memory.reports.put(json.dumps(report).encode())
        self._flush_log()
        if self._bus is not None:
            self._bus.close()

    def _flush_log(self) -> None:
        if self._log:
            self._memory.bus_log.put(FRAMES + b"".join(self._log))
            self._log.clear()

    def _log_frame(self, frame: CanFrame, now_s: float, sent: bool) -> None:
        header = FRAME.pack(now_s, frame.frame_id, sent, len(frame.data))
        self._log.append(header + frame.data)

    def _log_text(self, topic: str, now_s: float, values: Mapping[str, object]) -> None:
        log_text(self._memory.bus_log, topic, now_s, values)
