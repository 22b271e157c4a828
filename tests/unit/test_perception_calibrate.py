"""A calibration finds the camera, says how sure it is, leaves out what is wrong, and asks for what is missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import board
import cv2
import numpy as np
import pytest
import yaml
from composed import MACHINE, option
from conftest import Brokk
from drawn import K, drawn
from motion import make_recording
from scipy.spatial.transform import Rotation

from brokk_rl.errors import FrameError
from brokk_rl.record import write_recording
from brokk_rl.signals import Frame
from perception import dataset
from perception.calibrate import arm, clock_offset, evaluation, hand_eye, transforms
from perception.calibrate.disparity_error import estimate_disparity_error, measure_board_disparity
from perception.calibrate.extrinsics import compute_point_std_m, load_extrinsics
from perception.camera import CameraModel, write_camera
from perception.sources.folder import FrameFolder
from perception.stereo import correct_depth

EXACT = np.diag([0.0005, 0.0005, 0.001, 0.001, 0.001, 0.0005]) ** 2
"""How a board of 0.8 m is seen at 2 m: its corners to 0.1 px."""


def off(found: np.ndarray) -> tuple[float, float]:
    """Returns how far a camera is from the true one, mm and degrees."""
    away = transforms.compute_motion(found, board.CAMERA)
    return 1000 * float(np.linalg.norm(away[:3])), float(np.degrees(np.linalg.norm(away[3:])))


def opencv(views: Any) -> np.ndarray:
    """Returns the camera as OpenCV finds it (Park and Martin): the same equations, all poses alike."""
    back, seen = np.linalg.inv(views.base_from_link), views.camera_from_board[:, 0]
    parts: Any = (back[:, :3, :3], back[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3])
    turn, shift = cv2.calibrateHandEye(*parts, method=cv2.CALIB_HAND_EYE_PARK)
    return transforms.make_transform(turn, shift[:, 0])


@pytest.mark.parametrize(("zero_deg", "count", "wrong"), [(0.1, 30, 0.0), (0.5, 60, 0.15)])
def test_a_poor_arm_and_wrong_sights_leave_millimetres(
    zero_deg: float, count: int, wrong: float
) -> None:
    ours, theirs, surprise = [], [], []
    for seed in range(6):
        poses = board.posed(MACHINE, count, seed, np.radians(zero_deg), 0.001, 0.0005)
        views, bad = board.views(MACHINE, poses, EXACT, seed, wrong)
        found = hand_eye.solve_hand_eye(views)
        assert found is not None and not (bad & found.used).any()
        assert (~bad & ~found.used).sum() <= 1
        ours.append(off(found.guess.base_from_camera))
        if hasattr(cv2, "calibrateHandEye"):  # OpenCV 5.0.0 has forgotten it
            theirs.append(off(opencv(views)))
        away = transforms.compute_motion(found.guess.base_from_camera, board.CAMERA)
        surprise.append(away @ np.linalg.solve(found.cov[:6, :6], away))
    mm, degrees = np.median(ours, axis=0)
    assert mm <= 3.7 and degrees <= 0.58 and np.max(ours, axis=0)[0] < 8.0
    assert not theirs or mm < (0.2 if wrong else 1.0) * np.median(theirs, axis=0)[0]
    # Six degrees of freedom: 6, and 1.4 is the standard deviation of a mean of six.
    assert 2.0 < np.mean(surprise) < 12.0


def test_of_two_poses_that_fit_the_corners_the_arm_chooses() -> None:
    poses = board.posed(MACHINE, 20, 3, 0.0, 0.001, 0.0005)
    views, _ = board.views(MACHINE, poses, EXACT, 3)
    flip = transforms.make_transform(Rotation.from_rotvec([0.7, 0.3, 0.0]).as_matrix(), np.zeros(3))
    both = np.stack([views.camera_from_board[:, 0], views.camera_from_board[:, 0] @ flip], 1)
    swapped = np.arange(20) % 2 == 0
    both[swapped] = both[swapped, ::-1]
    mirrored = replace(views, camera_from_board=both, seen_cov=np.repeat(views.seen_cov, 2, 1))
    alone, found = hand_eye.solve_hand_eye(views), hand_eye.solve_hand_eye(mirrored)
    assert alone is not None and found is not None and found.used.all()
    one, other = found.guess.base_from_camera, alone.guess.base_from_camera
    np.testing.assert_allclose(one, other, atol=1e-4)


def swing(
    offset_s: float, moving: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns times and turns of frames, times and positions of a recording in which the arm starts and stops."""
    t_s = np.arange(0.0, 20.0, 0.05)
    phase = np.clip(np.sin(0.9 * t_s) * 1.6, -1, 1)  # goes, rests at the ends
    q = board.MIDDLE + moving * np.outer(phase, [0.3, 0.1, -0.2, 0.3, 0.2])
    frame_s = np.arange(1.0, 18.0, 1 / 15)
    there = np.stack([np.interp(frame_s + offset_s, t_s, column) for column in q.T], 1)
    return frame_s, arm.compute_link_poses(MACHINE, there).base_from_link[:, :3, :3], t_s, q


