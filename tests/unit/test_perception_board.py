"""The printed board: its size on paper, where OpenCV finds its corners, and rendered sequences of it on the arm."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from composed import option
from conftest import Brokk
from drawn import as_color, blank

from brokk_rl import record
from brokk_rl.contracts.vision import HolePose
from brokk_rl.errors import ConfigError
from brokk_rl.extensions import load_part
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from perception.calibrate import transforms
from perception.calibrate.arm import compute_link_poses
from perception.label.camera_pose import Charuco, estimate_board_pose
from perception.modes.board import draw_board
from perception.modes.score_camera import match_found_holes
from perception.render.board_on_arm import BoardOnArm, BoardScenes
from perception.render.frame_renderer import FrameRenderer

POINTS_PER_M = 72.0 / 0.0254


def test_the_page_is_to_scale(brokk: Brokk, tmp_path: Path) -> None:
    out = tmp_path / "out"
    brokk("mode=board", "board.square_m=0.05", "board.marker_m=0.0375", f"session.out={out}")
    box = re.search(rb"/MediaBox\s*\[([^\]]+)\]", (out / "board.pdf").read_bytes())
    # 8 x 6 squares of 5 cm, 3 cm of margin on each side: 46 x 36 cm
    size = [float(value) for value in box.group(1).split()][2:]
    np.testing.assert_allclose(size, np.array([0.46, 0.36]) * POINTS_PER_M, atol=0.01)


def test_a_pose_of_the_board_is_as_uncertain_as_it_says() -> None:
    """A lens with distortion and 0.2 px of noise: squared distances of six numbers are 6 on average."""
    chance, matrix = (
        np.random.default_rng(0),
        np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]]),
    )
    frame = blank(480, 640, camera_matrix=matrix, distortion=np.array([-0.2, 0.05, 0.0, 0.0, 0.0]))
    corners_m = np.stack(
        [*np.meshgrid(np.arange(7) * 0.05, np.arange(5) * 0.05), np.zeros((5, 7))], -1
    )
    corners_m, turn = corners_m.reshape(-1, 3), np.array([0.5, -0.6, 0.2])
    shift_m = np.array([-0.1, 0.05, 0.9])
    true = transforms.make_transform(np.asarray(cv2.Rodrigues(turn)[0]), shift_m)
    seen = cv2.projectPoints(corners_m, turn, shift_m, matrix, frame.distortion)[0][:, 0]
    distances = []
    for _ in range(100):
        noisy = seen + chance.normal(0.0, 0.2, seen.shape)
        found = estimate_board_pose(frame, corners_m, noisy, 0.2, 1.0)
        away = transforms.compute_motion(found.camera_from_board[0], true)
        distances.append(away @ np.linalg.solve(found.cov[0], away))
    assert 5.0 < np.mean(distances) < 7.0


def test_opencv_finds_every_corner_at_its_place_on_the_page() -> None:
    board = load_part("board")
    figure = draw_board(board, 0.03)
    file = io.BytesIO()
    figure.savefig(file, dpi=50.8, format="png")  # 2 px for a millimetre
    page = np.asarray(cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE))
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = (board.columns, board.rows)
    drawn = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, markers)
    found, numbers, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(page)
    assert len(numbers) == (board.columns - 1) * (board.rows - 1)
    all_m: Any = np.asarray(drawn.getChessboardCorners())
    corners_m = all_m[numbers[:, 0]][:, :2]
    # pixel centres lie half a pixel in; the detector refines to a tenth of a pixel
    np.testing.assert_allclose(found[:, 0], 2000 * (corners_m + 0.03) - 0.5, atol=0.6)


def test_small_blurred_markers_are_read_in_linear_light() -> None:
    charuco = load_part("board")
    picture = charuco.describe().generateImage((8 * 112, 6 * 112)).astype(np.float32) / 255
    picture = 0.05 + 0.85 * np.pad(picture, 80, constant_values=1.0)
    turn = np.array([[0.9925, 0.1219, 0], [-0.1219, 0.9925, 100]])
    turned = cv2.warpAffine(picture, turn, (1160, 990), borderValue=0.5)
    # 28 px a square, of which one of a marker's cells has 3 px.
    blurred = cv2.GaussianBlur(turned, (0, 0), 3.6)
    light = cv2.resize(blurred, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    frame = blank(*light.shape, color=as_color(255 * light ** (1 / 2.2)), gamma=2.2)
    assert len(charuco.find_corners(frame)[0]) == 35
    assert len(charuco.find_corners(replace(frame, gamma=1.0))[0]) < 30


def test_a_board_that_cannot_be_drawn_is_refused() -> None:
    board = load_part("board")
    with pytest.raises(ConfigError, match="has 50 markers, 12 x 10 squares need 60"):
        draw_board(replace(board, dictionary="DICT_4X4_50", columns=12, rows=10), 0.03)


RIG = option("rig", "zed_2i_720p")


def find_corners(board: Charuco, studio: FrameRenderer, scenes: Any, number: int) -> Any:
    """Returns the corners that OpenCV finds in a frame, on the board and in the picture, and the staged scene."""
    scene, generator = scenes.compose(number)
    shot = studio.shot(scene, generator)
    frame = Frame(shot.color, shot.depth_m, studio.rig.left.matrix, None, 0.0, name="0")
    return *board.find_corners(frame), scene, shot


def test_a_board_on_the_arm_is_where_the_recording_says(tmp_path: Path) -> None:
    kind: BoardOnArm = option("scene", "board_on_arm")
    scenes = BoardScenes(kind, RIG, Session(out=".", seed=4, device="cpu"))
    studio = FrameRenderer(
        rig=RIG, scene=kind, stereo=load_part("stereo"), depth="none", pair=False
    )
    corners_m, corners_px, scene, _ = find_corners(kind.board, studio, scenes, 3)
    assert len(corners_m) > 20
    scenes.write_records(tmp_path, 4)
    recording = record.read_recording(tmp_path / "joints.parquet", kind.machine)
    truth = yaml.safe_load((tmp_path / "truth.yaml").read_text())
    zeros = np.array(list(truth["joint_zeros"].values()))
    # The board stays on the link: its pose there, from frame 3, predicts frame 1.
    t_s = np.array([3, 1]) / kind.rate_hz + kind.clock_s
    q = np.stack([np.interp(t_s, recording.t_s, one) for one in recording.q.T], 1) + zeros
    link = compute_link_poses(kind.machine, q).base_from_link
    plates: list[Any] = [scenes.compose(number)[0].solids for number in (3, 1)]
    at = [next(one.pose.center_m for one in solids if one.role == "board") for solids in plates]
    base = RIG.base_from_camera
    in_base = [base[:3, :3] @ one + base[:3, 3] for one in at]
    on_link = link[0][:3, :3].T @ (in_base[0] - link[0][:3, 3])
    predicted = link[1][:3, :3] @ on_link + link[1][:3, 3]
    # The sensors' noise of 0.5 mrad at 2 m.
    assert np.linalg.norm(predicted - in_base[1]) < 0.006
    # And the print lies on the plate: corners of squares project to where OpenCV finds them.
    plate: Any = next(one for one in scene.solids if one.role == "board")
    size_m = np.array([kind.board.columns, kind.board.rows]) * kind.board.square_m
    local = corners_m - [*(size_m / 2), plate.half_m[2]]
    expected = RIG.left.project(plate.pose.point(local))
    # A shadow's edge moves one corner by half a pixel.
    away_px = expected - corners_px
    assert np.median(np.linalg.norm(away_px, axis=1)) < 0.15
    assert np.abs(away_px.mean(0)).max() < 0.05


def test_a_score_counts_each_hole_once() -> None:
    axis = np.array([0.0, 0.0, 1.0])
    found = []
    for place_m in ([1.0, 0.0, 2.003], [1.0, 0.0, 2.01], [0.0, 0.0, 2.0]):
        cov_m2 = np.eye(3) * 0.002**2
        found.append(
            HolePose(np.array(place_m), axis, 0.05, cov_m2, np.zeros((3, 3)), "camera", 1.0, 0.0)
        )
    true = [(np.array([1.0, 0.0, 2.0]), axis), (np.array([5.0, 0.0, 2.0]), axis)]
    errors, num_false = match_found_holes("00000", found, true)
    assert (len(errors), num_false) == (1, 2)
    assert errors[0].position_m == pytest.approx(0.003)
    assert errors[0].sigmas == pytest.approx(1.5)
