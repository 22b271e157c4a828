"""A desk with real processes: twin, bus process, and a commander in place of the policy, on a multicast bus of their own."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from composed import MACHINE, option
from websockets import Origin
from websockets.sync.client import connect

from actuators.excite.player import NominalMachine
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from deploy.bus.can_bus import CanBus
from deploy.bus.description import BusDescription
from deploy.kernel.bus_process import BusProcessConfig
from deploy.kernel.limits import GuardLimits
from deploy.kernel.protection import MessageFault
from deploy.page.loop_feed import LoopFeed, PageProcessConfig
from deploy.page.settings import LINK
from deploy.runtime.operator_state import OperatorControls, RequestedCommand
from deploy.runtime.process import ChildProcess
from deploy.runtime.shm_layout import LoopMemory
from deploy.twin.faults import request_fault
from deploy.twin.twin import Twin

DBC = "deploy:dbc/example_gateway.dbc"
COMMAND = (0.3, 0.0, -0.3, 0.0, 0.2)
"""What the commander asks for at first; later the same the other way."""
REACH_RAD = 0.2
VCAN = "vcan0"
"""Virtual CAN interface of Linux: sudo modprobe vcan; sudo ip link add vcan0 type vcan up."""
NO_VCAN = not Path(f"/sys/class/net/{VCAN}").exists()


def command(stop: Callable[[], bool], home: np.ndarray, memory: LoopMemory) -> None:
    """Asks for motion twenty times a second, as a policy would: to and fro, so that no joint ever comes to its end."""
    u = np.array(COMMAND)
    while not stop():
        state = memory.state.read()
        if state is not None and state.q_t_s > 0:
            away = state.q - home
            u = np.where(np.abs(away) > REACH_RAD, -np.sign(away) * np.abs(u), u)
        memory.request.write(RequestedCommand(time.monotonic(), u))
        # In place of the supervisor, whose switches may not grow old.
        switches = memory.controls.read()
        if switches is not None:
            memory.controls.write(replace(switches, t_s=time.monotonic()))
        time.sleep(0.05)


def free_port() -> int:
    """Returns a port that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def wire(kind: str) -> CanBus:
    """Returns a bus that nobody else uses: multicast datagrams, or the kernel's own `vcan`."""
    if kind == "vcan":
        return CanBus(interface="socketcan", channel=VCAN, bitrate=None, port=None, hops=None)
    place = {"interface": "udp_multicast", "channel": "239.74.163.77", "port": free_port()}
    return CanBus(**place, bitrate=None, hops=0)


def build_twin(bus: CanBus, **changes: Any) -> Twin:
    """Returns the twin of a gateway that plays its remote and holds the dead-man, with `changes`."""
    usual = {"dbc": DBC, "remote": True, "deadman": True, "again_s": None, "fault_port": None}
    return Twin(wire=bus, seconds=None, realtime=False, **usual | changes)


def build_feed(
    memory: LoopMemory, folder: Path, *camera: float, clock: Callable[[], float] = time.monotonic
) -> LoopFeed:
    """Returns the page's feed of a loop of the default machine; `camera` as in its configuration."""
    parts = (option("page", "local"), MACHINE, option("guidance", "machine"))
    session = Session(out=str(folder), seed=1, device="cpu")
    guard = option("guard", "default")
    return LoopFeed(PageProcessConfig(*parts, session, guard, 600.0, *camera), memory, clock)


class Stop(NamedTuple):
    """How a machine came to rest.

    Attributes:
        flow_s: Until the valves got nothing any more.
        command_s: Until zero was commanded; `None` where nobody was left to do so.
    """

    flow_s: float
    command_s: float | None


