"""The error of a pair's disparity is measured on a board, and poses are free of it afterwards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from composed import option
from drawn import K, drawn

from brokk_rl.contracts.vision import HolePose
from brokk_rl.signals import Frame
from perception import dataset
from perception.calibrate.disparity_error import estimate_disparity_error, measure_board_disparity
from perception.calibrate.extrinsics import load_extrinsics
from perception.camera import CameraModel, write_camera
from perception.stereo import correct_depth

BASELINE_M = 0.12
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
        assert found is not None
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
    assert found is not None
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
    assert isinstance(exact, HolePose)
    assert isinstance(known, HolePose)
    assert isinstance(unknown, HolePose)
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
    assert frame is not None
    assert frame.disparity_std_px == 0.03
    # 88 px times 0.12 m over 2 m is 5.28 px, of which 0.25 px are wrong
    np.testing.assert_allclose(frame.depth_m, 88.0 * 0.12 / 5.03, rtol=1e-6)
