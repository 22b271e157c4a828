"""Messages of MCAP files, ROS bags and CAN logs, as the libraries' own writers wrote them."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from carriage import check, make_map, make_signals
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from log_import import write_messages
from mcap.writer import Writer

from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine


def make_topic_map(command: str, position: str, time: str = "log_time") -> Any:
    return make_map(f"/command:{command}", f"/state:{position}", time)


def list_rows() -> list[tuple[int, float, float]]:
    """Returns time in ns, command and position of each row."""
    signals = make_signals()
    rows = zip(signals["t"].tolist(), signals["u"].tolist(), signals["q"].tolist(), strict=True)
    return [(1_700_000_000_000_000_000 + round(t * 1e9), u, q) for t, u, q in rows]


def write_json(path: Path) -> Any:
    messages = []
    for t_s, u, q in zip(*make_signals().values(), strict=True):
        messages.append((t_s, "/command", {"u": {"raw": [0.0, u]}}))
        messages.append((t_s, "/state", {"q": q, "text": "a"}))
    write_messages(path, messages)
    return make_topic_map("u.raw[1]", "q")


def make_protobuf() -> tuple[bytes, Any]:
    """Returns schema and class of a message with a nested, repeated joint."""
    file = descriptor_pb2.FileDescriptorProto(name="arm.proto", package="arm", syntax="proto3")
    joint = file.message_type.add(name="Joint")
    joint.field.add(name="name", number=1, type=9, label=1)
    joint.field.add(name="value", number=2, type=1, label=1)
    state = file.message_type.add(name="State")
    state.field.add(name="joints", number=1, type=11, label=3, type_name=".arm.Joint")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("arm.State"))
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), kind


def write_protobuf(path: Path) -> Any:
    data, kind = make_protobuf()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("arm.State", "protobuf", data)
        channels = [writer.register_channel(topic, "protobuf", schema) for topic in ("/command", "/state")]  # fmt: skip
        for time_ns, *values in list_rows():
            for channel, value in zip(channels, values, strict=True):
                message = kind()
                message.joints.add(name="jaw", value=9.0)
                message.joints.add(name="slide", value=value)
                writer.add_message(channel, time_ns, message.SerializeToString(), time_ns)
        writer.finish()
    return make_topic_map("joints[slide].value", "joints[slide].value")


def write_bag(path: Path, storage: str, stamped: bool = True) -> Any:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    kind = types["sensor_msgs/msg/JointState"]
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage]) as writer:
        topics = ("/command", "/state")
        connections = [writer.add_connection(topic, kind.__msgtype__, typestore=store) for topic in topics]  # fmt: skip
        for number, (time_ns, *values) in enumerate(list_rows()):
            side = -1 if number % 7 == 3 else 1  # a driver may change the order of its joints
            for connection, value in zip(connections, values, strict=True):
                stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
                header = types["std_msgs/msg/Header"](stamp, "")
                names, places = ["jaw", "slide"][::side], np.array([9.0, value])[::side]
                message = kind(header, names, places.copy(), np.empty(0), np.empty(0))
                data = store.serialize_cdr(message, kind.__msgtype__)
                writer.write(connection, time_ns, data)
    time = "header.stamp" if stamped else "log_time"
    return make_topic_map("position[slide]", "position[slide]", time)


def write_ros2(path: Path) -> Any:
    """Writes the file of a bag alone, as a recorder without bags does."""
    reader = write_bag(path.with_name("bag"), "MCAP", stamped=False)
    (file,) = path.with_name("bag").glob("*.mcap")
    file.rename(path)
    return reader


WRITERS: dict[str, Callable[[Path], Any]] = {
    "json.mcap": write_json,
    "protobuf.mcap": write_protobuf,
    "ros2.mcap": write_ros2,
    "sqlite": lambda path: write_bag(path, "SQLITE3"),
    "mcap": lambda path: write_bag(path, "MCAP"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_messages_of_every_encoding_give_the_same_recording(
    tmp_path: Path, carriage: Machine, name: str
) -> None:
    needed = {"json.mcap": "mcap", "protobuf.mcap": "mcap_protobuf"}
    pytest.importorskip(needed.get(name, "rosbags"))
    reader = WRITERS[name](tmp_path / name)
    (recording,) = reader.read(tmp_path / name, carriage)
    # stamps are seconds since 1970, rounded to 0.2 µs; the position steps by 0.12 m within 10 ms
    check(recording, 1e-5 if reader.time.column == "header.stamp" else 1e-6)


def test_a_damaged_sqlite_bag_is_refused_by_its_name(tmp_path: Path, carriage: Machine) -> None:
    reader = WRITERS["sqlite"](tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.db3")
    data = bytearray(file.read_bytes())
    begin = int(0.6 * len(data)) // 4096 * 4096  # SQLite keeps messages in pages of 4096 bytes
    data[begin : begin + 4096] = b"\xff" * 4096
    file.write_bytes(data)
    with pytest.raises(RecordingError, match=r"bag: .*malformed"):
        reader.read(tmp_path / "bag", carriage)


def test_a_message_that_cannot_be_decoded_is_told_by_its_number(
    tmp_path: Path, carriage: Machine
) -> None:
    path, messages = tmp_path / "a.mcap", []
    for number, (t_s, u, q) in enumerate(zip(*make_signals().values(), strict=True)):
        content = b'{"u": 1.0, "q"' if number == 120 else {"u": u, "q": q}
        messages.append((t_s, "/state", content))
    write_messages(path, messages)
    place = r"topic /state, message 120, 1\.200 s from the first one: cannot be decoded"
    with pytest.raises(RecordingError, match=place):
        make_map("/state:u", "/state:q", "log_time").read(path, carriage)


def write_chunks(path: Path) -> Any:
    """Writes JSON messages in many small chunks of random text, which compression cannot shrink."""
    messages, generator = [], random.Random(0)
    for t_s, u, q in zip(*make_signals().values(), strict=True):
        messages.append((t_s, "/state", {"u": u, "q": q, "text": generator.random()}))
    write_messages(path, messages, 2000)
    reader = make_map("/state:u", "/state:q", "log_time")
    return replace(reader, longest_gap_s=0.015, shortest_s=0.0)


def test_what_is_whole_of_a_damaged_mcap_is_read_when_asked(
    tmp_path: Path, carriage: Machine, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.mcap"
    reader = write_chunks(path)
    (whole,) = reader.read(path, carriage)
    data = bytearray(path.read_bytes())
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"a\.mcap: .*chunk at byte \d+: .*damaged=skip"):
        reader.read(path, carriage)
    skipping = replace(reader, damaged="skip")
    first, second = skipping.read(path, carriage)
    skipping.read(path, carriage)
    assert len([one for one in caplog.messages if "left out" in one]) == 1
    np.testing.assert_array_equal(first.u, whole.u[: first.num_samples])
    np.testing.assert_array_equal(second.u, whole.u[-second.num_samples :])
    assert first.num_samples + second.num_samples < whole.num_samples
    with pytest.raises(RecordingError, match=r"cut\.mcap: .*damaged after \d+ messages"):
        reader.read(cut, carriage)
    (begin,) = skipping.read(cut, carriage)
    np.testing.assert_array_equal(begin.u, whole.u[: begin.num_samples])
    path.write_text("no log")
    with pytest.raises(RecordingError, match="damaged after 0 messages"):
        reader.read(path, carriage)
