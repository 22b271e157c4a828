"""Sessions of any stereo camera: recorded to disk as they were, scored by holes measured by hand, learned from without a block."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cuboid
import cv2
import numpy as np
import pytest
import yaml
from composed import option
from conftest import Brokk
from drawn import blank

from brokk_rl.contracts.vision import FrameDetections, HolePose
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.extensions import load_part
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from perception import dataset
from perception.camera import CameraModel, read_pair_lens, write_camera
from perception.label.camera_pose import BoardPose, Charuco
from perception.label.labeller import BlockLabelling, read_measured
from perception.modes.score_camera import ScoreCamera, ScoreOptions
from perception.segment.network import NetworkSegmenter

SIZE_PX = (96, 64)


@pytest.fixture
def lens(tmp_path: Path) -> Path:
    path = tmp_path / "lens.yaml"
    path.write_text("K: [[80, 0, 47.5], [0, 80, 31.5], [0, 0, 1]]\ndist: []\nbaseline_m: 0.12\n")
    return path


def draw_pair(number: int) -> np.ndarray:
    """Returns a left and a right picture side by side, blue first."""
    chance = np.random.default_rng(number)
    return chance.integers(0, 255, (SIZE_PX[1], 2 * SIZE_PX[0], 3)).astype(np.uint8)


def test_a_stereo_video_becomes_frames(brokk: Brokk, tmp_path: Path, lens: Path) -> None:
    path = tmp_path / "walk.avi"
    size = (2 * SIZE_PX[0], SIZE_PX[1])
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 5, size)
    if not video.isOpened():
        pytest.skip("this OpenCV writes no FFV1")
    for number in range(5):
        video.write(draw_pair(number))
    video.release()
    out = tmp_path / "out"
    brokk(
        "mode=record_camera", f"capture.input={path}", f"lens={lens}", "every=2", "count=2", f"session.out={out}"
    )  # fmt: skip
    assert yaml.safe_load((out / "frames/camera.yaml").read_text())["baseline_m"] == 0.12
    assert len(list((out / "frames").glob("*.color.png"))) == 2
    both = [cv2.imread(str(out / f"frames/00001.{side}.png")) for side in ("color", "right")]
    pictures = [one for one in both if one is not None]
    # YUV of the codec
    np.testing.assert_allclose(np.concatenate(pictures, 1), draw_pair(2), atol=12)
    refused = brokk(
        "mode=record_camera", "capture.input=gone.mp4", f"lens={lens}", "session.out=x", code=2
    )
    assert "gone.mp4" in refused.err


def test_exported_files_are_paired_by_their_number(
    brokk: Brokk, tmp_path: Path, lens: Path
) -> None:
    for number in (9, 10):
        left, right = np.split(draw_pair(number), 2, 1)
        cv2.imwrite(str(tmp_path / f"left{number}.png"), left)
        cv2.imwrite(str(tmp_path / f"right{number}.png"), right)
        depth = np.full(SIZE_PX[::-1], 1500, np.uint16)
        depth[0, 0] = 0
        cv2.imwrite(str(tmp_path / f"depth{number}.png"), depth)
    words = ("mode=record_camera", "capture=zed_export", f"capture.folder={tmp_path}")
    words = (*words, f"lens={lens}")
    brokk(*words, "capture.depth=depth*.png", "session.out=out")
    frames = tmp_path / "out/frames"
    stored = np.load(frames / "00001.depth.npy")
    assert np.isnan(stored[0, 0]) and stored[5, 5] == pytest.approx(1.5)
    right = cv2.imread(str(frames / "00001.right.png"))
    np.testing.assert_array_equal(right, np.split(draw_pair(10), 2, 1)[1])
    (tmp_path / "right10.png").unlink()
    refused = brokk(*words, "session.out=again", code=2)
    assert "numbered 10" in refused.err


def score(tmp_path: Path, kind: Any, name: str, found_m: tuple[float, ...]) -> float | None:
    """Scores one frame whose camera is 2 m before the board, which has a hole 0.3 m to its right."""
    hole_a = "{name: A, center_m: [0.3, 0.0, 0.0], radius_m: 0.05}"
    (tmp_path / "measured.yaml").write_text(f"std_m: 0.0005\nholes: [{hole_a}]\n")
    pose, base = np.eye(4), np.eye(4)
    pose[2, 3], base[:3, 3] = -2.0, (1.0, 2.0, 3.0)
    # A camera whose place in the base is known too: the truth is told in its own coordinates.
    frames = iter([blank(8, 8, base_from_camera=base, name="a/0")])
    hole = HolePose(
        np.array(found_m), np.array([0.0, 0.0, -1.0]), 0.05, np.eye(3) * 1e-6, np.zeros((3, 3)), "camera", 1.0, 0.0,
    )  # fmt: skip

    class Source:
        num_frames = 1

        def __enter__(self) -> Source:
            return self

        def __exit__(self, *exc: Any) -> None:
            pass

        def read_latest(self) -> Frame | None:
            return next(frames, None)

    finder, source = SimpleNamespace(find=FrameDetections([hole]).in_base_frame), Source()
    built: dict[str, Any] = {
        "perception": SimpleNamespace(build=lambda: finder), "source": SimpleNamespace(build=lambda: source),
    }  # fmt: skip
    options = ScoreOptions(truth=str(tmp_path / "measured.yaml"), kind=kind, name=name)
    session = Session(out=str(tmp_path / name), seed=0, device="cpu")
    (tmp_path / name).mkdir(exist_ok=True)
    seen = BoardPose(np.linalg.inv(pose)[None], np.zeros((1, 6, 6)), 0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Charuco, "locate", lambda self, frame: seen)
        board = load_part("board")
        return ScoreCamera(session=session, score=options, board=board, **built).run()


def test_a_session_is_scored_by_holes_measured_in_the_frame_of_the_board(tmp_path: Path) -> None:
    for kind, found_m, error_m, inside in (
        ("rendered", (0.3, 0.0, 2.0005), 0.0005, 1),
        ("real", (0.3, 0.004, 2.0), 0.004, 0),
    ):
        assert score(tmp_path, kind, kind, found_m) == pytest.approx(error_m)
        row = json.loads((tmp_path / kind / "score.json").read_text())
        assert (row["kind"], row["inside_3_sigma"]) == (kind, inside)


@pytest.mark.parametrize(
    ("hole", "told"),
    [
        ("center_m: [1, 2]", "center_m"), ("center_m: [.nan, 0, 0]", "center_m"), ("center_m: [1120, 310, 6]", "center_m"),
        ("center_m: [1, 0, 0], axis: [0, 0, 0]", "axis"), ("center_m: [1, 0, 0], radius_m: 50", "radius_m"),
        ("center_m: [1, 0, 0], radius_m: -0.05", "radius_m"),
    ],
)  # fmt: skip
def test_a_hole_that_nobody_measured_is_refused(tmp_path: Path, hole: str, told: str) -> None:
    (tmp_path / "wrong.yaml").write_text(f"holes: [{{{hole}}}]\nstd_m: 0.1\n")
    with pytest.raises(ConfigError, match=rf"(?s)hole(s\[0\]| 1).*{told}.*expected YAML such as"):
        read_measured(tmp_path / "wrong.yaml", "score.truth")


@pytest.mark.parametrize(("side", "named"), [(2, False), (12, True)])
def test_a_speck_is_no_block(side: int, named: bool) -> None:
    def infer(picture: np.ndarray) -> np.ndarray:
        found = np.zeros((2, 32, 64), np.float32)
        found[:, 8 : 8 + side, 8 : 8 + side] = 0.9
        return found

    masks = NetworkSegmenter(infer, (64, 32), None).segment(blank(320, 640))
    assert bool((masks.block > 0.5).any()) is named
    assert bool((np.asarray(masks.hole_mask) > 0.5).any()) is named


def test_a_gate_drops_the_blocks_that_it_does_not_see() -> None:
    def build(*places: int) -> NetworkSegmenter:
        def infer(picture: np.ndarray) -> np.ndarray:
            found = np.zeros((2, 32, 64), np.float32)
            for left in places:
                found[:, 8:20, left : left + 12] = 0.9
            return found

        return NetworkSegmenter(infer, (64, 32), None, gates.pop() if gates else None)

    frame = blank(32, 64)
    gates: list[NetworkSegmenter] = []
    gates.append(build(42))
    masks = build(4, 40).segment(frame)
    assert not (masks.block[:, :32] > 0.5).any() and (masks.block[:, 40:52] > 0.5).any()
    gates.append(build())
    masks = build(4, 40).segment(frame)
    assert not (masks.block > 0.5).any() and not np.asarray(masks.hole_mask).any()


def write_ros_log(path: Path, pictures: list[tuple[np.ndarray, np.ndarray]], bent: float) -> None:
    """Writes raw grey pairs with their `camera_info` as a bag of ROS 1, or as MCAP."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    is_bag = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_bag else Stores.ROS2_HUMBLE)
    types: Any = store.types
    messages = []
    for number, pair in enumerate(pictures):
        stamp = types["builtin_interfaces/msg/Time"](sec=7, nanosec=100_000_000 * number)
        head: dict[str, Any] = {"stamp": stamp, "frame_id": ""}
        if is_bag:
            head["seq"] = number
        header = types["std_msgs/msg/Header"](**head)
        for side, gray, pull in (("left", pair[0], 0.0), ("right", pair[1], -80 * 0.12)):
            height, width = gray.shape
            kind = "sensor_msgs/msg/Image"
            image = types[kind](
                header=header, height=height, width=width, encoding="mono8", is_bigendian=0, step=width,
                data=gray.ravel(),
            )  # fmt: skip
            matrix = np.array([80, 0, 47.5, 0, 80, 31.5, 0, 0, 1.0])
            d, k, r, p = ("D", "K", "R", "P") if is_bag else ("d", "k", "r", "p")
            roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            told = {
                d: np.array([bent, 0, 0, 0, 0.0]), k: matrix, r: np.eye(3).ravel(),
                p: np.insert(matrix.reshape(3, 3), 3, [pull, 0, 0], axis=1).ravel(),
            }  # fmt: skip
            info = types["sensor_msgs/msg/CameraInfo"](
                header=header, height=height, width=width, distortion_model="plumb_bob",
                binning_x=0, binning_y=0, roi=roi, **told,
            )  # fmt: skip
            messages.append((f"/cam/{side}/camera_info", "sensor_msgs/msg/CameraInfo", info))
            messages.append((f"/cam/{side}/image_raw", kind, image))
    serialize = store.serialize_ros1 if is_bag else store.serialize_cdr
    place = path if is_bag else path.with_suffix("")
    mcap = rosbag2.StoragePlugin.MCAP
    with (
        rosbag1.Writer(place)
        if is_bag
        else rosbag2.Writer(place, version=9, storage_plugin=mcap) as bag
    ):
        topics: dict[str, Any] = {}
        for number, (topic, kind, message) in enumerate(messages):
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(topics[topic], number, serialize(message, kind))
    for file in place.glob("*.mcap"):
        file.rename(path)


