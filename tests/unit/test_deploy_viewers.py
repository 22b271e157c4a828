"""Captures as other programs read them: schemas, and the pictures in Foxglove's messages."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from block import BLOCK_M, TARGETS, take_frame
from composed import MACHINE, option
from desk import DBC
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from deploy.bus.description import BusDescription
from deploy.kernel.bus_process import FRAME, FRAMES
from deploy.page.replay import ReplayFeed
from deploy.recorder.capture import MCAP, CaptureConfig, CaptureWriter
from deploy.recorder.capture_reader import read_capture
from deploy.recorder.topics import TOPICS, TopicSchema
from deploy.runtime.shm_layout import TEXT

BEGIN_S = 700.0
Q = [0.3, -0.8, 0.6, 1.0, 0.4]
SAID: dict[str, dict[str, Any]] = {
    "advice": {
        "reason": "valid", "u": [0.1, 0.0, -0.2, 0.0, 0.3], "lever_rad": [0.1, 0.2, 0.0, -0.1], "button_right": True,
        "target_in_base_m": list(TARGETS[0].center_in_base_m), "infer_s": 0.002,
        "observation": [0.5, -0.25, 1.0],
    },
    "guard": {"state": "LATCHED", "trip": "remote missing", "cause": "remote missing", "joint": "q2"},
    "fault": {"frame_id": 4660, "fault": "wrong CRC"},
    "bus": {"down": "no such device"},
    "wish": {
        "kind": "target", "value": "1", "taken": False, "asked_s": 1.5, "center_in_base_m": [2.6, 0.0, 0.75],
        "std_m": 0.002, "seen_s": 1.25,
    },
    "view": {
        "name": "lift 2.00 m", "is_moving": True, "travel_s": 1.5, "seen_s": 4.5, "seen_before_s": 0.5,
        "horizon_s": 6.0, "std_m": 0.001, "std_before_m": 0.004,
    },
    "refused": {"message": "JointPos1", "fault": "wrong length", "data": "00ff"},
}  # fmt: skip
HOLES = [
    {
        "name": int(hole.name), "center_in_base_m": list(hole.center_in_base_m), "axis_in_base": [0.0, 0.0, 1.0],
        "radius_m": hole.radius_m, "std_m": 0.002, "score": 0.75, "seen_t_s": BEGIN_S,
    }
    for hole in TARGETS
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of one second with every topic, and two pictures where viewers' messages are written."""
    folder, bus = tmp_path_factory.mktemp("capture"), BusDescription(DBC, MACHINE)
    with CaptureWriter(CaptureConfig(folder, DBC, MACHINE, {"source": "test"}, 1.0)) as log:

        def say(topic: str, t_s: float, values: dict[str, Any]) -> None:
            log.add(TEXT + json.dumps({"topic": topic, "t_s": t_s, **values}).encode())

        for k in range(100):
            t_s, data = BEGIN_S + 0.01 * k, b""
            values = {f"Position_q{j + 1}": q for j, q in enumerate(Q)}
            values |= {f"Valid_q{j}": 1 for j in range(1, 6)}
            for name in ("JointPos1", "JointPos2", "JointPos3"):
                payload = bus.encode(name, values, k)
                data += FRAME.pack(t_s, bus.layouts[name].frame_id, 0, len(payload)) + payload
            log.add(FRAMES + data)
        say("holes", BEGIN_S + 0.5, {"holes": HOLES})
        for topic, values in SAID.items():
            say(topic, BEGIN_S + 1.0, values)
        for number in range(2):
            log.add_frame(take_frame((160, 90), number, BEGIN_S + 0.2 + 0.5 * number))
    return folder