class Desk:
    """The processes; a context manager.

    Args:
        machine: The machine.
        limits: Of the guard.
        folder: Where a session may write.
        commands: Whether the bus process may send at all.
        kind: Bus, `udp` or `vcan`.
    """

    def __init__(
        self,
        machine: Machine,
        limits: GuardLimits,
        folder: Path,
        commands: bool = True,
        kind: str = "udp",
    ) -> None:
        self.machine, self.wire, self.port = machine, wire(kind), free_port()
        self.memory = LoopMemory(machine.num_joints, commands)
        self._description = BusDescription(DBC, machine)
        # The observer's file is of the hydraulic plant, not of the nominal machine of this desk.
        limits = replace(limits, observer=None)
        self._setting = BusProcessConfig(self.wire, DBC, machine, limits, needs_page=commands)
        twin = build_twin(self.wire, fault_port=self.port)
        session = Session(out=str(folder), seed=0, device="cpu")
        self._twin_arguments = (twin, machine, NominalMachine(), session, None)
        page = replace(option("page", "local"), port=0)
        guidance = option("guidance", "machine")
        self._page = PageProcessConfig(page, machine, guidance, session, limits, 600.0)
        self._link, self._browser = session.folder / LINK, contextlib.ExitStack()
        self.children: dict[str, ChildProcess] = {}
        self.bus = self.wire.open()

    def start(self, name: str) -> None:
        """Starts `twin`, `bus`, `page` or `commander`."""
        what: dict[str, tuple[str, tuple[Any, ...], int | None]] = {
            "twin": ("deploy.twin.twin:run", self._twin_arguments, 60),
            "bus": ("deploy.kernel.bus_process:run", (self._setting, self.memory), 55),
            "page": ("deploy.page.loop_feed:run", (self._page, self.memory), None),
            "commander": ("desk:command", (self.machine.home, self.memory), 50),
        }
        target, arguments, priority = what[name]
        self.children[name] = ChildProcess(name, target, arguments, self.memory.files, priority)

    def fault(self, fault: str, message: str = "", seconds: float = 1e9) -> float:
        """Switches a fault on; returns when (monotonic)."""
        asked = {"fault": fault, "message": message, "seconds": seconds}
        answer = request_fault(self.port, asked, timeout_s=5.0)
        assert answer.startswith("ok "), answer
        return float(answer.removeprefix("ok "))

    def arm(self, armed: bool = True) -> None:
        """Arms or disarms."""
        # The commander keeps the switches fresh, as the supervisor does.
        now_s = time.monotonic()
        controls = OperatorControls(now_s, armed, now_s, False, 0.0, recording_failed=False)
        self.memory.controls.write(controls)

    def press_stop(self) -> float:
        """Presses STOP as a browser does; returns when."""
        origin, _, token = self._link.read_text().strip().partition("/#token=")
        address = origin.replace("http", "ws") + "/control"
        self._browser.close()
        socket = connect(address, origin=Origin(origin), proxy=None, close_timeout=0.1)
        self._browser.enter_context(socket)
        socket.send(json.dumps({"token": token}))
        socket.recv()
        now_s = time.monotonic()
        # Its answer is not waited for: the bus is listened to meanwhile.
        socket.send(json.dumps({"kind": "stop", "value": ""}))
        return now_s

    def heard(self, message: str, seconds: float) -> list[tuple[float, dict[str, float]]]:
        """Returns what was said on the bus from now on, with when."""
        self._drain()
        layout, end_s, found = self._description.layouts[message], time.monotonic() + seconds, []
        while (left_s := end_s - time.monotonic()) > 0:
            frame = self.bus.recv(left_s)
            if frame is not None and frame.frame_id == layout.frame_id:
                values = self._description.decode(layout, frame.data)
                if not isinstance(values, MessageFault):
                    found.append((time.monotonic(), values))
        return found

    def moves(self) -> bool:
        """Returns whether the valves get anything now."""
        return any(abs(values["Flow_q1"]) > 0 for _, values in self.heard("ValveFeedback", 0.06))

    def set_moving(self, patience_s: float = 20.0) -> None:
        """Goes the operator's way until the machine moves as the commander asks."""
        end_s = time.monotonic() + patience_s
        self.fault("none")
        while time.monotonic() < end_s:
            # The commander may just have written older switches.
            self.arm()
            self.fault("deadman_released", seconds=0.15)
            time.sleep(0.4)
            if all(
                abs(abs(values["Flow_q1"]) - COMMAND[0]) < 0.01
                for _, values in self.heard("ValveFeedback", 0.05)
            ):
                return
        raise AssertionError(f"the machine does not move: {self.memory.read_snapshot()}")

    def still_after(self, since_s: float, seconds: float = 1.0) -> Stop:
        """Returns how long after `since_s` the valves got nothing any more, and zero was commanded, to the end of `seconds`.

        The gateway says zero flow at once, so this is what an observer on the bus sees, and not
        rounded up to its cycle.
        """
        kinds = {
            self._description.layouts[name].frame_id: name for name in ("ValveFeedback", "ValveCmd")
        }
        found: dict[str, float | None] = dict.fromkeys(kinds.values())
        end_s = since_s + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            frame, now_s = self.bus.recv(left_s), time.monotonic()
            if frame is None or (name := kinds.get(frame.frame_id)) is None:
                continue
            values = self._description.decode(self._description.layouts[name], frame.data)
            if isinstance(values, MessageFault):
                continue
            if any(
                value
                for signal, value in values.items()
                if signal.startswith(("Flow_", "Command_"))
            ):
                found[name] = None
            elif found[name] is None:
                found[name] = max(0.0, now_s - since_s)
        flow_s, command_s = found.values()
        assert flow_s is not None, f"still moving after {seconds} s"
        return Stop(flow_s, command_s)

    def signal(self, name: str, number: int) -> float:
        """Sends a signal to a process; returns when."""
        now_s = time.monotonic()
        os.kill(self.children[name].pid, number)
        return now_s

    def wait_for_state(self, patience_s: float = 20.0) -> None:
        """Waits until positions come."""
        end_s = time.monotonic() + patience_s
        while time.monotonic() < end_s:
            state = self.memory.state.read()
            if state is not None and state.q_t_s > 0 and np.isfinite(state.q).all():
                return
            time.sleep(0.02)
        raise AssertionError("nothing comes from the twin")

    def _drain(self) -> None:
        while self.bus.recv(0.0) is not None:
            pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        for child in self.children.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(child.pid, signal.SIGCONT)
            child.end(2.0)
        self._browser.close()
        self.bus.close()
        self.memory.close()
