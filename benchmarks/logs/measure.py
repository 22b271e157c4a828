"""Time and memory of reading one large log: `python benchmarks/logs/measure.py <kind> <bytes> <out.json>`.

Kinds: `csv`, `npz`, `mcap` (JSON), `asc`. The log is written first, in a folder that is removed; then a process of
its own reads it through a column map of all its joints, and tells its largest resident memory.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

JOINTS, RATE_HZ = 12, 1000.0
BLOCK = 20000


def make_block(begin: int) -> np.ndarray:
    """Returns time, commands and positions of `BLOCK` rows, `(BLOCK, 1 + 2 JOINTS)`."""
    t_s = (begin + np.arange(BLOCK)) / RATE_HZ
    phase = t_s[:, None] * np.linspace(0.3, 2.1, JOINTS)
    return np.concatenate([t_s[:, None], np.sin(phase).round(6), np.cos(phase).round(6)], 1)


def list_columns() -> list[str]:
    """Returns the columns of a log in one table."""
    return ["t_s", *(f"u_q{j}" for j in range(JOINTS)), *(f"q_q{j}_rad" for j in range(JOINTS))]


def write_log(kind: str, path: Path, size: int) -> None:
    """Writes a log of about `size` bytes."""
    begin = 0
    if kind == "csv":
        with path.open("w") as file:
            file.write(",".join(list_columns()) + "\n")
            while file.tell() < size:
                np.savetxt(file, make_block(begin), delimiter=",", fmt="%.6f")
                begin += BLOCK
    elif kind == "npz":
        num = size // (8 * (1 + 2 * JOINTS)) // BLOCK
        rows = np.concatenate([make_block(k * BLOCK) for k in range(num)])
        np.savez(path, t_s=rows[:, 0], u=rows[:, 1 : 1 + JOINTS], q=rows[:, 1 + JOINTS :])
    elif kind == "mcap":
        from mcap.writer import CompressionType, Writer

        with path.open("wb") as file:
            writer = Writer(file, compression=CompressionType.NONE)
            writer.start()
            schema = writer.register_schema("state", "jsonschema", b"{}")
            channel = writer.register_channel("/state", "json", schema)
            while file.tell() < size:
                for row in make_block(begin).tolist():
                    content = {"u": row[1 : 1 + JOINTS], "q": row[1 + JOINTS :]}
                    writer.add_message(
                        channel, round(row[0] * 1e9), json.dumps(content).encode(), 0
                    )
                begin += BLOCK
            writer.finish()


def read_log(kind: str, path: Path) -> None:
    """Reads the log as a mode would, and prints seconds and memory."""
    from actuators.recordings.column_map import Column, ColumnMap, CommandColumn, JointColumns
    from brokk_rl.machine import Dimension, Joint, Machine

    begun = time.perf_counter()
    names = {
        "csv": ("t_s", "u_q{}", "q_q{}_rad"),
        "npz": ("t_s", "u[{}]", "q[{}]"),
        "mcap": ("log_time", "/state:u[{}]", "/state:q[{}]"),
    }[kind]
    number = Dimension(value=1.0, source="", confidence="low")
    low = Dimension(value=-1.0, source="", confidence="low")
    joints, columns = [], {}
    for j in range(JOINTS):
        joints.append(
            Joint(
                name=f"q{j}",
                part=None,
                kind="hinge",
                lower=low,
                upper=number,
                home=0.0,
                max_speed=number,
                body=None,
            )
        )
        columns[f"q{j}"] = JointColumns(
            command=CommandColumn(
                column=names[1].format(j), neutral=0.0, full_plus=1.0, full_minus=-1.0
            ),
            position=Column(column=names[2].format(j), scale=1.0, offset=0.0),
        )
    machine = Machine(
        name="made", title="made", mjcf=None, period_s=0.01, dead_time_s=0.01, num_history=13, joints=tuple(joints),
        tool_m=None, exclusive=(), levers=(),
    )  # fmt: skip
    reader = ColumnMap(
        delimiter=",", decimal=".", time=Column(column=names[0], scale=1.0, offset=0.0), joints=columns, optional={},
        overrun=0.0, longest_gap_s=0.1, shortest_s=5.0,
    )  # fmt: skip
    recordings = reader.read(path, machine)
    seconds = time.perf_counter() - begun
    print(
        json.dumps(
            {
                "read_s": round(seconds, 1),
                "cpu_s": round(time.process_time(), 1),
                "largest_memory_mb": round(
                    resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                ),
                "minutes_of_log": round(sum(r.duration_s for r in recordings) / 60, 1),
            }
        )
    )


def main() -> None:
    """Writes the log, reads it in a process of its own, writes the result."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=("csv", "npz", "mcap"))
    parser.add_argument("size", type=float)
    parser.add_argument("out", type=Path)
    parser.add_argument("--read", type=Path)
    given = parser.parse_args()
    if given.read:
        read_log(given.kind, given.read)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log.{given.kind}"
        write_log(given.kind, path, int(given.size))
        command = [sys.executable, __file__, given.kind, "0", "-", "--read", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        result = {
            "command": f"python benchmarks/logs/measure.py {given.kind} {given.size:g} {given.out.name}",
            "kind": given.kind,
            "bytes": path.stat().st_size,
            "joints": JOINTS,
            **json.loads(done.stdout.splitlines()[-1]),
            "machine": f"{platform.machine()}, 2 shared cores, Python {platform.python_version()}",
            "commit": subprocess.run(
                ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
            ).stdout.strip(),
        }
    given.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