def decode(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    """Yields topic, schema, time and message as another program would: by the schemas in the file alone."""
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None and schema.encoding == "protobuf"
            pool = descriptor_pool.DescriptorPool()
            for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(one)
            build = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            yield channel.topic, schema.name, message.log_time, build.FromString(message.data)


def test_every_decision_comes_back_as_it_was_said(folder: Path) -> None:
    messages = read_capture(folder / MCAP).messages
    for topic, values in SAID.items():
        assert messages[topic][-1][1] == values, topic
        assert messages[topic][-1][0] == pytest.approx(BEGIN_S + 1.0)
    assert messages["holes"][0][1]["holes"] == HOLES
    assert set(SAID) | {"holes"} == set(TOPICS)
    first = messages["JointPos1"][0][1]
    assert first["Position_q1"] == pytest.approx(0.3, abs=1e-3) and {"Crc", "Counter"} <= set(first)


def test_what_is_missing_stays_missing_and_what_nobody_described_is_refused() -> None:
    schema = TopicSchema("guard", TOPICS["guard"])
    said = {"t_s": 1.0, "state": "READY", "trip": "nothing", "cause": "nothing"}
    assert b"q2" not in schema.encode(said)
    with pytest.raises(ValueError, match="colour"):
        schema.encode(said | {"colour": "red"})


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for topic, name, _, message in decode(folder / MCAP):
        if name.startswith("foxglove."):
            found.setdefault(topic, []).append(message)
    return found


def test_points_lie_where_the_depths_say(found: dict[str, list[Any]]) -> None:
    cloud, pose = found["camera/points"][0], found["tf/camera"][0]
    offsets = {one.name: one.offset for one in cloud.fields}
    assert offsets == {"x": 0, "y": 4, "z": 8, "red": 12, "green": 13, "blue": 14, "alpha": 15}
    data = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    points_m = data[:, :12].copy().view("<f4").astype(float)
    turn, at = rotation(pose.rotation), pose.translation
    height_m = (points_m @ turn.T + np.array([at.x, at.y, at.z]))[:, 2]
    on_top = np.abs(height_m - BLOCK_M[1][2]) < 0.02
    on_ground = np.abs(height_m) < 0.05
    assert on_top.mean() > 0.1 and on_ground.mean() > 0.1
    assert found["camera"][0].format == "jpeg" and len(found["camera"]) == 2
    assert found["camera/calibration"][0].width == 160


def test_the_replay_shows_the_pictures_again(folder: Path) -> None:
    now = [0.0]
    replay = option("feed", "replay", capture=folder)
    views = ("camera", "camera/calibration", "camera/points", "tf/camera")
    feed = ReplayFeed(replay, MACHINE, read_capture(folder / MCAP, views), lambda: now[0])
    assert feed.read_frame(-1.0) is None, "nothing was taken yet"
    taken = take_frame((160, 90), 1, 0.0)
    now[0] = 0.9
    again = feed.read_frame(-1.0)
    assert again is not None and again.t_s == 0.9 and feed.read_frame(0.9) is None
    assert np.abs(again.color.astype(int) - taken.color).mean() < 8
    known = np.isfinite(again.depth_m)
    assert known.sum() > 1000
    np.testing.assert_allclose(again.depth_m[known], taken.depth_m[known], atol=1e-3)
    np.testing.assert_allclose(again.base_from_camera, taken.base_from_camera, atol=1e-9)


def rotation(quaternion: Any) -> np.ndarray:
    """Returns the matrix of a quaternion, by turning the three unit vectors: v + 2 w (r x v) + 2 r x (r x v)."""
    r, w = np.array([quaternion.x, quaternion.y, quaternion.z]), quaternion.w
    assert r @ r + w * w == pytest.approx(1.0)
    columns = []
    for v in np.eye(3):
        columns.append(v + 2.0 * w * np.cross(r, v) + 2.0 * np.cross(r, np.cross(r, v)))
    return np.stack(columns, 1)


def test_the_shipped_layout_names_topics_and_fields_that_exist(folder: Path) -> None:
    text = (resources.files("deploy") / "recorder" / "foxglove_layout.json").read_text()
    layout = json.loads(text)
    bus = BusDescription(DBC, MACHINE)
    fields = {topic: {one.name for one in own} for topic, own in TOPICS.items()}
    fields |= {layout.name: set(bus.units(layout.name)) for layout in bus.layouts.values()}
    paths = [
        path["value"] for panel in layout["configById"].values() for path in panel.get("paths", [])
    ]
    assert len(paths) >= 10
    for path in paths:
        topic, _, field = path.partition(".")
        assert field.partition("[")[0] in fields[topic.strip("/")], path
    panels: set[str] = set()

    def collect(node: Any) -> None:
        if isinstance(node, str):
            panels.add(node)
        else:
            collect(node["first"])
            collect(node["second"])

    collect(layout["layout"])
    assert panels == set(layout["configById"])