def shake(turns: np.ndarray) -> np.ndarray:
    """Returns turns as a camera sees them, to 2 mrad."""
    away_rad = 0.002 * np.random.default_rng(0).standard_normal((len(turns), 3))
    return turns @ Rotation.from_rotvec(away_rad).as_matrix()


def estimate_offset(frame_s: Any, turns: Any, t_s: Any, q: Any) -> Any:
    link = arm.compute_link_poses(MACHINE, q).base_from_link[:, :3, :3]
    return clock_offset.estimate_clock_offset(frame_s, turns, t_s, link, 1.0, 0.4)


@pytest.mark.parametrize("offset_s", [-0.31, 0.0, 0.08, 0.64])
def test_the_offset_of_the_clocks_is_found_to_a_few_milliseconds(offset_s: float) -> None:
    frame_s, turns, t_s, q = swing(offset_s)
    # Nobody knows how the camera and the board are turned.
    turns = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix() @ shake(turns)
    found = estimate_offset(frame_s, turns, t_s, q)
    assert found is not None and found.correlation > 0.6
    assert found.offset_s == pytest.approx(offset_s, abs=0.02)


def test_an_arm_that_rests_tells_nothing_about_clocks() -> None:
    frame_s, turns, t_s, q = swing(0.1, moving=False)
    found = estimate_offset(frame_s, shake(turns), t_s, q)
    assert found is None or found.correlation < 0.4
    still = turns[:1].repeat(len(t_s), 0)
    few = clock_offset.estimate_clock_offset(frame_s[:9], turns[:9], t_s, still, 1.0, 0.4)
    assert few is None


def test_uncertainty_at_a_distance_is_that_worked_by_hand() -> None:
    # 3 mm in each direction, and turns of 1 mrad about x and y that move a point 2 m ahead by 2 mm
    # each, about z by nothing
    cov = np.diag([0.003**2] * 3 + [0.001**2] * 3)
    assert compute_point_std_m(cov, 2.0) == pytest.approx(np.sqrt(3 * 0.003**2 + 2 * 0.002**2))


BASELINE_M, DISPARITY_ERROR_PX = 0.12, 0.25