@pytest.mark.parametrize("ending", ["bag", "mcap"])
def test_raw_grey_pairs_of_a_ros_log_are_rectified_by_their_own_lens(
    brokk: Brokk, tmp_path: Path, ending: str
) -> None:
    chance = np.random.default_rng(0)
    grain = cv2.GaussianBlur(chance.uniform(0, 255, (64, 104)), (0, 0), 2.0).astype(np.uint8)
    # 8 px everywhere: 80 px * 0.12 m / 8 px = 1.2 m
    straight = grain[:, :96], grain[:, 8:]
    matrix = np.array([[80, 0, 47.5], [0, 80, 31.5], [0, 0, 1.0]])
    columns, rows = np.meshgrid(np.arange(96.0), np.arange(64.0))
    seen = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    # where the straight picture shows what a bent one has at each pixel
    place = cv2.undistortPoints(seen, matrix, np.array([-0.2, 0, 0, 0]), P=matrix)
    place = place.reshape(64, 96, 2).astype(np.float32)
    raw = [cv2.remap(one, place[..., 0], place[..., 1], cv2.INTER_CUBIC) for one in straight]
    path = tmp_path / f"walk.{ending}"
    write_ros_log(path, [(raw[0], raw[1])] * 2, -0.2)
    brokk("mode=record_camera", "capture=ros", f"capture.input={path}", "session.out=out")
    told = yaml.safe_load((tmp_path / "out/frames/camera.yaml").read_text())
    assert told["size_px"] == [96, 64] and told["baseline_m"] == pytest.approx(0.12)
    assert not any(told["dist"])
    assert len(list((tmp_path / "out/frames").glob("*.color.png"))) == 2
    for side, true in zip(("color", "right"), straight, strict=True):
        written = cv2.imread(str(tmp_path / f"out/frames/00000.{side}.png"), 0)
        middle = np.s_[12:-12, 16:-16]
        assert np.abs(written[middle].astype(float) - true[middle]).mean() < 3.0
    refused = brokk(
        "mode=record_camera", "capture=ros", f"capture.input={path}", "capture.depth=/no/depth",
        "session.out=x", code=2,
    )  # fmt: skip
    assert "capture.depth=/no/depth" in refused.err


