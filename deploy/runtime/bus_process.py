"""The bus process: reads the bus, watches over it, and sends what the guard lets pass. It waits for nobody.

One cycle of 10 ms: receive until the deadline, hand what is known to the guard, send, publish. A
message that ends a motion (dead-man, emergency stop, a channel that cannot be trusted) ends the
cycle too: it is acted on when it arrives. A command that stops motion is sent at once, others with
the cycle time of the DBC. Where nothing is ever commanded there is no request slot, and nothing is
ever sent.
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
from deploy.guard.guard import CommandRequest, Guard, GuardDecision, GuardState, GuardTrip
from deploy.guard.limits import GuardLimits
from deploy.runtime.process import CycleTimer, Stop
from deploy.runtime.receiver import BusReceiver
from deploy.runtime.shm_layout import LoopMemory

log = logging.getLogger(__name__)

CYCLE_S = 0.01
REOPEN_S = 0.2
"""Between attempts to open a bus that went down."""
TRIPS = tuple(GuardTrip)
FRAME = struct.Struct("<dIBB")
"""Of a frame in the log's pipe: time, identifier, 1 where it was sent from here, and number of data
bytes that follow."""
FRAMES, TEXT = b"F", b"J"
"""First byte of what goes through the log's pipe: frames, or a JSON text with topic and time."""
IDLE, COMMAND = 0, 1
"""Values of `CommandMode`."""


