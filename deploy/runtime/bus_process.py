"""The bus process: reads the bus, runs the guard, and sends the commands that the guard allows.

It waits for no other process. One cycle of 10 ms: receive until the deadline, let the guard decide,
send, publish. A message that ends a motion (dead-man, emergency stop, a channel that cannot be
trusted) ends the cycle too: it takes effect when it arrives. A command that stops motion is sent at
once, others with the cycle time of the DBC. Where nothing is ever commanded there is no request
slot, and nothing is ever sent.
"""

from __future__ import annotations

import json
import logging
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass

from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from deploy.bus.can_bus import BusReplay, CanBus, CanFrame, OpenBusReplay, OpenCanBus
from deploy.bus.description import BusDescription
from deploy.guard.guard import CommandRequest, Guard, GuardDecision, GuardState
from deploy.guard.limits import GuardLimits
from deploy.runtime.process import CycleTimer, Stop
from deploy.runtime.receiver import BusReceiver
from deploy.runtime.shm_layout import LoopMemory

log = logging.getLogger(__name__)

CYCLE_S = 0.01
"""Half the cycle time of valve commands in the example DBC (20 ms)."""
REOPEN_S = 0.2
"""Time between attempts to open a bus that went down. Chosen by hand: quick for a person, rare
enough not to load the computer."""
LARGEST_OVERRUNS = 4095
"""Of the 12-bit signal `Overruns`."""
FRAME = struct.Struct("<dIBB")
"""Header of a frame in the log's pipe.

Time, identifier, 1 where it was sent from here, and the number of data bytes that follow."""
FRAMES, TEXT = b"F", b"J"
"""First byte of an entry in the log's pipe: frames, or a JSON text with topic and time."""
IDLE, COMMAND = 0, 1
"""Values of `CommandMode`."""


@dataclass(frozen=True)
class BusProcessConfig:
    """Settings of a bus process.

    Attributes:
        wire: The bus.
        dbc: Its description.
        machine: The machine.
        limits: Of the guard.
    """

    wire: CanBus | BusReplay
    dbc: str
    machine: Machine
    limits: GuardLimits


def run(stop: Stop, config: BusProcessConfig, memory: LoopMemory) -> None:
    """Run until asked to stop; then send zero, where anything is sent, and close the bus."""
    BusProcess(config, memory).run(stop)


class BusProcess:
    """See the module."""

    def __init__(self, config: BusProcessConfig, memory: LoopMemory) -> None:
        self._wire, self._memory, self._machine = config.wire, memory, config.machine
        self._description = BusDescription(config.dbc, config.machine)
        self._receiver = BusReceiver(self._description, config.machine, config.limits)
        self._guard = Guard(config.limits, self._receiver.bounds)
        self._gap_s = config.limits.gap_s
        self._bus: OpenCanBus | OpenBusReplay | None = None
        self._was_down, self._reopen_s = False, 0.0
        self._log: list[bytes] = []
        # Counters and due times are kept by message name, since each has its own cycle.
        self._counters: dict[str, int] = {}
        self._due_s: dict[str, float] = {}
        self._decision: GuardDecision | None = None
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
        fault = self._receiver.take(frame, now_s)
        self._log_frame(frame, now_s, sent=False)
        if fault is not None:
            self._log_text("fault", now_s, {"frame_id": frame.frame_id, "fault": fault.value})
        is_active = self._decision is not None and self._decision.state is GuardState.ACTIVE
        # Only while commanding: otherwise there is no motion to end, and the cycle keeps its
        # time.
        if is_active and self._guard.stops(self._receiver.build_guard_input(now_s, True)):
            self.run_cycle()

    def run_cycle(self) -> None:
        """Decide, send and publish."""
        now_s = time.monotonic()
        decision = self._guard.decide(
            now_s,
            self._is_armed(),
            self._receiver.build_guard_input(now_s, self._bus is not None),
            self._read_request(now_s),
        )
        before, self._decision = self._decision, decision
        # Only changes are logged: the state itself stands in every record.
        if before is None or (decision.state, decision.trip) != (before.state, before.trip):
            values = {
                "state": decision.state.name,
                "trip": decision.trip.value,
                "cause": decision.cause.value,
            }
            self._log_text("guard", now_s, values)
        if decision.sends and self._memory.request is not None:
            # A fall to zero goes out at once; other commands wait for their turn.
            stops = before is not None and any(before.u) and not any(decision.u)
            self._send_command(decision, now_s, at_once=stops)
        state = self._receiver.build_state(
            now_s, self._bus is not None, decision, self._timer.missed
        )
        self._memory.state.write(state)
        self._flush_log()

    def _is_armed(self) -> bool:
        controls = self._memory.controls.read()
        return self._memory.request is not None and controls is not None and controls.armed

    def _read_request(self, now_s: float) -> CommandRequest | None:
        requested = self._memory.request.read() if self._memory.request else None
        if requested is None:
            return None
        return CommandRequest(tuple(requested.u.tolist()), now_s - requested.t_s)

    def _send_command(self, decision: GuardDecision, now_s: float, at_once: bool) -> None:
        """Send the guard's decision, and the heartbeat when it is due.

        This is the one place from which valves are commanded.
        """
        values: dict[str, float] = {}
        for joint, u in zip(self._machine.joint_names, decision.u, strict=True):
            values[f"Command_{joint}"] = u
        values["CommandMode"] = COMMAND if decision.state is GuardState.ACTIVE else IDLE
        self._send(self._description.command.name, values, now_s, at_once)
        # The gateway expects a heartbeat only where its DBC has one.
        if "PcHeartbeat" in self._description.layouts:
            overruns = min(LARGEST_OVERRUNS, self._timer.missed)
            state = {"PcState": decision.state.value, "Overruns": overruns}
            self._send("PcHeartbeat", state, now_s, at_once=False)

    def _send(self, name: str, values: Mapping[str, float], now_s: float, at_once: bool) -> None:
        layout = self._description.layouts[name]
        due_s, period_s = self._due_s.get(name, now_s), layout.period_s
        # half a cycle early is on time: the next chance would be half a cycle late
        if self._bus is None or (now_s < due_s - CYCLE_S / 2 and not at_once):
            return
        self._due_s[name] = max(due_s, now_s - period_s) + period_s
        counter = self._counters[name] = self._counters.get(name, -1) + 1
        data = self._description.encode(name, values, counter)
        frame = CanFrame(layout.frame_id, data, layout.extended)
        # Remembered before sending: the bus may deliver it back before `send` returns.
        if name == self._description.command.name:
            self._receiver.note_own_command(frame.data)
        try:
            self._bus.send(frame)
        except LinkError as error:
            self._close_after_error(error)
        self._log_frame(frame, now_s, sent=True)

    def _open(self) -> None:
        try:
            self._bus, self._was_down = self._wire.open(self._receiver.frame_ids), False
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
        if self._bus is not None and self._decision is not None and self._decision.sends:
            # Going down is the strictest input: no request can override it.
            # to the guard the bus is going down, and it answers with zero
            closing = self._receiver.build_guard_input(now_s, False)
            last = self._guard.decide(now_s, True, closing, None)
            self._send_command(last, now_s, at_once=True)
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
        text = json.dumps({"topic": topic, "t_s": now_s, **values})
        self._memory.bus_log.put(TEXT + text.encode())
