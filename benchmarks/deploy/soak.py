"""A long run of the loop against the twin: lateness, memory, lost records. python benchmarks/deploy/soak.py <folder> <seconds>.

Writes `<folder>/soak.json`: lateness of bus and policy, memory of each process a minute after the start and at the end, records
that the log had to drop, and messages in the capture against those that were sent.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

from deploy.recorder import reading


def resident_bytes(pid: int) -> int | None:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (FileNotFoundError, ProcessLookupError):
        return None


def main(folder: Path, seconds: float) -> None:
    command = [
        sys.executable, "-P", "-m", "brokk_rl", "preset=bench", "link=nominal", f"deploy.seconds={seconds}", "deploy.show=false",
        f"session.out={folder}", f"bus.port={20000 + os.getpid() % 20000}", "page.port=0",
    ]  # fmt: skip
    run, memory, begun_s = subprocess.Popen(command), [], time.monotonic()
    while run.poll() is None:
        time.sleep(10.0)
        file = folder / "processes.json"
        if file.exists():
            pids = json.loads(file.read_text())
            memory.append((time.monotonic() - begun_s, {name: resident_bytes(pid) for name, pid in pids.items()}))
    timing = json.loads((folder / "timing.json").read_text())
    known = [(t_s, sizes) for t_s, sizes in memory if all(sizes.values())]
    early = next((sizes for t_s, sizes in known if t_s > 60.0), known[0][1])
    contents = reading.read(folder / "capture.mcap")
    gaps = {}
    for name, modulus in (("JointPos1", 16), ("ValveFeedback", 16)):
        counters = [int(values["Counter"]) for _, values in contents.messages[name]]
        gaps[name] = sum((b - a) % modulus != 1 for a, b in pairwise(counters))
    found = {
        "seconds": seconds,
        "load": os.getloadavg(),
        "cores": os.cpu_count(),
        "processes": timing["processes"],
        "log_dropped": timing["log_dropped"],
        "messages": {name: len(messages) for name, messages in contents.messages.items()},
        "counter_gaps": gaps,
        "memory_bytes": {"after_a_minute": early, "at_the_end": known[-1][1]},
    }
    (folder / "soak.json").write_text(json.dumps(found, indent=2) + "\n")
    sys.stdout.write(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
