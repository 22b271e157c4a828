"""A long run of the loop against the twin: lateness, memory, lost records. python benchmarks/deploy/soak.py <folder> <seconds>.

A simulated person follows the advice, and the borehole is another one every 20 s, so that the
machine moves all the time. Writes `<folder>/soak.json`: lateness of bus and policy, each process's
own and shared memory every five minutes, the load, records that the log had to drop, and messages
in the capture against those that were sent.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from deploy.recorder import capture_reader

LOOK_S, ELSEWHERE_S, EVERY_S = 5.0, 20.0, 300.0
HOLES_M = ((2.3, 2.8), (-0.6, 0.6), (0.6, 0.9))
"""Where boreholes lie, x, y and z: within what the policy was trained for."""
LONG_S = 300.0
"""When what has to grow has grown: rings of what is remembered are full."""


def memory_mb(pid: int) -> tuple[float, float] | None:
    """Return a process's own and shared resident memory, MB."""
    try:
        _, resident, shared, *_ = map(int, Path(f"/proc/{pid}/statm").read_text().split())
    except (FileNotFoundError, ProcessLookupError):
        return None
    mb = os.sysconf("SC_PAGE_SIZE") / 1e6
    return (resident - shared) * mb, shared * mb


def watched(run: subprocess.Popen[bytes], folder: Path) -> list[dict[str, Any]]:
    """Move the borehole about and looks at memory and load until the run is over."""
    found, began_s, place = [], time.monotonic(), random.Random(0)
    moved_s = looked_s = -1e9
    while run.poll() is None:
        now_s = time.monotonic()
        if now_s - moved_s >= ELSEWHERE_S:
            moved_s = now_s
            part = folder / "target.part"
            part.write_text(
                json.dumps(
                    {"center_in_base_m": [round(place.uniform(*ends), 3) for ends in HOLES_M]}
                )
            )
            part.replace(folder / "target.json")
        if now_s - looked_s >= EVERY_S and (folder / "processes.json").exists():
            pids = json.loads((folder / "processes.json").read_text())
            sizes = {
                name: size for name, pid in pids.items() if (size := memory_mb(pid)) is not None
            }
            if len(sizes) == len(pids):
                looked_s = now_s
                own, shared = (
                    {name: round(size[i], 2) for name, size in sizes.items()} for i in range(2)
                )
                found.append(
                    {
                        "t_s": round(now_s - began_s),
                        "load": os.getloadavg()[0],
                        "own_mb": own,
                        "shared_mb": shared,
                    }
                )
        time.sleep(LOOK_S)
    return found


def main(folder: Path, seconds: float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable, "-P", "-m", "brokk_rl", "preset=bench", "bench=guided", "link=simulated", "target=file",
        f"target.path={folder / 'target.json'}", f"deploy.seconds={seconds}", f"session.out={folder}",
        f"bus.port={20000 + os.getpid() % 20000}", "page.port=0",
    ]  # fmt: skip
    run = subprocess.Popen(command)
    memory = watched(run, folder)
    timing = json.loads((folder / "timing.json").read_text())
    contents = capture_reader.read_capture(folder / "capture.mcap")
    gaps = {}
    for name, modulus in (("JointPos1", 16), ("ValveFeedback", 16)):
        steps = np.diff(contents.messages[name].series("Counter")) % modulus
        gaps[name] = int((steps != 1).sum())
    late = [one for one in memory if float(one["t_s"]) >= LONG_S] or memory
    growth = {
        name: round(memory[-1]["own_mb"][name] - late[0]["own_mb"][name], 2)
        for name in memory[-1]["own_mb"]
    }
    found = {
        "seconds": seconds,
        "cores": os.cpu_count(),
        "load": {
            "least": min(one["load"] for one in memory),
            "most": max(one["load"] for one in memory),
        },
        "processes": timing["processes"],
        "log_dropped": timing["log_dropped"],
        "messages": {name: len(messages) for name, messages in contents.messages.items()},
        "counter_gaps": gaps,
        "own_memory_growth_after_5_min_mb": growth,
        "memory": memory,
    }
    (folder / "soak.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
