"""Reaction times with real processes: python benchmarks/deploy/reactions.py <json> [trials].

Twin, bus process and a commander on a multicast bus; after each kill, stop or fault the time until the valves get nothing any more,
as a listener on the bus sees it (the twin's own cycle of 10 ms and the 20 ms between its messages included).
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
os.environ["PYTHONPATH"] = str(ROOT / "tests")

from composed import option  # noqa: E402
from desk import Desk  # noqa: E402

KILLS = (("commander", signal.SIGKILL), ("commander", signal.SIGSTOP), ("bus", signal.SIGKILL), ("bus", signal.SIGSTOP))
FAULTS = (
    ("estop", ""), ("deadman_released", ""), ("remote_off", ""), ("drop", "JointPos1"), ("drop", "LeverState"),
    ("drop", "MachineStatus"), ("corrupt", "JointPos2"), ("freeze_counter", "JointPos1"), ("masquerade", "MachineStatus"),
    ("short", "LeverState"), ("wrong_id", "JointPos1"), ("delay", "JointPos2"), ("jump", ""), ("out_of_range", ""), ("invalid", ""),
    ("second_sender", ""),
)  # fmt: skip


def main(path: Path, trials: int) -> None:
    found: dict[str, list[float]] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        Desk(option("machine", "brokk170"), option("guard", "default"), Path(folder)) as desk,
    ):
        for name in ("twin", "bus", "commander"):
            desk.start(name)
        desk.wait_for_state()
        for trial in range(trials):
            for name, number in (KILLS[trial % len(KILLS)],):
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
        for fault, message in FAULTS:
            for _ in range(3):
                desk.set_moving(60.0)
                found.setdefault(f"{fault} {message}".strip(), []).append(desk.still_after(desk.fault(fault, message), 0.6))
                desk.fault("none")
    table = {key: {"trials": len(v), "median_s": sorted(v)[len(v) // 2], "worst_s": max(v)} for key, v in found.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"cores": os.cpu_count(), "load": os.getloadavg(), "reactions": table}, indent=2) + "\n")
    for key, row in table.items():
        sys.stdout.write(
            f"{key:28} {row['trials']:3} trials  median {1e3 * row['median_s']:4.0f} ms  worst {1e3 * row['worst_s']:4.0f} ms\n"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 60)
