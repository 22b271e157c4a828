"""The twin: gateway, remote and a simulated machine, in real time, on a bus.

The machine is simulated at the control rate: the flow of the valves at the beginning of a period
moves it through that period, and its positions are sent in between as a faster sensor would measure
them. Without an operator of its own the twin also plays the remote, levers in neutral.
"""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np

from brokk_rl.contracts.link import Connection, Link
from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_text
from brokk_rl.signals import Command
from brokk_rl.spec import Port, Positive, spec
from deploy.bus.c_header import generate_c_header
from deploy.bus.can_bus import CanBus, CanFrame, OpenCanBus
from deploy.bus.description import GATEWAY, STAMP, BusDescription
from deploy.runtime.process import CycleTimer, Stop, ask_for_priority, read_steady_s
from deploy.twin.faults import ActiveFaults, FaultPort
from deploy.twin.gateway import NOBODY, PC, REMOTE_S, ROUND_TRIP_S, TIMEOUT_S, Gateway
from deploy.twin.remote import RadioRemote

log = logging.getLogger(__name__)

CYCLE_S = 0.01
"""Shortest cycle time of the gateway's messages in the example DBC."""
PRESS_S = 1.0
"""Time after the PC is first heard until the operator presses the dead-man. Chosen by hand."""
LET_GO_S = 1.0
"""Time for which the operator lets go of it before pressing again. Chosen by hand: longer than the
history that a policy fills anew after a fault."""
HEADER = "gateway.h"
TWIN_PRIORITY = 45
"""Of SCHED_FIFO, below bus and policy: the loop must not run better or worse beside a twin."""
FROZEN = 7
"""Counter of a message whose counter stands still; any number will do."""
FLOOD, FLOOD_ID = 30, 0x1FFF0000
"""Frames a cycle of a babbling node, and their identifier: of lowest priority."""
LEVER_FAULT = 0.5
"""Deflection of a lever that the operator moves, of full."""
JUMP_RAD, DRIFT_RAD_S, OUT_OF_RANGE_RAD, OFFSET_RAD = 0.5, 0.1, 3.1, 0.1
"""Sizes of the faults of a position; any that no joint could reach will do."""
SENSOR_RANGE_RAD = 3.2
"""Largest position that the example DBC's signals hold."""
OIL_RANGE_C = (-40, 215)
"""Range of the signal `OilTemperature` in the example DBC."""
USUAL_OIL_C = 20.0
"""Temperature of a plant that does not model it."""


@spec
class Twin:
    """A simulated machine behind the bus.

    Attributes:
        wire: The bus.
        dbc: Its description.
        remote: Whether the twin plays the remote too; `false` where an operator is a node of its
            own.
        deadman: Whether an operator at that remote presses the dead-man, one second after the PC is
            first heard, and holds it.
        again_s: Time after which that operator presses again if the valves do not follow the PC;
            `null`: holds it all the same.
        fault_port: Local port for faults on request; `null`: none.
        seconds: Length of the run; `null`: until told to stop.
        realtime: Whether to ask for real-time priority: a machine is never late.
    """

    wire: CanBus
    dbc: str
    remote: bool
    deadman: bool
    again_s: Positive | None
    fault_port: Port | None
    seconds: Positive | None
    realtime: bool


def run(
    stop: Stop,
    twin: Twin,
    machine: Machine,
    plant: Connection,
    session: Session,
    memory: Any = None,
) -> None:
    """Run a twin until told to stop, or the time is over.

    Writes `gateway.h`, the bus for the firmware of a real gateway.

    Raises:
        LinkError: the bus cannot be opened.
    """
    # The twin stands for a machine, which is never late because of the computer.
    if twin.realtime:
        ask_for_priority(TWIN_PRIORITY)
    # The header describes the bus to the firmware of a real gateway; it must fit this very run.
    session.folder.mkdir(parents=True, exist_ok=True)
    description = BusDescription(twin.dbc, machine)
    header = generate_c_header(description, ROUND_TRIP_S, REMOTE_S, TIMEOUT_S)
    write_text(session.folder / HEADER, header)
    with (
        plant.build(machine, 1, session) as link,
        twin.wire.open() as bus,
        FaultPort(twin.fault_port) as port,
    ):
        RunningTwin(twin, machine, link, bus, port).run(stop)


