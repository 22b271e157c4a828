"""Each process of the running loop stopped and woken: python benchmarks/deploy/stopped.py <json>.

The loop commands the twin (`deploy=auto`, nominal machine), with page and log. Each
process gets SIGSTOP for 0.9 s while the machine moves, then SIGCONT. A listener on the bus notes when
the valves got nothing, and whether they move again before the dead-man is pressed anew. At last two
hundred connections to the page send half a request and nothing more.
"""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from composed import option  # noqa: E402
from desk import DBC, free_port  # noqa: E402

from deploy.bus.can_bus import CanBus, OpenCanBus  # noqa: E402
from deploy.bus.description import BusDescription  # noqa: E402
from deploy.kernel.protection import MessageFault  # noqa: E402
from deploy.runtime.process import ask_for_priority  # noqa: E402
from deploy.twin.faults import request_fault  # noqa: E402

CHANNEL = "239.74.163.78"
STOPPED_S, WOKEN_S, PATIENCE_S = 0.9, 1.5, 60.0
"""Times for which a process is stopped and watched afterwards, and patience. The twin's operator lets go
and presses anew where nothing is heard of the PC for a second."""
NAMES = ("supervisor", "bus", "policy", "page", "log")
NUM_MUTE = 200


class Listener:
    """The valves, as somebody on the bus hears of them."""

    def __init__(self, bus: OpenCanBus) -> None:
        self._bus, description = bus, BusDescription(DBC, option("machine", "brokk170"))
        self._description, self._layout = description, description.layouts["ValveFeedback"]

    def find_moves_s(self, seconds: float) -> list[float]:
        """Return the times of all messages from now on by which the valves got something."""
        while self._bus.recv(0.0) is not None:
            pass
        found, end_s = [], time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            frame = self._bus.recv(left_s)
            if frame is None or frame.frame_id != self._layout.frame_id:
                continue
            values = self._description.decode(self._layout, frame.data)
            if isinstance(values, MessageFault):
                continue
            if any(value for name, value in values.items() if name.startswith("Flow_")):
                found.append(time.monotonic())
        return found


class Loop:
    """The loop as a command, its twin, and a borehole that is another one each time."""

    def __init__(self, folder: Path, port: int, fault_port: int) -> None:
        self._folder, self._fault_port, self._draw = folder, fault_port, random.Random(0)
        self.move_borehole()
        arguments = [
            "preset=bench", "deploy=auto", "link=nominal", "target=file", f"target.path={folder / 'target.json'}",
            "guard.observer=null", "bench.twin.again_s=null", f"bench.twin.fault_port={fault_port}", f"bus.port={port}",
            f"bus.channel={CHANNEL}", "page.port=0", f"session.out={folder / 'run'}",
        ]  # fmt: skip
        command = [sys.executable, "-P", "-m", "brokk_rl", *arguments]
        nothing = subprocess.DEVNULL
        self.process = subprocess.Popen(command, stdout=nothing, stderr=nothing)

    @property
    def pids(self) -> dict[str, int]:
        """Processes of the loop."""
        found = json.loads((self._folder / "run" / "processes.json").read_text())
        return found | {"supervisor": self.process.pid}

    def move_borehole(self) -> None:
        """Choose another borehole, within what the policy was trained for."""
        ends_m = ((2.3, 2.8), (-0.6, 0.6), (0.6, 0.9))
        place = [round(self._draw.uniform(*ends), 3) for ends in ends_m]
        part = self._folder / "target.part"
        part.write_text(json.dumps({"center_in_base_m": place}))
        part.replace(self._folder / "target.json")

    def get_moving(self, listener: Listener) -> None:
        """Release and press the dead-man until the valves get something."""
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            self.move_borehole()
            time.sleep(0.5)
            request = {"fault": "deadman_released", "seconds": 0.3}
            request_fault(self._fault_port, request, timeout_s=5.0)
            time.sleep(1.0)
            if len(listener.find_moves_s(0.5)) > 15:
                return
        raise SystemExit("the machine does not move")


def measure_stop(loop: Loop, listener: Listener, name: str) -> dict[str, object]:
    """Stop a process, wake it, and return what became of the motion."""
    loop.get_moving(listener)
    begun_s = time.monotonic()
    os.kill(loop.pids[name], signal.SIGSTOP)
    moves_s = listener.find_moves_s(STOPPED_S)
    os.kill(loop.pids[name], signal.SIGCONT)
    again = len(listener.find_moves_s(WOKEN_S))
    goes_on = bool(moves_s) and moves_s[-1] > begun_s + STOPPED_S - 0.3
    row: dict[str, object] = {"goes_on": goes_on, "messages_with_flow_after_waking": again}
    if not goes_on:
        row["last_flow_ms"] = round(1e3 * (moves_s[-1] - begun_s), 1) if moves_s else 0.0
    return row


def measure_mute(loop: Loop, listener: Listener, url: str) -> dict[str, object]:
    """Open many connections that say half a request; return motion and the page's answer."""
    loop.get_moving(listener)
    host, port = url.removeprefix("http://").partition("/")[0].split(":")
    mute = [socket.create_connection((host, int(port)), timeout=5.0) for _ in range(NUM_MUTE)]
    for one in mute:
        one.sendall(b"GET / HTTP/1.1\r\nHost: ")
    moves = len(listener.find_moves_s(1.0))
    begun_s = time.monotonic()
    with urllib.request.urlopen(url, timeout=10.0) as answer:
        status = answer.status
    answered_ms = round(1e3 * (time.monotonic() - begun_s), 1)
    for one in mute:
        one.close()
    return {
        "messages_with_flow": moves,
        "page_status": status,
        "page_answers_after_ms": answered_ms,
    }


def main(path: Path) -> None:
    port, fault_port = free_port(), free_port()
    wire = CanBus(interface="udp_multicast", channel=CHANNEL, bitrate=None, port=port, hops=0)
    table: dict[str, object] = {"cores": os.cpu_count(), "load_before": os.getloadavg()[0]}
    ask_for_priority(65)
    with tempfile.TemporaryDirectory() as folder, wire.open() as bus:
        loop, listener = Loop(Path(folder), port, fault_port), Listener(bus)
        try:
            end_s = time.monotonic() + PATIENCE_S
            ready = [Path(folder) / "run" / name for name in ("page.url", "processes.json")]
            while not all(one.exists() for one in ready) and time.monotonic() < end_s:
                time.sleep(0.2)
            for name in NAMES:
                if name in loop.pids:
                    table[name] = measure_stop(loop, listener, name)
                    sys.stdout.write(f"{name}: {table[name]}\n")
            url = (Path(folder) / "run" / "page.url").read_text().partition("#")[0].strip()
            table[f"{NUM_MUTE} half requests"] = measure_mute(loop, listener, url)
            sys.stdout.write(f"{table[f'{NUM_MUTE} half requests']}\n")
        finally:
            loop.process.send_signal(signal.SIGINT)
            loop.process.wait(20.0)
    table["load_after"] = os.getloadavg()[0]
    path.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