FACTORY = """[LEFT_CAM_VGA]
fx=264
fy=264
cx=335
cy=188
k1=-0.04
[RIGHT_CAM_VGA]
fx=265
fy=265
cx=338
cy=186
k1=-0.03
[STEREO]
Baseline=120
TY=0.4
TZ=-0.6
RX_VGA=0.004
CV_VGA=-0.006
RZ_VGA=0.003
"""


def test_rows_correspond_after_a_factory_file_and_another_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "SN1.conf"
    path.write_text(FACTORY)
    lens = read_pair_lens(path, None, (672, 376))
    points = np.random.default_rng(0).uniform([-0.6, -0.4, 1.5], [0.6, 0.4, 3.0], (40, 3))
    turn = np.array([0.004, -0.006, 0.003])
    shift_m = -np.array([0.12, 0.0004, -0.0006])
    cameras = (
        (np.array([[264, 0, 335], [0, 264, 188], [0, 0, 1.0]]), -0.04, np.zeros(3), np.zeros(3)),
        (np.array([[265, 0, 338], [0, 265, 186], [0, 0, 1.0]]), -0.03, turn, shift_m),
    )
    places = []
    for (matrix, bent, turned, moved), maps in zip(cameras, lens.maps, strict=True):
        raw = cv2.projectPoints(points, turned, moved, matrix, np.array([bent, 0, 0, 0]))[0][:, 0]
        # the rectified pixel that takes its light from where the raw camera shows the point
        off = np.hypot(maps[0][None] - raw[:, :1, None], maps[1][None] - raw[:, 1:, None])
        nearest = off.reshape(len(raw), -1).argmin(1)
        places.append(np.column_stack(np.unravel_index(nearest, maps[0].shape)))
    down_px = places[1][:, 0] - places[0][:, 0]
    assert np.abs(down_px).max() <= 1 and abs(down_px.mean()) < 0.3
    across_px = places[0][:, 1] - places[1][:, 1]
    depth_m = lens.matrix[0, 0] * 0.12 / across_px
    assert depth_m == pytest.approx(points[:, 2], rel=0.1)
    with pytest.raises(FrameError, match="none of a ZED"):
        read_pair_lens(path, None, (640, 480))


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("D2", None, "got no D2"), ("R", 2 * np.eye(3), "no rotation with a shift"), ("R", np.eye(2), r"R has shape \(2, 2\)"),
        ("T", [-0.12, 0.0], r"T has shape \(2,\)"), ("D1", [np.nan] * 5, "camera 1: dist"), ("T", [-120.0, 0.0, 0.0], "mm"),
    ],
)  # fmt: skip
def test_a_lens_file_without_a_number_or_with_impossible_ones_is_refused(
    name: str, value: Any, told: str
) -> None:
    matrix = np.array([[530.0, 0.0, 650.0], [0.0, 532.0, 352.0], [0.0, 0.0, 1.0]])
    bent = np.array([-0.05, 0.02, 0.0, 0.0, 0.0])
    content = {"K1": matrix, "D1": bent, "K2": matrix, "D2": bent, "R": np.eye(3), "T": [[-0.12], [0], [0]]}  # fmt: skip
    assert read_pair_lens(Path("lens.yaml"), content, (1280, 720)).baseline_m == pytest.approx(0.12)
    wrong = content | {name: value}
    with pytest.raises(FrameError, match=told):
        read_pair_lens(Path("lens.yaml"), wrong, (1280, 720))