class RunningTwin:
    """A running twin, in real time by `run`, or cycle by cycle.

    Args:
        twin: Settings.
        machine: The machine.
        link: The simulated machine.
        bus: For its messages.
        port: For requests of faults.
    """

    def __init__(
        self, twin: Twin, machine: Machine, link: Link, bus: OpenCanBus, port: FaultPort
    ) -> None:
        self._twin, self._machine, self._link = twin, machine, link
        self._bus, self._port = bus, port
        self._description = BusDescription(twin.dbc, machine)
        self._gateway = Gateway(self._description, machine)
        self._remote = RadioRemote(self._description, machine)
        self._second = RadioRemote(self._description, machine)
        self._second.deadman = True
        self._faults, self._timer = ActiveFaults(), CycleTimer(CYCLE_S)
        self._counters: dict[str, int] = {}
        self._due_s: dict[str, float] = {}
        # Both ends of the first period are the start: the machine is at rest.
        self._q = self._before = np.asarray(link.read().q, dtype=float)
        self._flow, self._oil_c = np.zeros(machine.num_joints), _read_oil_c(link)
        self._source, self._grip_s = NOBODY, -np.inf
        # The first cycle begins a period at once.
        self._period_began_s = -np.inf
        self._stuck: np.ndarray | None = None
        self._origin: np.ndarray | None = None
        remote = self._description.layouts[self._description.message_of("DeadMan")]
        # on some buses a node hears itself; its own remote has been taken in already
        self._own = {remote.frame_id} if twin.remote else set()

    def run(self, stop: Stop) -> None:
        """Run in real time until told to stop, or until its time is over."""
        # The shortest wait is that to the next cycle, so frames take effect when they arrive.
        end_s = time.monotonic() + (self._twin.seconds or np.inf)
        while not stop() and time.monotonic() < end_s:
            try:
                while (left_s := self._timer.next_s - time.monotonic()) > 0:
                    frame = self._bus.recv(left_s)
                    if frame is not None:
                        self.hear(frame, read_steady_s())
                self._timer.begin()
                self.cycle(read_steady_s())
            # A bus that goes down is no reason to end: a real machine goes on too.
            except LinkError as error:
                log.warning("%s", error)
                self._timer.wait()

    def hear(self, frame: CanFrame, now_s: float) -> None:
        """Take in a frame of PC or remote; one that stops the machine takes effect at once."""
        if frame.frame_id not in self._own:
            self._gateway.take(frame, now_s)
            self._apply_flow(now_s)

    def cycle(self, now_s: float) -> None:
        """Let `CYCLE_S` go by: valves, motion, messages."""
        self._port.poll(self._faults, now_s)
        # A study puts the machine elsewhere between two cycles, never within one.
        if (place := self._faults.take_place()) is not None:
            self._place(*place)
        faults, gateway = self._faults, self._gateway
        gateway.estop = faults.on("estop", "", now_s)
        if self._twin.remote:
            self._play_remote(now_s)
        flow, values = self._apply_flow(now_s)
        # Half a cycle early is on time: the next chance would be half a cycle late.
        if now_s - self._period_began_s >= self._machine.period_s - CYCLE_S / 2:
            # After a pause the periods start anew; they are not made up for.
            late = now_s - self._period_began_s > 1.5 * self._machine.period_s
            self._period_began_s = now_s if late else self._period_began_s + self._machine.period_s
            # Sensors interpolate between the two, as the positions are sent more often than
            # computed.
            self._before = self._q
            self._link.send(Command(flow))
            self._q = np.asarray(self._link.read().q, dtype=float)
            self._oil_c = _read_oil_c(self._link)
        values |= self._measure_positions(now_s)
        for layout in self._description.sent_by(GATEWAY):
            self._send(layout.name, values, now_s)
        for frame in faults.due(now_s):
            self._bus.send(frame)
        # A second sender of valve commands: the loop must notice that it is not alone.
        if faults.on("second_sender", "", now_s):
            command = self._description.command
            self._bus.send(
                CanFrame(
                    command.frame_id,
                    self._description.encode(command.name, {}, self._counters.get("JointPos1", 0)),
                )
            )
        # A second remote: nobody else can tell which of the two is the operator's.
        is_on, period_s = faults.on("second_remote", "", now_s), self._second.period_s
        if is_on and self._is_due("second_remote", period_s, now_s):
            frame = self._second.build_frame()
            self._gateway.take(frame, now_s)
            self._bus.send(frame)
        # Identifier of lowest priority: arbitration lets every other frame pass first.
        if faults.on("flood", "", now_s):
            for _ in range(FLOOD):
                self._bus.send(CanFrame(FLOOD_ID, bytes(8)))

    def _place(self, q: list[float], hole_in_base_m: list[float]) -> None:
        """Put machine and block elsewhere, as between two trials of a study, if the plant can."""
        if not hasattr(self._link, "place"):
            log.warning("this simulated machine cannot be put elsewhere; link=site can")
            return
        self._link.place(np.array(q), np.array(hole_in_base_m))  # type: ignore[attr-defined]
        self._q = self._before = np.asarray(self._link.read().q, dtype=float)

    def _apply_flow(self, now_s: float) -> tuple[np.ndarray, dict[str, float]]:
        """Return the flow of the valves, `(J,)`, and the signals that report it.

        A flow that falls to zero is reported at once.
        """
        gateway, before = self._gateway, self._flow
        self._flow, self._source, state = gateway.decide(now_s)
        values: dict[str, float] = {
            "FlowSource": self._source,
            "EStop": gateway.estop,
            "ExclusiveSelected": gateway.exclusive_selected,
            "GatewayState": state.value,
            "RoundTrip": gateway.report_round_trip_s(now_s),
            "OilTemperature": self._oil_c,
            **self._description.identity,
        }
        for name, u in zip(self._machine.joint_names, self._flow, strict=True):
            values[f"Flow_{name}"] = float(u)
        # A stop is reported at once: it must not wait for the message's cycle.
        if before.any() and not self._flow.any():
            names = ("EStop", "FlowSource", f"Flow_{self._machine.joint_names[0]}")
            # In the order of the names, each once.
            for name in dict.fromkeys(map(self._description.message_of, names)):
                self._send(name, values, now_s, at_once=True)
        return self._flow, values

    def _play_remote(self, now_s: float) -> None:
        faults, remote = self._faults, self._remote
        layout = self._description.layouts[self._description.message_of("DeadMan")]
        held = self._holds_deadman(now_s)
        released = remote.deadman and not held  # a release does not wait for its turn
        if not remote.is_ready or not self._is_due(layout.name, layout.period_s, now_s, released):
            return
        remote.deadman = held
        remote.on = not faults.on("remote_off", "", now_s)
        remote.levers = (LEVER_FAULT if faults.on("lever", "", now_s) else 0.0, 0.0, 0.0, 0.0)
        frame = remote.build_frame(
            FROZEN if faults.on("freeze_counter", layout.name, now_s) else None
        )
        self._gateway.take(frame, now_s)
        for one in faults.pass_on(layout, frame, now_s):
            self._bus.send(one)

    def _holds_deadman(self, now_s: float) -> bool:
        """Return whether the operator holds the dead-man.

        A PC that was not ready when it was pressed waits for its release; `again_s` provides one.
        """
        heard = now_s - self._gateway.heard_s > PRESS_S
        released = self._faults.on("deadman_released", "", now_s)
        pressed = self._twin.deadman and heard and not released
        again_s = self._twin.again_s
        # Not held, or the PC has the valves: the patience of `again_s` begins anew.
        if not pressed or self._source == PC:
            self._grip_s = now_s
        elif again_s is not None and now_s - self._grip_s > again_s:
            self._grip_s = now_s + LET_GO_S
        return pressed and now_s >= self._grip_s

    def _is_due(self, name: str, period_s: float, now_s: float, at_once: bool = False) -> bool:
        """Return whether a message is to be sent now; then the next one is due a period later."""
        due_s = self._due_s.get(name, now_s)
        # Half a cycle early is on time: the next chance would be half a cycle late.
        if now_s < due_s - CYCLE_S / 2 and not at_once:
            return False
        # The phase is kept after a delay, and the missed ones are not sent in a burst.
        self._due_s[name] = max(due_s, now_s - period_s) + period_s
        return True

    def _send(
        self, name: str, values: dict[str, float], now_s: float, at_once: bool = False
    ) -> None:
        layout = self._description.layouts[name]
        if not self._is_due(name, layout.period_s, now_s, at_once):
            return
        counter = self._counters[name] = self._counters.get(name, -1) + 1
        # A frozen counter is a fault that only the end-to-end protection can see.
        if self._faults.on("freeze_counter", name, now_s):
            counter = FROZEN
        # All stamps of the bus are readings of the gateway's clock, which is that of this process.
        data = self._description.encode(name, values | {STAMP: now_s}, counter)
        frame = CanFrame(layout.frame_id, data, layout.extended)
        self._remote.hear(frame)
        self._second.hear(frame)
        for one in self._faults.pass_on(layout, frame, now_s):
            self._bus.send(one)

    def _measure_positions(self, now_s: float) -> dict[str, float]:
        """Return positions and validities as the sensors report them, faults included."""
        faults, machine = self._faults, self._machine
        # The share of the period that has gone by; a late cycle stays at its end.
        part = min(1.0, max(0.0, (now_s - self._period_began_s) / machine.period_s))
        q = self._before + part * (self._q - self._before)
        # The value at which it got stuck must be kept as long as the fault is on.
        if faults.on("stuck", "", now_s):
            self._stuck = q if self._stuck is None else self._stuck
            q = self._stuck
        else:
            self._stuck = None
        # The plant's own array must not change with the faults.
        q = q.copy()
        mirrored, doubled = faults.on("mirrored", "", now_s), faults.on("doubled", "", now_s)
        # Both go on from where the machine is when they begin.
        self._origin = q if self._origin is None or not (mirrored or doubled) else self._origin
        if mirrored:
            q = 2.0 * self._origin - q
        if doubled:
            q[0] = 2.0 * q[0] - self._origin[0]
        if faults.on("swapped", "", now_s):
            q[[0, -1]] = q[[-1, 0]]
        if faults.on("offset", "", now_s):
            q[0] += OFFSET_RAD
        if faults.on("jump", "", now_s):
            q[0] += JUMP_RAD
        if faults.on("drift", "", now_s):
            q[0] += DRIFT_RAD_S * faults.since_s("drift", now_s)
        if faults.on("out_of_range", "", now_s):
            q[0] = OUT_OF_RANGE_RAD
        if faults.on("sign", "", now_s):
            q[:] = -q
        valid = 0.0 if faults.on("invalid", "", now_s) else 1.0
        names = machine.joint_names
        values = {f"Valid_{name}": valid for name in names}
        # The signal's range ends here; the encoder refuses larger values.
        clipped = np.clip(q, -SENSOR_RANGE_RAD, SENSOR_RANGE_RAD).tolist()
        for name, position in zip(names, clipped, strict=True):
            values[f"Position_{name}"] = position
        return values


def _read_oil_c(link: Link) -> float:
    """Return the oil's temperature in whole degrees Celsius, as the bus carries it."""
    extra = getattr(link, "extra", dict)()
    if "oil_c" not in extra:
        return USUAL_OIL_C
    # The signal has a resolution of one degree.
    oil_c = np.round(np.asarray(extra["oil_c"]).mean())
    return float(np.clip(oil_c, *OIL_RANGE_C))
