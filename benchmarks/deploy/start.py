"""From the command to an open bus and the first cycle of the policy: [chrt -r 1] python benchmarks/deploy/start.py <file> <trials>.

`brokk preset=machine` on a bus of datagrams, as nothing else is here. Wall time from the command
on, and what each process computed until the bus was open. With `chrt -r 1` as on a computer that
has nothing else to do. The first trial is not counted: modules are compiled in it, as once after
each installation, unless Python is kept from storing that (`PYTHONDONTWRITEBYTECODE`).
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from deploy.recorder import capture_reader

PATIENCE_S = 60.0
OPEN = " is open"
"""What the bus process says when it is."""


def computed_s(pid: int) -> float:
    """Return the processor time that a process has taken so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def trial(folder: Path) -> dict[str, Any]:
    command = [
        sys.executable, "-P", "-m", "brokk_rl", "preset=machine", "bus=udp", f"bus.port={20000 + os.getpid() % 20000}",
        "target=given", "page.port=0", f"session.out={folder}",
    ]  # fmt: skip
    begun_s = time.monotonic()
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert run.stderr is not None
    for line in run.stderr:
        if OPEN in line:
            break
    open_s = time.monotonic() - begun_s
    while not (folder / "processes.json").exists():
        time.sleep(0.01)
    pids = json.loads((folder / "processes.json").read_text())
    computed = {"command": computed_s(run.pid)} | {
        name: computed_s(pid) for name, pid in pids.items()
    }
    time.sleep(2.0)
    run.send_signal(signal.SIGINT)
    run.stderr.read()
    run.wait(PATIENCE_S)
    cycle_s = (
        capture_reader.read_capture(folder / "capture.mcap").messages["advice"][0][0] - begun_s
    )
    return {
        "bus_open_s": round(open_s, 3),
        "policy_cycle_s": round(cycle_s, 3),
        "computed_s": computed,
        "load": os.getloadavg()[0],
    }


def main(file: Path, trials: int) -> None:
    found = []
    for number in range(trials + 1):
        with tempfile.TemporaryDirectory() as folder:
            found.append(trial(Path(folder) / str(number)))
        sys.stdout.write(json.dumps(found[-1]) + "\n")
        sys.stdout.flush()
    del found[0]
    ahead = os.sched_getscheduler(0) != os.SCHED_OTHER
    summary = {
        key: {
            "median": statistics.median(one[key] for one in found),
            "worst": max(one[key] for one in found),
        }
        for key in ("bus_open_s", "policy_cycle_s")
    }
    file.write_text(
        json.dumps(
            {
                "ahead": ahead,
                "bytecode": not sys.dont_write_bytecode,
                "cores": os.cpu_count(),
                **summary,
                "trials": found,
            },
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
