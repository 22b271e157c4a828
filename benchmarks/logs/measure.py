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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

JOINTS, RATE_HZ = 12, 1000.0
BLOCK = 20000
ROW_BYTES = 8 * (1 + 2 * JOINTS)
PAIRS = JOINTS // 2
"""CAN frames of a sample: two joints each, command and position of 16 bits."""
CAN_STEP = 1e-4
EPISODE_BLOCKS = 3
"""Blocks of a LeRobot episode: a minute."""
BITS_LOST = 2000
"""Bytes that the damage overwrites."""


def make_block(begin: int) -> np.ndarray:
    """Return time, commands and positions of `BLOCK` rows, `(BLOCK, 1 + 2 JOINTS)`."""
    t_s = (begin + np.arange(BLOCK)) / RATE_HZ
    phase = t_s[:, None] * np.linspace(0.3, 2.1, JOINTS)
    return np.concatenate([t_s[:, None], np.sin(phase).round(6), np.cos(phase).round(6)], 1)


def list_blocks() -> Iterator[np.ndarray]:
    """Yield blocks without an end."""
    begin = 0
    while True:
        yield make_block(begin)
        begin += BLOCK


def make_arrays(size: int) -> dict[str, np.ndarray]:
    """Return the arrays of a log of about `size` bytes."""
    count = max(size // ROW_BYTES // BLOCK, 1)
    rows = np.concatenate([make_block(k * BLOCK) for k in range(count)])
    return {"t_s": rows[:, 0], "u": rows[:, 1 : 1 + JOINTS], "q": rows[:, 1 + JOINTS :]}


def write_csv(path: Path, size: int) -> None:
    """Write rows of text."""
    names = ["t_s", *(f"u_q{j}" for j in range(JOINTS)), *(f"q_q{j}_rad" for j in range(JOINTS))]
    with path.open("w") as file:
        file.write(",".join(names) + "\n")
        for block in list_blocks():
            np.savetxt(file, block, delimiter=",", fmt="%.6f")
            if file.tell() >= size:
                return


def write_mat(path: Path, size: int) -> None:
    """Write a MATLAB file with compression, as MATLAB does; without it there is no checksum."""
    from scipy import io

    io.savemat(path, make_arrays(size), do_compression=True)


def write_parquet(path: Path, size: int) -> None:
    """Write rows of Parquet without compression, as `.parquet` logs and LeRobot have them."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    writer = None
    episode = 0
    for number, block in enumerate(list_blocks()):
        lists = [
            pa.FixedSizeListArray.from_arrays(pa.array(part.ravel()), JOINTS)
            for part in (block[:, 1 : 1 + JOINTS], block[:, 1 + JOINTS :])
        ]
        episode = number // EPISODE_BLOCKS
        columns = {"timestamp": block[:, 0], "action": lists[0], "observation.state": lists[1]}
        table = pa.table({**columns, "episode_index": np.full(BLOCK, episode)})
        writer = writer or pq.ParquetWriter(
            path, table.schema, compression="none", use_dictionary=False
        )
        writer.write_table(table)
        if path.stat().st_size >= size:
            writer.close()
            return


def write_lerobot(path: Path, size: int) -> None:
    """Write a LeRobotDataset v3: several episodes a file of 100 MB."""
    (path / "meta").mkdir(parents=True)
    feature = {"dtype": "float64", "shape": [JOINTS], "names": [f"q{j}" for j in range(JOINTS)]}
    features = {"action": feature, "observation.state": feature}
    info = {"codebase_version": "v3.0", "fps": RATE_HZ, "features": features}
    (path / "meta" / "info.json").write_text(json.dumps(info))
    folder = path / "data" / "chunk-000"
    folder.mkdir(parents=True)
    for number in range(max(size // 10**8, 1)):
        write_parquet(folder / f"file-{number:03d}.parquet", min(size, 10**8))


def write_mcap(path: Path, size: int) -> None:
    """Write JSON messages."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        channel = writer.register_channel("/state", "json", schema)
        for block in list_blocks():
            for row in block.tolist():
                content = {"u": row[1 : 1 + JOINTS], "q": row[1 + JOINTS :]}
                writer.add_message(channel, round(row[0] * 1e9), json.dumps(content).encode(), 0)
            if file.tell() >= size:
                break
        writer.finish()


def write_bag(path: Path, size: int) -> None:
    """Write a rosbag2 (MCAP storage): JointState with command as effort and position."""
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types["sensor_msgs/msg/JointState"]
    stamp, header = (store.types[f"{n}"] for n in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))  # fmt: skip
    names = [f"q{j}" for j in range(JOINTS)]
    storage = rosbag2.StoragePlugin.MCAP
    written = 0
    with rosbag2.Writer(path, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection("/state", kind.__msgtype__, typestore=store)
        for block in list_blocks():
            for row in block:
                time_ns = round(row[0] * 1e9)
                head = header(stamp(time_ns // 10**9, time_ns % 10**9), "")
                content = kind(head, names, row[1 + JOINTS :], np.empty(0), row[1 : 1 + JOINTS])
                data = store.serialize_cdr(content, kind.__msgtype__)
                writer.write(connection, time_ns, data)
                written += len(data)
            if written >= size:
                return


def write_blf(path: Path, size: int) -> None:
    """Write CAN frames, six for a sample, and the DBC beside them."""
    import can

    lines = ['VERSION ""', "BU_: X"]
    for pair in range(PAIRS):
        lines.append(f"BO_ {256 + pair} J{pair}: 8 X")
        for k in range(2):
            for at, name in enumerate(("u", "q")):
                joint = 2 * pair + k
                lines.append(
                    f' SG_ {name}{joint} : {32 * k + 16 * at}|16@1- ({CAN_STEP},0) [-3|3] "" X'
                )
    path.with_suffix(".dbc").write_text("\n".join(lines) + "\n")
    with can.BLFWriter(path) as writer:
        for block in list_blocks():
            parts = block[:, 1:].reshape(BLOCK, 2, PAIRS, 2).transpose(0, 2, 3, 1)
            words = np.round(parts / CAN_STEP).astype("<i2").reshape(BLOCK, PAIRS, 4)
            for t_s, frames in zip(block[:, 0].tolist(), words, strict=True):
                for pair in range(PAIRS):
                    writer.on_message_received(
                        can.Message(
                            timestamp=t_s,
                            arbitration_id=256 + pair,
                            data=frames[pair].tobytes(),
                            is_extended_id=False,
                        )
                    )
            if path.stat().st_size >= size:
                return


WRITERS: dict[str, Callable[[Path, int], Any]] = {
    "csv": write_csv,
    "npz": lambda path, size: np.savez(path, **make_arrays(size)),
    "mat": write_mat,
    "parquet": write_parquet,
    "lerobot": write_lerobot,
    "mcap": write_mcap,
    "bag": write_bag,
    "blf": write_blf,
}
NAMES = {
    "csv": ("t_s", "u_q{0}", "q_q{0}_rad"),
    "npz": ("t_s", "u[{0}]", "q[{0}]"),
    "mat": ("t_s", "u[{0}]", "q[{0}]"),
    "parquet": ("timestamp", "action[{0}]", "observation.state[{0}]"),
    "lerobot": ("timestamp", "action[q{0}]", "observation.state[q{0}]"),
    "mcap": ("log_time", "/state:u[{0}]", "/state:q[{0}]"),
    "bag": ("header.stamp", "/state:effort[q{0}]", "/state:position[q{0}]"),
    "blf": ("time", "J{1}:u{0}", "J{1}:q{0}"),
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
    reader: Any = ColumnMap(
        delimiter=",", decimal=".", time=Column(column=names[0], scale=1.0, offset=0.0), joints=columns, optional={},
        overrun=0.0, longest_gap_s=0.1, shortest_s=5.0,
    )  # fmt: skip
    if kind == "blf":
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
        path = Path(folder) / ("log" if given.kind in ("bag", "lerobot") else f"log.{given.kind}")
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
