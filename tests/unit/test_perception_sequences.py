"""Rendered sequences with a board: geometry against projection by hand, records against kinematics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from composed import option

from brokk_rl import record
from brokk_rl.contracts.vision import HolePose
from brokk_rl.extensions import load_part
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from perception.calibrate.arm import compute_link_poses
from perception.label.camera_pose import Charuco
from perception.modes.score_camera import match_found_holes
from perception.render.board_on_arm import BoardOnArm, BoardScenes
from perception.render.frame_renderer import FrameRenderer
from perception.render.stereo_camera import StereoRig

SESSION = Session(out=".", seed=4, device="cpu")


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return option("rig", "zed_2i_720p")


def find_corners(board: Charuco, studio: FrameRenderer, scenes: Any, number: int) -> Any:
    """Returns the corners that OpenCV finds in a frame, on the board and in the picture, and the staged scene."""
    scene, generator = scenes.compose(number)
    shot = studio.shot(scene, generator)
    frame = Frame(shot.color, shot.depth_m, studio.rig.left.matrix, None, 0.0, name="0")
    return *board.find_corners(frame), scene, shot


def test_a_board_on_the_arm_is_where_the_recording_says(rig: StereoRig, tmp_path: Path) -> None:
    kind: BoardOnArm = option("scene", "board_on_arm")
    scenes = BoardScenes(kind, rig, SESSION)
    studio = FrameRenderer(
        rig=rig, scene=kind, stereo=load_part("stereo"), depth="none", pair=False
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
    base = rig.base_from_camera
    in_base = [base[:3, :3] @ one + base[:3, 3] for one in at]
    on_link = link[0][:3, :3].T @ (in_base[0] - link[0][:3, 3])
    predicted = link[1][:3, :3] @ on_link + link[1][:3, 3]
    # The sensors' noise of 0.5 mrad at 2 m.
    assert np.linalg.norm(predicted - in_base[1]) < 0.006
    # And the print lies on the plate: corners of squares project to where OpenCV finds them.
    plate: Any = next(one for one in scene.solids if one.role == "board")
    size_m = np.array([kind.board.columns, kind.board.rows]) * kind.board.square_m
    local = corners_m - [*(size_m / 2), plate.half_m[2]]
    expected = rig.left.project(plate.pose.point(local))
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
