"""Sources hand out sound frames only, and say of every other which it is and why."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from composed import option

from brokk_rl.errors import FrameError
from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from perception import dataset
from perception.calibrate.extrinsics import CameraExtrinsics
from perception.camera import CameraModel, RawFrame, write_camera
from perception.render.stereo_camera import StereoRig
from perception.sources import realsense, simulator
from perception.sources.folder import FrameFolder
from perception.sources.live import Freshness, LiveSource

HEIGHT, WIDTH = 90, 160
MATRIX = np.array([[88.0, 0.0, 79.5], [0.0, 88.0, 44.5], [0.0, 0.0, 1.0]])
POSE = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.4], [0, -1, 0, 1.9], [0, 0, 0, 1.0]])


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A folder of two sound frames, 00000 and 00001."""
    chance = np.random.default_rng(0)
    write_camera(tmp_path, CameraModel(MATRIX, None, 0.12, (WIDTH, HEIGHT), POSE))
    for number in range(2):
        color = chance.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        depth = np.full((HEIGHT, WIDTH), 2.0 + number, np.float32)
        depth[:10] = np.nan
        dataset.write_frame(tmp_path / f"{number:05d}", color, depth)
    return tmp_path


def folder(path: Path, **changes: Any) -> FrameFolder:
    usual = {"rate_hz": 10.0, "least_known": 0.01, "needs": "depth", "base_from_camera": None}
    return FrameFolder(folder=str(path), **(usual | changes))


def read(path: Path, **changes: Any) -> list[Frame]:
    with folder(path, **changes).build() as source:
        return list(iter(source.read_latest, None))


def test_frames_come_back_as_they_were_written(frames: Path) -> None:
    first, second = read(frames)
    assert first.name == str(frames / "00000") and second.name == str(frames / "00001")
    assert (first.t_s, second.t_s) == (0.0, 0.1)
    np.testing.assert_array_equal(first.camera_matrix, MATRIX)
    np.testing.assert_array_equal(first.base_from_camera, POSE)
    assert first.distortion is None and first.right is None and first.baseline_m == 0.12
    assert np.isnan(first.depth_m[:10]).all()
    assert (first.depth_m[10:] == 2.0).all()
    assert (second.depth_m[10:] == 3.0).all()
    blue_first = cv2.imread(str(frames / "00000.color.png"))
    np.testing.assert_array_equal(first.color, blue_first[..., ::-1])
    assert folder(frames).build().num_frames == 2


def test_depth_in_millimetres_is_depth_in_metres(frames: Path) -> None:
    (frames / "00000.depth.npy").unlink()
    values = np.full((HEIGHT, WIDTH), 1234, np.uint16)
    values[0, 0] = 0
    dataset.write_picture(frames / "00000.depth.png", values)
    depth = read(frames)[0].depth_m
    assert np.isnan(depth[0, 0]) and depth[1, 1] == np.float32(1.234) and depth.dtype == np.float32


def test_zero_and_infinity_are_no_depths(frames: Path) -> None:
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[0, :4] = [0.0, np.inf, -np.inf, -1.0]
    np.save(frames / "00000.depth.npy", depth)
    found = read(frames)[0].depth_m
    assert np.isnan(found[0, :4]).all() and (found[0, 4:] == 2.0).all()
    assert found.dtype == np.float32


def camera(frames: Path, **changes: Any) -> None:
    path = frames / "camera.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))


def cut(path: Path, part: float) -> None:
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))


def save(path: Path, values: np.ndarray) -> None:
    path.with_name(path.name.replace(".png", ".npy")).unlink(missing_ok=True)
    dataset.write_picture(path, values) if path.suffix == ".png" else np.save(path, values)


