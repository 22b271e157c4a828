"""Reaction times with real processes: python benchmarks/deploy/reactions.py <json> [trials].

Twin, bus process and a commander on a multicast bus, all with real-time priority where it is
granted, the listener too. After each kill, stop or fault: the time until the valves get nothing any
more, and until the guard commands zero, as the listener hears it. A fault counts from the cycle of
the twin that begins with it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(ROOT / "tests"), str(ROOT), os.environ.get("PYTHONPATH", "")]
)

from composed import option  # noqa: E402
from desk import Desk, Stop  # noqa: E402

from deploy.runtime.process import ask_for_priority  # noqa: E402

KILLED = ("commander", "bus", "page")
NUMBERS = (signal.SIGKILL, signal.SIGSTOP)
FAULTS = (
    ("estop", ""), ("deadman_released", ""), ("remote_off", ""), ("drop", "JointPos1"), ("drop", "LeverState"),
    ("drop", "MachineStatus"), ("corrupt", "JointPos2"), ("freeze_counter", "JointPos1"), ("masquerade", "MachineStatus"),
    ("short", "LeverState"), ("wrong_id", "JointPos1"), ("delay", "JointPos2"), ("jump", ""), ("out_of_range", ""), ("invalid", ""),
    ("second_sender", ""), ("second_remote", ""),
)  # fmt: skip
OFTEN = ("estop", "deadman_released", "second_remote")
"""Faults with as many trials as kills; the others have three."""


def main(path: Path, trials: int) -> None:
    found: dict[str, list[Stop]] = {}
    granted = ask_for_priority(65)
    with (
        tempfile.TemporaryDirectory() as folder,
        Desk(option("machine", "brokk170"), option("guard", "default"), Path(folder)) as desk,
    ):
        for name in ("twin", "bus", "page", "commander"):
            desk.start(name)
        desk.wait_for_state()
        for trial in range(trials):
            name, number = KILLED[trial % len(KILLED)], NUMBERS[trial // len(KILLED) % 2]
            desk.set_moving(60.0)
            key = f"{name} {signal.Signals(number).name}"
            found.setdefault(key, []).append(desk.still_after(desk.signal(name, number)))
            if number == signal.SIGSTOP:
                desk.signal(name, signal.SIGCONT)
                time.sleep(0.1)
            else:
                desk.children[name].end(1.0)
                desk.start(name)
                desk.wait_for_state(60.0)
        for _ in range(trials):
            desk.set_moving(60.0)
            found.setdefault("stop on the page", []).append(
                desk.still_after(desk.press_stop(), 0.6)
            )
        for fault, message in FAULTS:
            for _ in range(trials if fault in OFTEN else 3):
                desk.set_moving(60.0)
                found.setdefault(f"{fault} {message}".strip(), []).append(
                    desk.still_after(desk.fault(fault, message), 0.6)
                )
                desk.fault("none")
    table = {key: row(stops) for key, stops in found.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    circumstances = {"cores": os.cpu_count(), "load": os.getloadavg(), "listener": granted}
    path.write_text(json.dumps(circumstances | {"reactions": table}, indent=2) + "\n")


def row(stops: list[Stop]) -> dict[str, float]:
    """Return what the trials of one event come to."""
    flow_ms = sorted(round(1e3 * stop.flow_s, 1) for stop in stops)
    command_ms = sorted(
        round(1e3 * stop.command_s, 1) for stop in stops if stop.command_s is not None
    )
    found: dict[str, float] = {
        "trials": len(stops),
        "flow_median_ms": flow_ms[len(flow_ms) // 2],
        "flow_worst_ms": flow_ms[-1],
    }
    return found | ({"command_worst_ms": command_ms[-1]} if command_ms else {})


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 60)
