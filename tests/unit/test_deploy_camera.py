"""The camera beside the loop: what is handed on, which boreholes are known, whose target counts, and what a click means."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from block import TARGETS, seen_at, take_frame
from composed import MACHINE
from desk import build_feed

from brokk_rl.contracts.vision import CameraView, FrameDetections, HolePose
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from deploy.page.loop_feed import UNNAMED, LoopFeed
from deploy.page.protocol import OperatorRequest
from deploy.page.scene import locate_borehole
from deploy.recorder import capture_reader
from deploy.recorder.capture import CaptureConfig, CaptureWriter, PictureSampler
from deploy.runtime import perception_process
from deploy.runtime.operator_requests import RecordingControl, RequestHandler
from deploy.runtime.operator_state import OperatorState
from deploy.runtime.perception_process import CameraConfig, read_frame
from deploy.runtime.shared_memory import RecordLayout
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import (
    DetectedTarget,
    FileTarget,
    GivenTarget,
    TargetPosition,
    TargetSelector,
    locate_hole,
    read_holes,
)

FRAME = take_frame((640, 360), 0, 12.0)
PIXELS = 640 * 360


def pose(x: float, y: float, std_m: float = 0.004, score: float = 0.9) -> HolePose:
    center_m, cov = np.array([x, y, 0.75]), std_m**2 * np.eye(3)
    up, turn = np.array([0.0, 0.0, 1.0]), 1e-4 * np.eye(3)
    return HolePose(center_m, up, 0.05, cov, turn, "base", score, 0.0)


@pytest.fixture
def exchange() -> Iterator[LoopMemory]:
    found = LoopMemory(MACHINE.num_joints, commands=False, frame_px=PIXELS)
    yield found
    found.close()


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: one.name)
def test_a_click_into_a_borehole_gives_its_centre_though_its_mouth_has_no_depth(
    target: Any,
) -> None:
    place = seen_at(FRAME, np.array(target.center_in_base_m))
    found = locate_borehole(FRAME, *place, target.radius_m)
    off_m = np.linalg.norm(found[0] - np.array(target.center_in_base_m))
    assert off_m < 0.012 and 0.005 < found[1] < 0.05


def test_a_click_at_the_sky_or_without_a_calibrated_camera_gives_none() -> None:
    assert locate_borehole(FRAME, 0.5, 0.01, 0.05) is None
    x, y = seen_at(FRAME, np.array(TARGETS[0].center_in_base_m))
    assert locate_borehole(replace(FRAME, base_from_camera=None), x, y, 0.05) is None


def test_a_frame_is_handed_on_whole_or_shrunk_with_its_camera(exchange: LoopMemory) -> None:
    assert exchange.frame is not None and exchange.frame.peek("t_s") is None
    perception_process._publish_frame(exchange.frame, FRAME, PIXELS, 5.0)
    assert exchange.frame.peek("t_s") == 5.0 and exchange.frame.number == 1
    whole = read_frame(exchange.frame.read())
    assert np.array_equal(whole.color, FRAME.color)
    assert np.array_equal(whole.depth_m, FRAME.depth_m, equal_nan=True)
    perception_process._publish_frame(exchange.frame, FRAME, PIXELS // 4, 6.0)
    small = read_frame(exchange.frame.read())
    assert small.color.shape == (180, 320, 3) and exchange.frame.number == 2
    center_m = np.array(TARGETS[0].center_in_base_m)
    assert seen_at(small, center_m) == pytest.approx(seen_at(FRAME, center_m), abs=0.003)


def show(exchange: LoopMemory, *poses: HolePose, now_s: float | None = None) -> None:
    now_s = time.monotonic() if now_s is None else now_s
    tracked = load_part("tracker").build().update(poses, now_s)
    perception_process.write_holes(exchange.holes, tracked, time.monotonic())


def aimed(exchange: LoopMemory) -> list[float]:
    record = exchange.target.read()
    return [round(float(value), 4) for value in record["center_in_base_m"]]


def test_who_spoke_last_says_which_borehole_it_is_and_the_camera_keeps_it_fresh(
    exchange: LoopMemory, tmp_path: Path
) -> None:
    path = tmp_path / "target.json"
    aim = TargetSelector(FileTarget(path=str(path)).build(), exchange.target, exchange.holes)
    aim.refresh()
    assert exchange.target.read() is None
    path.write_text('{"center_in_base_m": [2.6, 0.0, 0.75]}')
    aim.refresh()
    assert aimed(exchange) == [2.6, 0.0, 0.75]
    show(exchange, pose(2.21, 0.4), pose(2.62, 0.01))
    aim.refresh()
    assert aimed(exchange) == [2.62, 0.01, 0.75], "the same borehole, as the camera sees it"
    aim.choose(locate_hole(read_holes(exchange.holes)[0]))
    show(exchange, pose(2.2, 0.4))
    aim.refresh()
    assert aimed(exchange) == [2.2, 0.4, 0.75]
    path.write_text('{"center_in_base_m": [3.0, 0.0, 0.750]}')
    aim.refresh()
    assert aimed(exchange) == [3.0, 0.0, 0.75], "the file spoke last"
    path.write_text("[")
    with pytest.raises(ConfigError, match="center_in_base_m"):
        aim.refresh()


def test_a_given_borehole_never_grows_old_and_a_seen_one_is_the_surest(
    exchange: LoopMemory,
) -> None:
    given = GivenTarget(center_in_base_m=(2.6, 0.0, 0.4)).build()
    aim = TargetSelector(given, exchange.target, exchange.holes)
    aim.refresh()
    first = exchange.target.peek("t_s")
    aim.refresh()
    again = exchange.target.peek("t_s")
    assert first is not None and again is not None and again > first
    aim = TargetSelector(DetectedTarget(score=0.5).build(), exchange.target, exchange.holes)
    show(exchange, pose(2.6, 0.0, score=0.4))
    aim.refresh()
    assert aimed(exchange) == [2.6, 0.0, 0.4]
    show(exchange, pose(2.2, 0.4, score=0.7), pose(2.9, 0.4, score=0.8))
    aim.refresh()
    show(exchange, pose(2.2, 0.4, score=0.95), pose(2.9, 0.4, score=0.6))
    aim.refresh()
    # it does not leap to another that looks surer for a moment
    assert aimed(exchange) == [2.9, 0.4, 0.75]


@pytest.fixture
def feed(exchange: LoopMemory, tmp_path: Path) -> LoopFeed:
    return build_feed(exchange, tmp_path, 1.0)


def test_a_touch_in_the_picture_becomes_the_target_and_a_name_too(
    exchange: LoopMemory, feed: LoopFeed, tmp_path: Path
) -> None:
    file = FileTarget(path=str(tmp_path / "none.json")).build()
    aim = TargetSelector(file, exchange.target, exchange.holes)
    group: Any = SimpleNamespace(memory=exchange)
    wanted = RequestHandler(
        exchange,
        RecordingControl(group, CaptureConfig(tmp_path, "", MACHINE, {}, 0.0), False),
        aim,
        armed=False,
        commands=False,
    )
    center_m = np.array(TARGETS[1].center_in_base_m)
    point = OperatorRequest("point", "{:.4f},{:.4f}".format(*seen_at(FRAME, center_m)))
    assert not feed.submit(point), "there is no picture yet"
    perception_process._publish_frame(exchange.frame, FRAME, PIXELS, time.monotonic())
    assert feed.submit(point)
    wanted.refresh()
    assert np.linalg.norm(np.array(aimed(exchange)) - center_m) < 0.012
    shown = feed.read_state()
    assert [(one.name, one.chosen) for one in shown.targets] == [(UNNAMED, True)]
    assert next(one for one in shown.streams if one.name == "camera").age_s is not None
    show(exchange, pose(2.95, -0.4), pose(2.25, 0.41))
    wanted.refresh()
    chosen = {one.name: one.chosen for one in feed.read_state().targets}
    assert chosen == {"1": False, "2": True}, "perception knows it by now"
    assert feed.submit(OperatorRequest("target", "1"))
    assert not feed.submit(OperatorRequest("target", "9"))
    wanted.refresh()
    assert aimed(exchange) == [2.95, -0.4, 0.75]


class Blinking:
    """A source whose second frame cannot be used."""

    def __init__(self) -> None:
        self.count = 0

    num_frames = 3

    def __enter__(self) -> Blinking:
        return self

    def __exit__(self, *exc: Any) -> None: ...

    def build(self) -> Blinking:
        return self

    def read_latest(self) -> Frame | None:
        self.count += 1
        if self.count == 2:
            raise FrameError("the lens is dirty")
        return FRAME if self.count < 4 else None

    def find(self, frame: Frame) -> FrameDetections:
        return FrameDetections([pose(2.6, 0.0)])


def test_a_frame_that_cannot_be_used_costs_that_frame_and_what_was_seen_is_recorded(
    exchange: LoopMemory,
) -> None:
    source: Any = Blinking()
    perception_process.run(lambda: False, camera(source), exchange)
    assert exchange.frame is not None and exchange.frame.number == 2
    said = [json.loads(data[1:]) for data in exchange.vision_log.take()]
    assert [one["topic"] for one in said] == ["holes"] * 2
    assert said[1]["holes"][0]["center_in_base_m"] == pytest.approx([2.6, 0.0, 0.75])


class Following(Blinking):
    """A source whose camera follows the chosen hole."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[Any, Any]] = []

    def aim(self, q: Any, hole: Any, t_s: float) -> CameraView:
        self.asked.append((q, hole))
        return CameraView("lift 2.00 m", self.count > 1, 1.5, 4.5, 0.5, 6.0, 0.001, 0.004)