@pytest.fixture(scope="module")
def footage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen pairs of the board in poses of the arm, one picture of nothing, and `joints.yaml`; the right camera is off."""
    folder, chance = tmp_path_factory.mktemp("board"), np.random.default_rng(0)
    other, right = np.random.default_rng(1), np.eye(4)
    right[0, 3] = -BASELINE_M
    poses = board.posed(MACHINE, 16, 0, 0.002, 0.001, 0.0005)
    write_camera(folder, CameraModel(board.MATRIX, None, BASELINE_M, (1280, 720)))
    for number, there in enumerate(poses.camera_from_board):
        dataset.write_picture(folder / f"{number:03d}.color.png", board.picture(there, chance))
        partner = board.picture(right @ there, other, -DISPARITY_ERROR_PX)
        dataset.write_picture(folder / f"{number:03d}.right.png", partner)
    dataset.write_picture(folder / "016.color.png", np.full((720, 1280, 3), 90, np.uint8))
    told = {f"{number:03d}": q.tolist() for number, q in enumerate(poses.q)}
    (folder / "joints.yaml").write_text(yaml.safe_dump(told))
    return folder


def test_the_command_finds_the_camera_and_sources_take_its_file(
    brokk: Brokk, footage: Path
) -> None:
    command = ("mode=calibrate", f"calibration.source.folder={footage}")
    brokk(*command, f"calibration.joints={footage / 'joints.yaml'}", "session.out=run")
    told = yaml.safe_load(Path("run/calibration.yaml").read_text())
    mm, degrees = off(np.array(told["T_base_cam"]))
    assert mm < 6.0 and degrees < 0.2
    assert told["num_used"] >= 15 and told["missing"] == [] and told["corners_px"] < 0.3
    away = transforms.compute_motion(np.array(told["T_base_cam"]), board.CAMERA)
    assert away @ np.linalg.solve(np.array(told["covariance"]), away) < 25.0
    disparity = told["disparity"]
    assert disparity["error_px"][0] == pytest.approx(DISPARITY_ERROR_PX, abs=0.1)
    assert disparity["num_views"] >= 15
    (lost,) = (one for one in told["poses"] if one["name"] == "016")
    assert "corners of the board" in lost["left_out"]
    folder = FrameFolder(
        folder=str(footage), rate_hz=1.0, least_known=0.0, needs="camera", base_from_camera="run/calibration.yaml",
    )  # fmt: skip
    with folder.build() as source:
        frame = source.read_latest()
    np.testing.assert_allclose(frame.base_from_camera, np.array(told["T_base_cam"]))
    np.testing.assert_allclose(frame.camera_cov, np.array(told["covariance"]), atol=1e-12)
    Path("other.yaml").write_text("schema: 7\n")
    look = ("mode=perceive", f"perceive.input={footage}", "session.out=look")
    lost = brokk(*look, "source.base_from_camera=other.yaml", code=2)
    assert "no calibration of schema 1" in lost.err


def test_poses_that_tell_too_little_are_refused_with_those_that_are_missing(
    brokk: Brokk, footage: Path
) -> None:
    same = {}
    for number in range(16):
        same[f"{number:03d}"] = (board.MIDDLE + 0.02 * number * np.eye(5)[4]).tolist()
    Path("same.yaml").write_text(yaml.safe_dump(same))
    command = ("mode=calibrate", f"calibration.source.folder={footage}", "session.out=run")
    done = brokk(*command, "calibration.joints=same.yaml", code=2)
    assert "do not determine where the camera is" in done.err
    assert "q1 stays within" in done.err
    assert not Path("run/calibration.yaml").exists()
    Path("few").mkdir()
    for name in ("camera.yaml", "000.color.png"):
        Path("few", name).write_bytes((footage / name).read_bytes())
    done = brokk(*command, "calibration.source.folder=few", "calibration.joints=same.yaml", code=2)
    assert "1 frames show the board" in done.err
    Path("degrees.yaml").write_text(yaml.safe_dump({"000": [0.0, -43.0, 34.0, 28.0, 28.0]}))
    done = brokk(*command, "calibration.joints=degrees.yaml", code=2)
    assert "are these degrees?" in done.err


@pytest.mark.slow
def test_a_board_filmed_while_the_arm_moves_is_enough(brokk: Brokk, tmp_path: Path) -> None:
    poses, t_s = board.posed(MACHINE, 12, 1), np.arange(0.0, 14.0, 0.05)
    # Of each second, 0.6 s on the way to the next pose.
    eased = np.floor(t_s) + np.clip((t_s % 1.0 - 0.2) / 0.6, 0.0, 1.0)
    q = np.stack([np.interp(eased, np.arange(12.0), column) for column in poses.q.T], 1)
    write_recording(make_recording(MACHINE, np.zeros_like(q), q), tmp_path / "run.parquet")
    frame_s, late_s, chance = np.arange(0.5, 11.5, 0.4), 0.12, np.random.default_rng(0)
    write_camera(tmp_path, CameraModel(board.MATRIX, size_px=(1280, 720)))
    there = np.stack([np.interp(frame_s + late_s, t_s, column) for column in q.T], 1)
    for number, link in enumerate(arm.compute_link_poses(MACHINE, there).base_from_link):
        seen = np.linalg.inv(board.CAMERA) @ link @ poses.link_from_board
        dataset.write_picture(tmp_path / f"{number:03d}.color.png", board.picture(seen, chance))
    source = (f"calibration.source.folder={tmp_path}", "calibration.source.rate_hz=2.5")
    joints = f"calibration.joints={tmp_path / 'run.parquet'}"
    brokk("mode=calibrate", *source, joints, "session.out=run")
    told = yaml.safe_load(Path("run/calibration.yaml").read_text())
    # The folder's first frame is at 0 s, the recording's clock says 0.5 + 0.12 s then.
    assert told["clock"]["trusted"] and told["clock"]["offset_s"] == pytest.approx(0.62, abs=0.01)
    mm, degrees = off(np.array(told["T_base_cam"]))
    assert mm < 4.0 and degrees < 0.1


def judged(joint: int, factor: float) -> evaluation.Verdict:
    """Returns the verdict on true sights of the board beside positions of which one joint is scaled."""
    poses = board.posed(MACHINE, 30, joint, 0.0044, 0.0017, 0.001)
    q = poses.q.copy()
    q[:, joint] *= factor
    views = board.views(MACHINE, replace(poses, q=q), EXACT, joint)[0]
    found = hand_eye.solve_hand_eye(views)
    zeros = dict(zip(views.shared_names, found.guess.shared.tolist(), strict=True))
    return evaluation.judge_fit(found.used, found.factor, zeros, 0.0087, [])


@pytest.mark.parametrize(
    ("joint", "factor", "status"),
    [(0, 1.0, "good"), (0, 1.1, "not to be trusted"), (3, 0.95, "not to be trusted"),
     (1, -1.0, "not to be trusted"), (4, -1.0, "not to be trusted")],
)  # fmt: skip
def test_only_a_right_arm_is_called_good(joint: int, factor: float, status: str) -> None:
    assert judged(joint, factor).status == status


def test_a_fit_is_judged_by_what_it_leaves_out_and_what_it_lacks() -> None:
    def judge(num_used: int, num_views: int, factor: float, zero: float, *missing: str) -> Any:
        used = np.arange(num_views) < num_used
        return evaluation.judge_fit(used, factor, {"q2": zero}, 0.0087, missing)

    assert judge(30, 30, 1.0, 0.02).status == "good"
    assert judge(15, 30, 1.5, 0.02).status == "good"
    for wrong in (
        judge(14, 30, 1.0, 0.02), judge(30, 30, 1.51, 0.02), judge(30, 30, 1.0, -0.0262),
    ):  # fmt: skip
        assert wrong.status == "not to be trusted" and len(wrong.reasons) == 2
    assert judge(7, 10, 1.0, 0.02).status == "cannot tell"
    assert judge(30, 30, 1.0, 0.02, "turn more") == evaluation.Verdict("cannot tell", ["turn more"])


def test_a_wrong_joint_ends_with_an_error_and_its_file_is_refused(
    brokk: Brokk, footage: Path
) -> None:
    told = yaml.safe_load((footage / "joints.yaml").read_text())
    wrong = {name: [*q[:2], 1.1 * q[2], *q[3:]] for name, q in told.items()}
    Path("wrong.yaml").write_text(yaml.safe_dump(wrong))
    done = brokk(
        "mode=calibrate", f"calibration.source.folder={footage}", "calibration.joints=wrong.yaml",
        "session.out=run", code=2,
    )  # fmt: skip
    assert "not to be trusted: the arm would be" in done.err
    content = yaml.safe_load(Path("run/calibration.yaml").read_text())
    assert content["verdict"]["status"] == "not to be trusted"
    with pytest.raises(FrameError, match="not to be trusted: the arm"):
        load_extrinsics("run/calibration.yaml", "source.base_from_camera")
    content["verdict"] = {"status": "cannot tell", "reasons": ["few"]}
    Path("open.yaml").write_text(yaml.safe_dump(content))
    assert load_extrinsics("open.yaml", "here").base_from_camera is not None
    rows = [("covariance", [[1, 2], [3]]), ("disparity", {}), ("disparity", 3), ("verdict", "good")]
    for part, value in rows:
        Path("damaged.yaml").write_text(yaml.safe_dump(content | {"verdict": {}, part: value}))
        with pytest.raises(FrameError, match=r"damaged\.yaml"):
            load_extrinsics("damaged.yaml", "here")


MATRIX = np.array([[1056.0, 0.0, 959.5], [0.0, 1056.0, 539.5], [0.0, 0.0, 1.0]])
CORNERS_M = np.stack([*np.meshgrid(np.arange(7) * 0.1, np.arange(5) * 0.1), np.zeros((5, 7))], -1)
CORNERS_M = CORNERS_M.reshape(-1, 3)
ERROR_PX = (0.25, -0.1, 0.15)


class RightCamera:
    """Stands in for a tracker of boards: it knows where the right picture shows the corners."""

    def __init__(self, corners_px: np.ndarray) -> None:
        self._corners_px = corners_px

    def find_corners(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        # one corner is missed, and the order differs
        return CORNERS_M[:0:-1], self._corners_px[:0:-1]


def view(chance: np.random.Generator, depth_m: float, baseline_m: float = BASELINE_M) -> Any:
    """Returns the disparity of a board at a random place, its pose found as OpenCV does."""
    turn = chance.uniform(-0.4, 0.4, 3)
    place = np.array([*(chance.uniform(-0.3, 0.3, 2) * depth_m), depth_m]) - [0.3, 0.2, 0.0]
    point = CORNERS_M @ np.asarray(cv2.Rodrigues(turn)[0]).T + place
    x, y = (point[:, :2] / point[:, 2:]).T
    left = np.stack([x, y], 1) * 1056.0 + MATRIX[:2, 2]
    wrong_px = ERROR_PX[0] + ERROR_PX[1] * x + ERROR_PX[2] * y
    right = left.copy()
    right[:, 0] -= 1056.0 * baseline_m / point[:, 2] + wrong_px
    left, right = (one + chance.normal(0, 0.05, one.shape) for one in (left, right))
    _, found, shift = cv2.solvePnP(CORNERS_M, left, MATRIX, None)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(found)[0], shift[:, 0]
    black = np.zeros((2, 2, 3), np.uint8)
    frame = Frame(
        color=black, depth_m=black[..., 0].astype(np.float32), camera_matrix=MATRIX,
        base_from_camera=None, t_s=0.0, right=black, baseline_m=BASELINE_M,
    )  # fmt: skip
    tracker: Any = RightCamera(right)
    return measure_board_disparity(tracker, frame, CORNERS_M, left, pose)


def test_constant_and_slopes_come_from_boards_at_several_distances() -> None:
    away = []
    for seed in range(20):
        chance = np.random.default_rng(seed)
        found = estimate_disparity_error([view(chance, d) for d in np.linspace(1.0, 3.5, 24)])
        away.append((np.array(found.px) - ERROR_PX) / found.std_px)
        assert found.std_px < 0.1
        assert found.px[0] == pytest.approx(0.25, abs=0.06)
    # the largest of three standard deviations holds for all: no more than 32 % lie outside
    assert np.mean(np.abs(away) > 1.0) < 0.32
    assert np.abs(away).max() < 4.0


def test_one_distance_or_few_views_say_nothing() -> None:
    chance = np.random.default_rng(0)
    assert estimate_disparity_error([view(chance, 2.0) for _ in range(20)]) is None
    assert estimate_disparity_error([view(chance, d) for d in (1.0, 2.0, 3.0)]) is None


def test_a_wrong_baseline_is_no_constant() -> None:
    chance = np.random.default_rng(1)
    views = [view(chance, d, 1.002 * BASELINE_M) for d in np.linspace(1.0, 3.5, 40)]
    found = estimate_disparity_error(views)
    assert found.scale == pytest.approx(0.002, abs=0.001)
    assert found.px[0] == pytest.approx(0.25, abs=3.0 * found.std_px)


def test_a_known_error_is_taken_out_of_depth_and_pictures() -> None:
    frame, masks, ellipse = drawn()
    pull_px = K[0, 0] * BASELINE_M
    rows, columns = np.mgrid[0:480, 0:640]
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    true_px = pull_px / frame.depth_m
    wrong_px = true_px + ERROR_PX[0] + ERROR_PX[1] * x + ERROR_PX[2] * y
    depth_m = correct_depth((pull_px / wrong_px).astype(np.float32), K, BASELINE_M, ERROR_PX)
    np.testing.assert_allclose(depth_m, frame.depth_m, rtol=1e-5)
    # a grainy face, so that both pictures can be aligned; the right one shows the wrong disparity
    grain = np.random.default_rng(0).normal(0, 25, (480, 700)).astype(np.float32)
    grain = cv2.GaussianBlur(grain, (0, 0), 1.2)[:, :640] * 3
    gray = np.clip(frame.color[..., 0] + grain * (frame.color[..., 0] > 140), 0, 255)
    # seen from the right camera: solved by iterating, as the disparity depends on the left column
    u, v = columns.astype(np.float32), rows.astype(np.float32)
    shift_px, start = wrong_px.astype(np.float32), u
    for _ in range(20):
        u = start + cv2.remap(shift_px, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    right = cv2.remap(gray.astype(np.float32), u, v, cv2.INTER_CUBIC)
    pair = replace(
        frame,
        color=np.repeat(gray.astype(np.uint8)[..., None], 3, 2),
        right=np.repeat(right.clip(0, 255).astype(np.uint8)[..., None], 3, 2),
        baseline_m=BASELINE_M,
        disparity_std_px=0.0,
    )
    estimator = option("perception/pose", "plane_conic").build()
    exact = estimator.estimate(replace(pair, right=None), masks, ellipse)
    known = estimator.estimate(replace(pair, disparity_error_px=ERROR_PX), masks, ellipse)
    unknown = estimator.estimate(pair, masks, ellipse)
    off_m = np.linalg.norm(known.center_m - exact.center_m)
    assert off_m < 0.001
    # not told of the error, the pictures pull the plane away from the depth
    assert np.linalg.norm(unknown.center_m - exact.center_m) > 2 * off_m


def test_cameras_take_the_error_from_the_calibration(tmp_path: Path) -> None:
    content = {
        "schema": 1,
        "T_base_cam": np.eye(4).tolist(),
        "verdict": {"status": "good", "reasons": []},
        "disparity": {"error_px": [0.25, 0.0, 0.0], "std_px": 0.03},
    }
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(content))
    place = load_extrinsics(str(path), "source.base_from_camera")
    assert place.disparity_error_px == (0.25, 0.0, 0.0)
    assert place.disparity_std_px == 0.03
    color = np.full((90, 160, 3), 128, np.uint8)
    dataset.write_frame(tmp_path / "0", color, np.full((90, 160), 2.0, np.float32))
    matrix = np.array([[88.0, 0, 79.5], [0, 88.0, 44.5], [0, 0, 1]])
    write_camera(tmp_path, CameraModel(matrix, None, BASELINE_M, (160, 90)))
    folder = option("perception/source", "folder", folder=str(tmp_path), base_from_camera=str(path))
    with folder.build() as source:
        frame = source.read_latest()
    assert frame.disparity_std_px == 0.03
    # 88 px times 0.12 m over 2 m is 5.28 px, of which 0.25 px are wrong
    np.testing.assert_allclose(frame.depth_m, 88.0 * 0.12 / 5.03, rtol=1e-6)
