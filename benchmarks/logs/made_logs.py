"""Large logs of every kind for `measure.py`, written by the libraries of each format where they are fast enough."""

from __future__ import annotations

import json
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
NOISE_STEPS = 10
"""Noise of signals on the bus, in steps: without it a BLF file is compressed as no real one is."""
EPISODE_BLOCKS = 3
"""Blocks of a LeRobot episode: a minute."""


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


def write_npz(path: Path, size: int) -> None:
    """Write a NumPy archive."""
    arrays: dict[str, Any] = dict(make_arrays(size))
    np.savez(path, **arrays)


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


def write_lerobot(path: Path, size: int, version: str = "v3.0") -> None:
    """Write a LeRobotDataset: version 3 with files of 100 MB, version 2 with a file an episode."""
    (path / "meta").mkdir(parents=True)
    feature = {"dtype": "float64", "shape": [JOINTS], "names": [f"q{j}" for j in range(JOINTS)]}
    features = {"action": feature, "observation.state": feature}
    info = {"codebase_version": version, "fps": RATE_HZ, "features": features}
    (path / "meta" / "info.json").write_text(json.dumps(info))
    folder = path / "data" / "chunk-000"
    folder.mkdir(parents=True)
    file_bytes = 10**8 if version == "v3.0" else EPISODE_BLOCKS * BLOCK * ROW_BYTES
    name = "file-{:03d}.parquet" if version == "v3.0" else "episode_{:06d}.parquet"
    for number in range(max(size // file_bytes, 1)):
        write_parquet(folder / name.format(number), min(size, file_bytes))


def write_sage(path: Path, size: int) -> None:
    """Write a folder of SAGE: lists in cells, times in µs, a clock for each file."""
    path.mkdir()
    (path / "joint_list.txt").write_text("".join(f"q{j}\n" for j in range(JOINTS)))
    names = ("control", "state_motor")
    files = [(path / f"{name}.csv").open("w") for name in names]
    for file in files:
        file.write("type,timestamp,positions\n")
    for block in list_blocks():
        for k, (name, file) in enumerate(zip(names, files, strict=True)):
            for row in block.tolist():
                values = row[1 + k * JOINTS : 1 + (k + 1) * JOINTS]
                file.write(f'{name.upper()},{row[0] * 1e6 + 200 * k:.0f},"{values}"\n')
        if sum(file.tell() for file in files) >= size:
            break
    for file in files:
        file.close()


def write_times_and_lists(path: Path, size: int) -> None:
    """Write a CSV file with ISO times and lists in its cells."""
    begin = np.datetime64("2026-03-01T23:59:59", "us")
    with path.open("w") as file:
        file.write("stamp,u,q\n")
        for block in list_blocks():
            stamps = begin + (block[:, 0] * 1e6).round().astype("timedelta64[us]")
            for stamp, row in zip(stamps.astype(str).tolist(), block.tolist(), strict=True):
                file.write(f'{stamp}Z,"{row[1 : 1 + JOINTS]}","{row[1 + JOINTS :]}"\n')
            if file.tell() >= size:
                return


def write_mcap(
    path: Path, size: int, encode: Callable[[list[float]], bytes], schema: tuple[str, str, bytes], encoding: str,
) -> None:  # fmt: skip
    """Write messages, a row each, without compression."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel("/state", encoding, writer.register_schema(*schema))
        for block in list_blocks():
            for row in block.tolist():
                writer.add_message(channel, round(row[0] * 1e9), encode(row), 0)
            if file.tell() >= size:
                break
        writer.finish()


def write_mcap_json(path: Path, size: int) -> None:
    """Write JSON messages."""

    def encode(row: list[float]) -> bytes:
        return json.dumps({"u": row[1 : 1 + JOINTS], "q": row[1 + JOINTS :]}).encode()

    write_mcap(path, size, encode, ("state", "jsonschema", b"{}"), "json")


def write_mcap_protobuf(path: Path, size: int) -> None:
    """Write protobuf messages with packed numbers."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="arm.proto", package="arm", syntax="proto3")
    state = file.message_type.add(name="State")
    for number, name in enumerate(("u", "q"), start=1):
        state.field.add(name=name, number=number, type=1, label=3)
    pool: Any = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("arm.State"))
    data = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()

    def encode(row: list[float]) -> bytes:
        return kind(u=row[1 : 1 + JOINTS], q=row[1 + JOINTS :]).SerializeToString()

    write_mcap(path, size, encode, ("arm.State", "protobuf", data), "protobuf")


def make_joint_state_encoder() -> tuple[Callable[[list[float]], bytes], Any]:
    """Return the CDR of a row as a JointState, command as effort, and the types."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types["sensor_msgs/msg/JointState"]
    stamp, header = (store.types[f"{n}"] for n in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))  # fmt: skip
    names, none = [f"q{j}" for j in range(JOINTS)], np.empty(0)

    def encode(row: list[float]) -> bytes:
        time_ns = round(row[0] * 1e9)
        head = header(stamp(time_ns // 10**9, time_ns % 10**9), "")
        position, effort = np.array(row[1 + JOINTS :]), np.array(row[1 : 1 + JOINTS])
        return bytes(store.serialize_cdr(kind(head, names, position, none, effort), kind.__msgtype__))  # fmt: skip

    return encode, store


def write_mcap_ros2(path: Path, size: int) -> None:
    """Write ROS 2 messages."""
    encode, store = make_joint_state_encoder()
    definition, _ = store.generate_msgdef("sensor_msgs/msg/JointState", ros_version=2)
    schema = ("sensor_msgs/msg/JointState", "ros2msg", definition.encode())
    write_mcap(path, size, encode, schema, "cdr")


def write_bag(path: Path, size: int, storage: str) -> None:
    """Write a rosbag2 of JointState, command as effort."""
    from rosbags import rosbag2

    encode, store = make_joint_state_encoder()
    plugin = rosbag2.StoragePlugin[storage]
    written = 0
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/state", "sensor_msgs/msg/JointState", typestore=store)
        for block in list_blocks():
            for row in block.tolist():
                data = encode(row)
                writer.write(connection, round(row[0] * 1e9), data)
                written += len(data)
            if written >= size:
                return


def write_dbc(path: Path) -> None:
    """Write the DBC file of the frames: two joints a frame."""
    lines = ['VERSION ""', "BU_: X"]
    for pair in range(PAIRS):
        lines.append(f"BO_ {256 + pair} J{pair}: 8 X")
        for k in range(2):
            for at, name in enumerate(("u", "q")):
                place = f"{32 * k + 16 * at}|16@1- ({CAN_STEP},0) [-3|3]"
                lines.append(f' SG_ {name}{2 * pair + k} : {place} "" X')
    path.write_text("\n".join(lines) + "\n")


def list_frames() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield times `(BLOCK,)` and data `(BLOCK, PAIRS, 8)` of frames, with noise of the sensors."""
    generator = np.random.default_rng(0)
    for block in list_blocks():
        parts = block[:, 1:].reshape(BLOCK, 2, PAIRS, 2).transpose(0, 2, 3, 1)
        noise = generator.integers(-NOISE_STEPS, NOISE_STEPS + 1, parts.shape)
        words = np.clip(np.round(parts / CAN_STEP) + noise, -1 / CAN_STEP, 1 / CAN_STEP)
        words = words.astype("<i2")
        yield block[:, 0], words.reshape(BLOCK, PAIRS, 4).view(np.uint8)


def write_blf(path: Path, size: int) -> None:
    """Write CAN frames, six for a sample, and the DBC beside them.

    python-can's writer takes frames one by one, which would take an hour: it gets them by containers.
    """
    import can

    from actuators.recordings.can_log import BLF_FRAME

    class ContainerWriter(can.BLFWriter):
        def add(self, frames: np.ndarray) -> None:
            text = frames.tobytes()
            for begin in range(0, len(text), self.max_container_size):
                self._buffer.append(text[begin : begin + self.max_container_size])
                self._buffer_size += len(self._buffer[-1])
                while self._buffer_size >= self.max_container_size:
                    self._flush()
            self.object_count += len(frames)

    write_dbc(path.with_suffix(".dbc"))
    with ContainerWriter(path) as writer:
        writer.start_timestamp = writer.stop_timestamp = 0.0
        for t_s, data in list_frames():
            frames = np.zeros((BLOCK, PAIRS), BLF_FRAME)
            fixed = {"signature": b"LOBJ", "header_size": 32, "version": 1, "time_unit": 2}
            fixed |= {"size": BLF_FRAME.itemsize, "kind": 1, "channel": 1, "length": 8}
            for name, value in fixed.items():
                frames[name] = value
            frames["ticks"] = np.round(t_s * 1e9)[:, None]
            frames["frame_id"] = 256 + np.arange(PAIRS)
            frames["data"] = data
            writer.add(frames.ravel())
            if path.stat().st_size >= size:
                return


def write_asc(path: Path, size: int) -> None:
    """Write CAN frames as text, as `can.ASCWriter` formats them, and the DBC beside them."""
    write_dbc(path.with_suffix(".dbc"))
    with path.open("w") as file:
        file.write("date Sun Mar 01 23:59:59.000 2026\nbase hex  timestamps absolute\n")
        file.write("internal events logged\nBegin Triggerblock Sun Mar 01 23:59:59.000 2026\n")
        file.write(" 0.000000 Start of measurement\n")
        for t_s, data in list_frames():
            for one_s, frames in zip(t_s.tolist(), data, strict=True):
                for pair in range(PAIRS):
                    text = frames[pair].tobytes().hex(" ").upper()
                    file.write(f"{one_s: 9.6f} 1  {256 + pair:<15X} Rx   d 8 {text}\n")
            if file.tell() >= size:
                break
        file.write("End TriggerBlock\n")


WRITERS: dict[str, Callable[[Path, int], Any]] = {
    "csv": write_csv,
    "csv_iso": write_times_and_lists,
    "npz": write_npz,
    "mat": write_mat,
    "parquet": write_parquet,
    "lerobot": write_lerobot,
    "lerobot2": lambda path, size: write_lerobot(path, size, "v2.1"),
    "sage": write_sage,
    "mcap_json": write_mcap_json,
    "mcap_protobuf": write_mcap_protobuf,
    "mcap_ros2": write_mcap_ros2,
    "bag_sqlite": lambda path, size: write_bag(path, size, "SQLITE3"),
    "bag_mcap": lambda path, size: write_bag(path, size, "MCAP"),
    "blf": write_blf,
    "asc": write_asc,
}