def test_a_camera_that_moves_is_told_arm_and_hole_and_the_page_where_it_looks(
    exchange: LoopMemory, feed: LoopFeed
) -> None:
    q = np.linspace(0.1, 0.5, MACHINE.num_joints)
    state = RecordLayout(OperatorState, MACHINE.num_joints).new()
    exchange.state.write(replace(state, q=q))
    TargetPosition(np.array([2.61, 0.0, 0.75]), 0.0, None).write(exchange.target)
    source: Any = Following()
    perception_process.run(lambda: False, camera(source), exchange)
    (first_q, first), *_, (_, last) = source.asked
    np.testing.assert_array_equal(first_q, q)
    assert first is None and last.pose.center_m == pytest.approx([2.6, 0.0, 0.75])
    view = feed.read_state().view
    assert view == CameraView("lift 2.00 m", True, 1.5, 4.5, 0.5, 6.0, 0.001, 0.004)
    said = [json.loads(data[1:]) for data in exchange.vision_log.take()]
    assert said[0]["topic"] == "view" and said[0]["seen_s"] == 4.5


def camera(source: Any) -> CameraConfig:
    parts = {"source": source, "finder": source, "tracker": load_part("tracker")}
    return CameraConfig(**parts, rate_hz=100.0, num_px=PIXELS, stale_s=1.0, record_hz=1.0)


def test_pictures_are_recorded_as_often_as_asked_and_come_back(
    exchange: LoopMemory, tmp_path: Path
) -> None:
    import cv2

    pictures = PictureSampler(exchange.frame, 2.0)
    assert pictures.due() is None
    with CaptureWriter(
        CaptureConfig(tmp_path, "deploy:dbc/example_gateway.dbc", MACHINE, {}, 2.0)
    ) as log:
        for number in range(3):
            perception_process._publish_frame(exchange.frame, FRAME, PIXELS, 100.0 + number)
            if (frame := pictures.due()) is not None:
                log.add_frame(frame)
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    views = capture_reader.read_capture(tmp_path / "capture.mcap", ("camera",)).views["camera"]
    assert len(views) == 1, "the other two came within half a second"
    data = np.frombuffer(CompressedImage.FromString(views[0][1]).data, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert picture is not None and np.abs(picture[..., ::-1].astype(int) - FRAME.color).mean() < 6
    assert PictureSampler(exchange.frame, 0.0).due() is None