SIZE = (HEIGHT, WIDTH)
BREACHES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no depth": (lambda f: (f / "00000.depth.npy").unlink(), r"00000: no depth; expected 00000.depth.npy"),
    "truncated colour": (lambda f: cut(f / "00000.color.png", 0.6), r"00000.color.png: truncated, damaged or no picture"),
    "damaged colour": (lambda f: flip(f / "00000.color.png"), r"00000.color.png: truncated, damaged or no picture"),
    "truncated depth": (lambda f: cut(f / "00000.depth.npy", 0.5), r"00000.depth.npy: truncated"),
    "16 bit colour": (lambda f: save(f / "00000.color.png", np.zeros((*SIZE, 3), np.uint16)), r"uint16, expected 8 bits"),
    "8 bit depth": (lambda f: save(f / "00000.depth.png", np.full(SIZE, 9, np.uint8)), r"00000.depth.png: uint8, expected 16 bits"),
    "coloured depth": (lambda f: save(f / "00000.depth.png", np.zeros((*SIZE, 3), np.uint16)), r"3 channels, expected one"),
    "unknown depth": (lambda f: save(f / "00000.depth.png", np.zeros(SIZE, np.uint16)), r"known for 0 %"),
    "depth in mm": (lambda f: save(f / "00000.depth.npy", np.full(SIZE, 2000.0)), r"median depth is 2000 m; is it in mm"),
    "depth in integers": (lambda f: save(f / "00000.depth.npy", np.full(SIZE, 2000)), r"expected float32 in m"),
    "misaligned depth": (lambda f: save(f / "00000.depth.npy", np.ones((HEIGHT // 2, WIDTH // 2))), r"depth has 80 x 45 pixels"),
    "misaligned right": (lambda f: save(f / "00000.right.png", np.zeros((9, 9, 3), np.uint8)), r"right picture has 9 x 9 pixels"),
}  # fmt: skip


@pytest.mark.parametrize("breach", BREACHES)
def test_a_frame_that_breaks_the_format_is_refused_by_name_and_the_next_one_read(
    breach: str, frames: Path
) -> None:
    spoil, told = BREACHES[breach]
    spoil(frames)
    with folder(frames).build() as source:
        with pytest.raises(FrameError, match=told):
            source.read_latest()
        after = source.read_latest()
        assert after is not None and after.name.endswith("00001")
        assert source.read_latest() is None


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"K": [[88, 0, 80], [0, 88, 45]]}, r"K has shape \(2, 3\)"),
        ({"K": [[-88, 0, 80], [0, 88, 45], [0, 0, 1]]}, "expected more than 0"),
        ({"K": [[88, 0, 80], [0, 300, 45], [0, 0, 1]]}, "about equal"),
        ({"K": [[88, 0, 80], [0, 88, 45], [0, 1, 1]]}, "no camera matrix"),
        ({"dist": [0.1, 0.2, 0.3]}, "3 numbers, expected"),
        ({"baseline_m": 120.0}, "is it in mm"),
        ({"T_base_cam": (np.eye(4) * [[2], [1], [1], [1]]).tolist()}, "no rotation with a shift"),
        ({"T_base_cam": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "no rotation with a shift"),
        ({"gamma": 0.45}, r"gamma is 0.45, expected 1 \(linear\) to 4"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(
    changes: dict[str, Any], told: str, frames: Path
) -> None:
    camera(frames, **changes)
    with pytest.raises(FrameError, match=rf"(?s)camera.yaml.*{told}"):
        folder(frames).build().__enter__()


def test_a_folder_without_camera_or_frames_is_refused(frames: Path, tmp_path: Path) -> None:
    (frames / "camera.yaml").write_text("K: [1, 2\n")
    with pytest.raises(FrameError, match="cannot be read as YAML"):
        read(frames)
    (frames / "camera.yaml").write_text("[]")
    with pytest.raises(FrameError, match="K is missing"):
        read(frames)
    (frames / "camera.yaml").unlink()
    with pytest.raises(FrameError, match=r"camera.yaml: cannot be read .*No such file"):
        read(frames)
    with pytest.raises(FrameError, match="no such folder"):
        read(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FrameError, match="no frames"):
        read(tmp_path / "empty")


def test_a_camera_without_a_place_or_a_baseline_is_welcome(frames: Path) -> None:
    (frames / "camera.yaml").write_text(yaml.safe_dump({"K": MATRIX.tolist()}))
    first = read(frames)[0]
    assert first.base_from_camera is None and first.baseline_m is None and first.distortion is None


def test_a_pose_of_the_camera_of_another_convention_is_refused_by_its_name(frames: Path) -> None:
    # looks ahead and down by 0.6 rad
    c, sine = np.cos(0.6), np.sin(0.6)
    good = np.array([[0, -sine, c, 0.3], [-1, 0, 0, 0.4], [0, -c, -sine, 1.9], [0, 0, 0, 1]])
    forward_left_up = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    in_mm = good.copy()
    in_mm[:3, 3] *= 1000
    slips = {
        "inverse": np.linalg.inv(good),
        "OpenGL": good @ np.diag([1.0, -1.0, -1.0, 1.0]),
        "ahead, left, up": good @ forward_left_up,
        "in mm": in_mm,
    }
    camera(frames, T_base_cam=good.tolist())
    assert len(read(frames)) == 2
    for pose in slips.values():
        camera(frames, T_base_cam=pose.tolist())
        with pytest.raises(FrameError, match="T_base_cam"):
            read(frames)


def test_grey_pictures_of_8_and_of_10_bits_are_welcome(frames: Path) -> None:
    save(frames / "00000.color.png", np.full(SIZE, 90, np.uint8))
    deep = np.full(SIZE, 512, np.uint16)
    deep[0] = 1023
    save(frames / "00001.color.png", deep)
    first, second = read(frames)
    assert first.color.shape == (*SIZE, 3) and (first.color == 90).all()
    assert second.color.dtype == np.uint8
    assert (second.color[0] == 255).all() and (second.color[1:] == 128).all()


def test_a_camera_matrix_of_another_resolution_is_refused_by_its_name(tmp_path: Path) -> None:
    color = np.full((720, 1280, 3), 128, np.uint8)
    dataset.write_frame(tmp_path / "00000", color, np.full((720, 1280), 2.0, np.float32))

    def refuse(size: tuple[int, int], told: tuple[int, int] | None, match: str) -> None:
        focal_px = 0.55 * size[0]
        middle = [(size[0] - 1) / 2, (size[1] - 1) / 2]
        matrix = [[focal_px, 0, middle[0]], [0, focal_px, middle[1]], [0, 0, 1]]
        content = {"K": matrix, "dist": []} | ({} if told is None else {"size_px": list(told)})
        (tmp_path / "camera.yaml").write_text(yaml.safe_dump(content))
        with folder(tmp_path).build() as source, pytest.raises(FrameError, match=match):
            source.read_latest()

    for size in ((1920, 1080), (640, 360), (2560, 1440), (1472, 828), (720, 1280)):
        refuse(size, None, "K has")
    refuse((1280, 720), (1920, 1080), "K of .* is that of pictures of 1920 x 1080 px")
    refuse((720, 1280), (720, 1280), "the pictures are turned")


def test_a_pair_without_depth_is_matched(tmp_path: Path) -> None:
    chance = np.random.default_rng(1)
    grain = cv2.GaussianBlur(chance.standard_normal((120, 400)).astype(np.float32), (0, 0), 1.0)
    wide = np.repeat(np.clip(128 + 120 * grain, 0, 255).astype(np.uint8)[..., None], 3, 2)
    matrix = np.array([[200.0, 0.0, 119.5], [0.0, 200.0, 59.5], [0.0, 0.0, 1.0]])
    write_camera(tmp_path, CameraModel(matrix, None, 0.12, (240, 120)))
    # All of it 12 px: 200 * 0.12 / 12 = 2 m.
    dataset.write_frame(tmp_path / "00000", wide[:, 100:340], None, wide[:, 112:352])
    found = read(tmp_path)[0]
    depth_m = load_part("stereo").match_frame(found).depth_m
    assert np.isnan(found.depth_m).all() and np.nanmedian(depth_m) == pytest.approx(2.0, abs=0.005)
    camera(tmp_path, dist=[0.1, 0.0, 0.0, 0.0])
    with pytest.raises(FrameError, match="rectified camera"):
        read(tmp_path)


class Clock:
    """A camera of 10 Hz whose frames reach us `lag_s` after they were taken; `grabs` says what each call finds."""

    has_ended = False

    def __init__(self, stamps: list[float | None], lag_s: float = 0.0) -> None:
        self.stamps, self.lag_s, self.now, self.closed, self.opened = stamps, lag_s, 0.0, 0, True

    def open(self) -> CameraModel:
        if not self.opened:
            raise FrameError("no camera")
        return CameraModel(MATRIX, None, 0.12)

    def capture(self, timeout_s: float) -> RawFrame | None:
        if not self.stamps:
            return None
        stamp = self.stamps.pop(0)
        if stamp is None:
            return None
        self.now = stamp + self.lag_s
        depth_m = np.full(SIZE, 2.0, np.float32)
        return RawFrame(np.zeros((*SIZE, 3), np.uint8), None, depth_m, stamp)

    def now_s(self) -> float:
        return self.now

    def close(self) -> None:
        self.closed += 1


FRESH = Freshness(timeout_s=0.3, max_age_s=0.2, least_known=0.01)


def test_a_live_source_gives_each_frame_once_and_no_stale_one() -> None:
    device = Clock([1.0, 1.0, None, 1.1])
    with LiveSource(device, "camera", FRESH, CameraExtrinsics(POSE, None)) as source:
        stamps = [frame.t_s for frame in (source.read_latest(), source.read_latest()) if frame]
        assert stamps == [1.0, 1.1]
        with pytest.raises(FrameError, match=r"no new frame for 0.3 s\. Is it plugged in"):
            source.read_latest()
    assert device.closed == 1
    late = LiveSource(Clock([1.0, 1.1], 0.6), "camera", FRESH, CameraExtrinsics(POSE, None))
    with late as source, pytest.raises(FrameError, match=r"up to 0.60 s old, 0.2"):
        source.read_latest()


def test_a_live_source_is_closed_when_opening_fails_and_read_only_when_open() -> None:
    device = Clock([1.0])
    device.opened = False
    source = LiveSource(device, "camera", FRESH, CameraExtrinsics(None, None))
    with pytest.raises(FrameError, match="no camera"), source:
        pass
    assert device.closed == 1
    with pytest.raises(FrameError, match="not open"):
        source.read_latest()


class StubZed:
    """What `pyzed.sl.Camera` did on a ZED 2i with SDK 4: the recorded answers, for a picture that is small."""

    status, opened, left = "SUCCESS", None, 1000

    def open(self, init: Any) -> str:
        StubZed.opened = init
        return self.status

    def grab(self, runtime: Any) -> str:
        self.fill = runtime.enable_fill_mode
        self.left -= 1
        return "SUCCESS" if self.left >= 0 else "END"

    def get_camera_information(self) -> Any:
        left = SimpleNamespace(fx=88.0, fy=88.0, cx=79.5, cy=44.5, disto=[-0.04, 0.01, 0, 0, 0])
        calibration = SimpleNamespace(left_cam=left, get_camera_baseline=lambda: 0.11986)
        configuration = SimpleNamespace(calibration_parameters=calibration)
        return SimpleNamespace(camera_configuration=configuration)

    def retrieve_image(self, mat: Any, view: str) -> None:
        level = np.full((*SIZE, 4), {"left": 10, "right": 20}[view], np.uint8)
        mat.values = level + np.array([0, 1, 2, 0], np.uint8)

    def retrieve_measure(self, mat: Any, measure: str) -> None:
        mat.values = np.full(SIZE, 1.5, np.float32)
        mat.values[0, :3] = [np.nan, np.inf, -np.inf]

    def get_timestamp(self, reference: str) -> Any:
        ns = 1_700_000_000_000_000_000 + 50_000_000 * (reference == "current")
        return SimpleNamespace(get_nanoseconds=lambda: ns)

    def close(self) -> None:
        StubZed.opened = None


class Mat:
    """`sl.Mat`: memory of the SDK's own."""

    values = np.zeros(0)

    def get_data(self) -> np.ndarray:
        return self.values


def pyzed(monkeypatch: pytest.MonkeyPatch) -> None:
    sl: Any = ModuleType("pyzed.sl")
    sl.Camera, sl.Mat = StubZed, Mat
    usual = {"enable_fill_mode": True, "set_from_svo_file": lambda path: None}
    sl.InitParameters = sl.RuntimeParameters = lambda: SimpleNamespace(**usual)
    sl.ERROR_CODE = SimpleNamespace(SUCCESS="SUCCESS", END_OF_SVOFILE_REACHED="END")
    sl.RESOLUTION = SimpleNamespace(HD1080="HD1080")
    sl.DEPTH_MODE = SimpleNamespace(NEURAL="NEURAL")
    sl.UNIT, sl.COORDINATE_SYSTEM = SimpleNamespace(METER="metre"), SimpleNamespace(IMAGE="image")
    sl.VIEW = SimpleNamespace(LEFT="left", RIGHT="right")
    sl.MEASURE = SimpleNamespace(DEPTH="depth")
    sl.TIME_REFERENCE = SimpleNamespace(IMAGE="image", CURRENT="current")
    monkeypatch.setitem(sys.modules, "pyzed", ModuleType("pyzed"))
    monkeypatch.setitem(sys.modules, "pyzed.sl", sl)


def test_a_zed_gives_its_left_picture_and_depth_without_invented_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pyzed(monkeypatch)
    with option("perception/source", "zed").build() as source:
        assert StubZed.opened is not None and StubZed.opened.coordinate_units == "metre"
        frame = source.read_latest()
        assert source._device._camera.fill is False
    assert StubZed.opened is None
    # The SDK gives BGRA.
    assert frame.color[0, 0].tolist() == [12, 11, 10] and frame.right[0, 0].tolist() == [22, 21, 20]
    assert np.isnan(frame.depth_m[0, :3]).all() and (frame.depth_m[1:] == 1.5).all()
    assert frame.t_s == pytest.approx(1.7e9) and frame.baseline_m == pytest.approx(0.11986)
    # The picture is rectified; the coefficients are those of the raw one.
    assert frame.distortion is None
    np.testing.assert_array_equal(frame.camera_matrix, MATRIX)


def test_a_lens_whose_inverse_is_told_bends_as_opencv_says() -> None:
    inverse = np.array([0.06, -0.04, 0.0008, -0.0005, 0.01])
    matrix = np.array([[640.0, 0.0, 639.5], [0.0, 640.0, 359.5], [0.0, 0.0, 1.0]])
    coefficients = realsense.invert_distortion(inverse, matrix, (1280, 720))
    pixel = np.array([[100.0, 60.0], [640.0, 300.0], [1200.0, 650.0]])
    x, y = ((pixel - matrix[:2, 2]) / 640.0).T
    r2, (k1, k2, p1, p2, k3) = x * x + y * y, inverse
    bent = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3  # the library's own deprojection, written down
    across = x * bent + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * bent + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    ray = np.stack([across, down, 1 + 0 * x], 1)
    seen = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(seen, pixel, atol=0.3)


def test_a_realsense_gives_depth_aligned_to_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    rs: Any = ModuleType("pyrealsense2")
    streams: list[Any] = []
    rs.stream = SimpleNamespace(depth="depth", color="color")
    rs.format = SimpleNamespace(z16="z16", rgb8="rgb8")
    rs.config = lambda: SimpleNamespace(enable_stream=lambda *stream: streams.append(stream))
    rs.distortion = SimpleNamespace(inverse_brown_conrady="inverse")
    rs.timestamp_domain = SimpleNamespace(hardware_clock="own")
    lens = SimpleNamespace(fx=88.0, fy=88.0, ppx=79.5, ppy=44.5, coeffs=[0.0] * 5, model="inverse")
    sensor = SimpleNamespace(get_depth_scale=lambda: 0.001)
    device = SimpleNamespace(first_depth_sensor=lambda: sensor)
    video = SimpleNamespace(get_intrinsics=lambda: lens)
    stream = SimpleNamespace(as_video_stream_profile=lambda: video)
    profile = SimpleNamespace(get_device=lambda: device, get_stream=lambda _: stream)
    z16 = np.full(SIZE, 1500, np.uint16)
    z16[0] = 0
    frames = SimpleNamespace(
        get_depth_frame=lambda: SimpleNamespace(get_data=lambda: z16),
        get_color_frame=lambda: SimpleNamespace(
            get_data=lambda: np.full((*SIZE, 3), 7, np.uint8),
            get_timestamp=lambda: 5e6,  # of a clock that began with the camera
            get_frame_timestamp_domain=lambda: "own",
        ),
    )
    waits: list[int] = []

    def wait(ms: int) -> Any:
        waits.append(ms)
        if len(waits) > 1:
            raise RuntimeError("Frame didn't arrive within 1")
        return frames

    stopped: list[bool] = []
    ways = {"start": lambda _: profile, "stop": lambda: stopped.append(True)}
    rs.pipeline = lambda: SimpleNamespace(**ways, wait_for_frames=wait)
    rs.align = lambda to: SimpleNamespace(process=lambda found: found if to == "color" else None)
    monkeypatch.setitem(sys.modules, "pyrealsense2", rs)
    camera = replace(option("perception/source", "realsense"), fresh=FRESH, serial=None)
    with camera.build() as source:
        frame = source.read_latest()
        with pytest.raises(FrameError, match="no new frame"):
            source.read_latest()
    assert stopped == [True]
    assert np.isnan(frame.depth_m[0]).all()
    assert frame.depth_m[1, 0] == pytest.approx(1.5)
    assert ("color", 1280, 720, "rgb8", 15) in streams
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(FrameError, match="not installed"):
        option("perception/source", "realsense").build().__enter__()


def test_the_simulated_camera_sees_the_hole_of_the_task() -> None:
    rig: StereoRig = replace(option("rig", "zed_2i_1080p"), width=480, height=270, focal_px=264.0)
    shipped: simulator.SimulatedCamera = option("perception/source", "simulator")
    spec = replace(shipped, rig=rig, num_frames=1)
    chain_m = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 2.6], [2.0, 0.0, 2.4], [2.0, 0.0, 1.6]])
    shot = spec.shoot((2.4, 0.0, 0.7, 0.3, 1.0, 0.06, 0.1), chain_m, np.random.default_rng(0))
    with spec.build() as source:
        frame = source.read_latest()
        assert frame is not None and source.read_latest() is None
    np.testing.assert_allclose(shot.truth.holes[0].center_in_base_m, [2.4, 0.0, 0.7], atol=1e-9)
    axis = [np.sin(0.1), 0.0, np.cos(0.1)]  # the block leans away from the machine
    np.testing.assert_allclose(shot.truth.holes[0].axis_in_base, axis, atol=1e-9)
    assert shot.truth.holes[0].radius_m == 0.06 and shot.label.arm.any()
    pixel = np.round(rig.left.project(np.array(shot.truth.holes[0].center_m))).astype(int)
    assert shot.label.hole_mask[pixel[1], pixel[0]]
    np.testing.assert_array_equal(frame.camera_matrix, rig.left.matrix)
    behind = replace(spec, task_scene=(-3.0, 0.0, 0.7, 0.0, 1.0, 0.05))
    with behind.build() as source, pytest.raises(FrameError, match="behind the camera"):
        source.read_latest()
