"""Time and memory of reading one large log: `python benchmarks/logs/measure.py <kind> <bytes> <out.json>`.

The log is written first, in a folder that is removed. A process of its own reads it through a column
map of all its joints and tells its largest resident memory. Then the log is damaged in the middle and
read once more; the JSON holds what the refusal says.
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
from typing import Any

from made_logs import JOINTS, WRITERS

BITS_LOST = 2000
"""Bytes that the damage overwrites."""


ENDINGS = {"csv_iso": "csv", "mcap_json": "mcap", "mcap_protobuf": "mcap", "mcap_ros2": "mcap"}
FOLDERS = ("lerobot", "lerobot2", "sage", "bag_sqlite", "bag_mcap")
ARRAYS = ("t_s", "u[{0}]", "q[{0}]")
LEROBOT = ("timestamp", "action[q{0}]", "observation.state[q{0}]")
JOINT_STATE = ("header.stamp", "/state:effort[q{0}]", "/state:position[q{0}]")
CAN = ("time", "J{1}:u{0}", "J{1}:q{0}")
NAMES = {
    "csv": ("t_s", "u_q{0}", "q_q{0}_rad"),
    "csv_iso": ("stamp", "u[{0}]", "q[{0}]"),
    "npz": ARRAYS,
    "mat": ARRAYS,
    "parquet": ("timestamp", "action[{0}]", "observation.state[{0}]"),
    "lerobot": LEROBOT,
    "lerobot2": LEROBOT,
    "sage": ("timestamp", "control:positions[q{0}]", "state_motor:positions[q{0}]"),
    "mcap_json": ("log_time", "/state:u[{0}]", "/state:q[{0}]"),
    "mcap_protobuf": ("log_time", "/state:u[{0}]", "/state:q[{0}]"),
    "mcap_ros2": JOINT_STATE,
    "bag_sqlite": JOINT_STATE,
    "bag_mcap": JOINT_STATE,
    "blf": CAN,
    "asc": CAN,
}
"""Columns of time, command and position; `{0}` is the joint, `{1}` its frame."""


def read_log(kind: str, path: Path) -> None:
    """Read the log as a mode would, and print seconds and memory, or the refusal."""
    from actuators.recordings.column_map import (
        CanColumnMap,
        Column,
        ColumnMap,
        CommandColumn,
        JointColumns,
    )
    from brokk_rl.errors import RecordingError
    from brokk_rl.machine import Dimension, Joint, Machine

    begun = time.perf_counter()
    names = NAMES[kind]
    number = Dimension(value=1.0, source="", confidence="low")
    low = Dimension(value=-1.0, source="", confidence="low")
    joints, columns = [], {}
    for j in range(JOINTS):
        joints.append(
            Joint(
                name=f"q{j}", part=None, kind="hinge", lower=low, upper=number, home=0.0,
                max_speed=number, body=None,
            )
        )  # fmt: skip
        columns[f"q{j}"] = JointColumns(
            command=CommandColumn(
                column=names[1].format(j, j // 2), neutral=0.0, full_plus=1.0, full_minus=-1.0
            ),
            position=Column(column=names[2].format(j, j // 2), scale=1.0, offset=0.0),
        )
    machine = Machine(
        name="made", title="made", mjcf=None, period_s=0.01, dead_time_s=0.01, num_history=13, joints=tuple(joints),
        tool_m=None, exclusive=(), levers=(),
    )  # fmt: skip
    time_column = Column(column=names[0], scale=1e-6 if kind == "sage" else 1.0, offset=0.0)
    reader: Any = ColumnMap(
        delimiter=",", decimal=".", time=time_column, joints=columns, optional={},
        overrun=0.0, longest_gap_s=0.1, shortest_s=5.0,
    )  # fmt: skip
    if kind in ("blf", "asc"):
        reader = CanColumnMap(dbc=str(path.with_suffix(".dbc")), columns=reader)
    try:
        recordings = reader.read(path, machine)
    except RecordingError as error:
        print(json.dumps({"refusal": str(error).replace(str(path.parent) + "/", "")}))
        return
    usage = resource.getrusage(resource.RUSAGE_SELF)
    found = {
        "read_s": round(time.perf_counter() - begun, 1),
        "cpu_s": round(time.process_time(), 1),
        "largest_memory_mb": round(usage.ru_maxrss / 1024),
        "minutes_of_log": round(sum(one.duration_s for one in recordings) / 60, 1),
    }
    print(json.dumps(found))


def name_log(kind: str) -> str:
    """Return the name of the file or folder of a log."""
    return "log" if kind in FOLDERS else f"log.{ENDINGS.get(kind, kind)}"


def list_files(path: Path) -> list[Path]:
    """Return the files of a log with their data, the largest last."""
    inside = [one for one in path.rglob("*") if one.is_file()] if path.is_dir() else [path]
    return sorted(inside, key=lambda one: one.stat().st_size)


def damage(path: Path) -> None:
    """Overwrite some bytes in the middle of the largest file of a log."""
    file = list_files(path)[-1]
    with file.open("r+b") as stream:
        stream.seek(file.stat().st_size // 2)
        stream.write(b"\xa5" * BITS_LOST)


def main() -> None:
    """Write the log, read it in a process of its own, damage it, write the result."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=WRITERS)
    parser.add_argument("size", type=float)
    parser.add_argument("out", type=Path)
    parser.add_argument("--read", type=Path)
    parser.add_argument("--write", type=Path)
    given = parser.parse_args()
    if given.write:
        WRITERS[given.kind](given.write, int(given.size))
        return
    if given.read:
        read_log(given.kind, given.read)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name_log(given.kind)
        # a process begins with the largest memory of its parent, so that a child has to write
        made = [given.kind, str(given.size), "-", "--write", str(path)]
        subprocess.run([sys.executable, __file__, *made], check=True)
        command = [sys.executable, __file__, given.kind, "0", "-", "--read", str(path)]
        results = []
        for is_damaged in (False, True):
            if is_damaged:
                damage(path)
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            results.append(json.loads(done.stdout.splitlines()[-1]))
        size = sum(one.stat().st_size for one in list_files(path))
        result = {
            "command": f"python benchmarks/logs/measure.py {given.kind} {given.size:g} {given.out.name}",
            "kind": given.kind,
            "bytes": size,
            "joints": JOINTS,
            **results[0],
            "damaged_in_the_middle": results[1].get("refusal", "read as if it were whole"),
            "machine": f"{platform.machine()}, 2 shared cores, Python {platform.python_version()}",
            "commit": subprocess.run(
                ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
            ).stdout.strip(),
        }
    given.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