@dataclass(frozen=True)
class BusProcessConfig:
    """What a bus process is to do.

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


def run(stop: Stop, setting: BusProcessConfig, memory: LoopMemory) -> None:
    """Runs until it is asked to stop; then sends zero, where anything is sent, and closes the bus."""
    BusProcess(setting, memory).run(stop)


class BusProcess:
    """See the module."""

    def __init__(self, setting: BusProcessConfig, memory: LoopMemory) -> None:
        self._wire, self._memory, self._machine = setting.wire, memory, setting.machine
        self._description = BusDescription(setting.dbc, setting.machine)
        self._receiver = BusReceiver(self._description, setting.machine, setting.limits)
        self._guard = Guard(setting.limits, self._receiver.body)
        self._gap_s = setting.limits.gap_s
        self._bus: OpenCanBus | OpenBusReplay | None = None
        self._was_down, self._reopen_s = False, 0.0
        self._log: list[bytes] = []
        self._counters: dict[str, int] = {}
        self._due_s: dict[str, float] = {}
        self._decision: GuardDecision | None = None
        self._pace = CycleTimer(CYCLE_S)

    def run(self, stop: Stop) -> None:
        """Runs cycles until asked to stop."""
        while not stop():
            self._receive()
            self._pace.begin()
            self._cycle()
        self._farewell()

    def _receive(self) -> None:
        """Takes frames until the deadline."""
        if (
            self._bus is not None
            and (stood_s := time.monotonic() - self._pace.next_s) > self._gap_s
        ):
            log.warning("time stood still for %.1f s; what was said meanwhile is dropped", stood_s)
            self._bus.close()
            self._bus = None
        if self._bus is None and time.monotonic() >= self._reopen_s:
            self._open()
        if self._bus is None:
            self._pace.wait()
            return
        try:
            while self._bus is not None and (left_s := self._pace.next_s - time.monotonic()) > 0:
                frame = self._bus.recv(left_s)
                if frame is not None:
                    self._take(frame, time.monotonic())
        except LinkError as error:
            self._down(error)

    def _take(self, frame: CanFrame, now_s: float) -> None:
        """Takes in a frame; one that ends a motion is acted on at once."""
        fault = self._receiver.take(frame, now_s)
        self._note(frame, now_s, sent=False)
        if fault is not None:
            self._say("fault", now_s, {"frame_id": frame.frame_id, "fault": fault.value})
        if (
            self._decision is not None
            and self._decision.state is GuardState.ACTIVE
            and self._guard.stops(self._receiver.seen(now_s, True))
        ):
            self._cycle()

    def _cycle(self) -> None:
        """Decides, sends, publishes."""
        now_s = time.monotonic()
        decision = self._guard.decide(
            now_s,
            self._armed(),
            self._receiver.seen(now_s, self._bus is not None),
            self._request(now_s),
        )
        before, self._decision = self._decision, decision
        if before is None or (decision.state, decision.trip) != (before.state, before.trip):
            self._say(
                "guard",
                now_s,
                {
                    "state": decision.state.name,
                    "trip": decision.trip.value,
                    "cause": decision.cause.value,
                },
            )
        if decision.sends and self._memory.request is not None:
            stops = before is not None and any(before.u) and not any(decision.u)
            self._command(decision, now_s, at_once=stops)
        self._publish(now_s, decision)
        if self._log:
            self._memory.bus_log.put(FRAMES + b"".join(self._log))
            self._log.clear()

    def _armed(self) -> bool:
        controls = self._memory.controls.read()
        return self._memory.request is not None and controls is not None and bool(controls["armed"])

    def _request(self, now_s: float) -> CommandRequest | None:
        record = self._memory.request.read() if self._memory.request else None
        return (
            None
            if record is None
            else CommandRequest(tuple(record["u"].tolist()), now_s - float(record["t_s"]))
        )

    def _command(self, decision: GuardDecision, now_s: float, at_once: bool) -> None:
        """Sends the guard's decision, and the heartbeat when it is due; the one place from which valves are commanded."""
        values: dict[str, float] = {
            f"Command_{joint}": u
            for joint, u in zip(self._machine.joint_names, decision.u, strict=True)
        }
        values["CommandMode"] = COMMAND if decision.state is GuardState.ACTIVE else IDLE
        self._send(self._description.command.name, values, now_s, at_once)
        if "PcHeartbeat" in self._description.layouts:
            state = {"PcState": decision.state.value, "Overruns": min(4095, self._pace.missed)}
            self._send("PcHeartbeat", state, now_s, at_once=False)

    def _send(self, name: str, values: Mapping[str, float], now_s: float, at_once: bool) -> None:
        due_s, period_s = self._due_s.get(name, now_s), self._description.layouts[name].period_s
        if self._bus is None or (now_s < due_s - CYCLE_S / 2 and not at_once):
            return
        self._due_s[name] = max(due_s, now_s - period_s) + period_s
        counter = self._counters[name] = self._counters.get(name, -1) + 1
        layout = self._description.layouts[name]
        frame = CanFrame(
            layout.frame_id, self._description.encode(name, values, counter), layout.extended
        )
        if name == self._description.command.name:
            self._receiver.sent(frame.data)
        try:
            self._bus.send(frame)
        except LinkError as error:
            self._down(error)
        self._note(frame, now_s, sent=True)

    def _publish(self, now_s: float, decision: GuardDecision) -> None:
        receiver, record = self._receiver, self._memory.state.new()
        seen = receiver.seen(now_s, self._bus is not None)
        record["t_s"], record["q"], record["q_t_s"] = (
            now_s,
            receiver.q,
            max(0.0, receiver.q_t_s.min() - receiver.held_up_s),
        )
        record["q_plausible"], record["trusted"], record["alone"] = (
            seen.joints_plausible,
            seen.trusted,
            seen.alone,
        )
        record["flow"], record["flow_sum"], record["flow_number"] = (
            receiver.flow,
            receiver.flow_sum,
            receiver.flow_number,
        )
        record["flow_t_s"], record["levers_t_s"] = (
            max(0.0, receiver.flow_t_s),
            max(0.0, receiver.levers_t_s),
        )
        record["status_t_s"], record["held_up_s"], record["bus_up"] = (
            max(0.0, receiver.status_t_s),
            receiver.held_up_s,
            seen.bus_up,
        )
        record["lever"], record["button_right"], record["deadman"] = (
            receiver.lever,
            receiver.button_right,
            receiver.deadman,
        )
        record["remote_on"], record["estop"], record["oil_c"] = (
            receiver.remote_on,
            receiver.estop,
            receiver.oil_c,
        )
        record["exclusive_selected"] = receiver.exclusive_selected
        record["guard"], record["sent"] = decision.state.value, decision.u
        record["trip"], record["cause"] = TRIPS.index(decision.trip), TRIPS.index(decision.cause)
        record["frames"], record["refused"], record["lost"] = (
            receiver.frames,
            receiver.refused,
            receiver.lost,
        )
        record["missed"] = self._pace.missed
        self._memory.state.write(record)

    def _open(self) -> None:
        try:
            self._bus, self._was_down = self._wire.open(self._receiver.frame_ids), False
            log.info("bus %s %s is open", self._wire.interface, self._wire.channel)
        except LinkError as error:
            self._down(error)

    def _down(self, error: LinkError) -> None:
        """Closes the bus: what its queues still hold must not be sent when it comes back."""
        if self._bus is not None or not self._was_down:
            log.warning("%s; trying again every %g s", error, REOPEN_S)
            self._say("bus", time.monotonic(), {"down": str(error)})
        if self._bus is not None:
            self._bus.close()
        self._bus, self._was_down, self._reopen_s = None, True, time.monotonic() + REOPEN_S

    def _farewell(self) -> None:
        now_s = time.monotonic()
        if self._bus is not None and self._decision is not None and self._decision.sends:
            last = self._guard.decide(
                now_s, True, self._receiver.seen(now_s, False), None
            )  # a bus that is going down: zero
            self._command(last, now_s, at_once=True)
        self._memory.reports.put(json.dumps({"process": "bus"} | self._pace.report()).encode())
        if self._log:
            self._memory.bus_log.put(FRAMES + b"".join(self._log))
        if self._bus is not None:
            self._bus.close()

    def _note(self, frame: CanFrame, now_s: float, sent: bool) -> None:
        self._log.append(FRAME.pack(now_s, frame.frame_id, sent, len(frame.data)) + frame.data)

    def _say(self, topic: str, now_s: float, values: dict[str, object]) -> None:
        self._memory.bus_log.put(
            TEXT + json.dumps({"topic": topic, "t_s": now_s, **values}).encode()
        )