EYES_M = ((-1.8, -0.9, 1.0), (-2.0, 0.3, 0.8), (-2.4, -0.3, 0.7))
WORLD_FROM_BOARD = np.eye(4)[[2, 0, 1, 3]]
"""A board in the drilled face: its z axis is the world's x."""


@pytest.fixture(scope="module")
def views() -> list[cuboid.View]:
    """Frames around one block, something hanging before it, with what is true."""
    found = []
    for number, eye in enumerate(EYES_M):
        pose = cuboid.looking(eye, (0.1, 0.0, 0.3))
        found.append(cuboid.seen(pose, (480, 270), 0.003, (-0.5, 0.15, 0.55), seed=number))
    return found


def write_labels(views: list[cuboid.View], folder: Path, **block: list[float]) -> dict[str, Any]:
    board_from_world = np.linalg.inv(WORLD_FROM_BOARD)
    hole_m = (board_from_world[:3, :3] @ cuboid.HOLE_M).tolist()
    measured = {
        "std_m": 0.001, "block": block, "holes": [{"center_m": hole_m, "radius_m": cuboid.RADIUS_M}],
    }  # fmt: skip
    (folder / "measured.yaml").write_text(yaml.safe_dump(measured))
    for number, view in enumerate(views):
        stem = folder / "in" / f"{number:02d}"
        dataset.write_frame(stem, view.frame.color, view.frame.depth_m)
    first = views[0].frame
    size_px = first.color.shape[1::-1]
    write_camera(folder / "in", CameraModel(first.camera_matrix, size_px=size_px))

    def locate(_: Charuco, frame: Frame) -> BoardPose:
        pose = board_from_world @ views[int(frame.name[-2:])].world_from_camera
        return BoardPose(np.linalg.inv(pose)[None], np.zeros((1, 6, 6)), 0.1)

    source = option("perception/source", "folder", folder=str(folder / "in"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Charuco, "locate", locate)
        labelling = BlockLabelling(
            source=source, board=load_part("board"), measured=str(folder / "measured.yaml"), noise_per_m=0.003,
            stereo=load_part("stereo"), num_sigma=3.0, min_depth_share=0.5,
        )  # fmt: skip
        return labelling.label(folder)


def test_labels_of_a_measured_block_are_those_of_the_renderer(
    views: list[cuboid.View], tmp_path: Path
) -> None:
    result = write_labels(views, tmp_path, corner_m=[-0.4, 0.0, 0.0], size_m=[0.8, 0.6, 1.2])
    assert result["num_labelled"] == len(views)
    for number, view in enumerate(views):
        label = dataset.read_label(tmp_path / "frames" / f"{number:02d}")
        assert cuboid.overlap(label.block, view.block) > 0.95
        assert cuboid.overlap(label.hole_mask, view.mouth) > 0.9
        assert (label.arm & ~view.occluder).sum() < 0.01 * view.block.sum()
        assert (label.block & view.occluder).sum() < 0.01 * view.block.sum()
    truth = dataset.read_truth(tmp_path / "frames" / "00")
    local = (cuboid.HOLE_M - views[0].world_from_camera[:3, 3]) @ views[0].world_from_camera[:3, :3]
    np.testing.assert_allclose(truth.holes[0].center_m, local, atol=1e-9)
    assert len(list((tmp_path / "overlays").glob("*.png"))) == len(views)


def test_a_block_in_the_wrong_place_is_left_out_and_said(
    views: list[cuboid.View], tmp_path: Path
) -> None:
    with pytest.raises(FrameError, match="of the depth agrees with the block"):
        write_labels(views, tmp_path, corner_m=[-0.4, 0.0, -0.1], size_m=[0.8, 0.6, 1.2])
