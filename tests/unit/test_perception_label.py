"""Labels for real footage: a measured block is projected; held against what a renderer knows."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cuboid
import cv2
import numpy as np
import pytest
import yaml
from composed import option

from brokk_rl.errors import FrameError
from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from perception import dataset
from perception.label.camera_pose import CameraPose, Charuco
from perception.label.labeller import BlockLabelling

EYES_M = ((-1.8, -0.9, 1.0), (-2.0, 0.3, 0.8), (-2.4, -0.3, 0.7))
BALL_M = (-0.5, 0.15, 0.55)
WORLD_FROM_BOARD = np.eye(4)[[2, 0, 1, 3]]
"""A board in the drilled face: its z axis is the world's x."""


@pytest.fixture(scope="module")
def views() -> list[cuboid.View]:
    """Frames around one block, something hanging before it, with what is true."""
    found = []
    for number, eye in enumerate(EYES_M):
        pose = cuboid.looking(eye, (0.1, 0.0, 0.3))
        found.append(cuboid.seen(pose, (480, 270), 0.003, BALL_M, seed=number))
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
    dataset.write_camera(folder / "in", first.camera_matrix, size_px, None, None)

    def locate(frame: Frame) -> CameraPose:
        return CameraPose(board_from_world @ views[int(frame.name[-2:])].world_from_camera, 0.1)

    source = option("perception/source", "folder", folder=str(folder / "in"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Charuco, "build", lambda self: SimpleNamespace(locate=locate))
        labelling = BlockLabelling(
        source=source, board=load_part("board"), measured=str(folder / "measured.yaml"), noise_per_m=0.003,
        num_sigma=3.0, min_depth_share=0.5,
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


def test_a_board_tells_where_the_camera_was() -> None:
    spec = load_part("board")
    view = board_view(spec)
    pose = spec.build().locate(view)
    assert pose.error_px < 0.6
    assert view.base_from_camera is not None
    np.testing.assert_allclose(
        pose.world_from_camera[:3, 3], view.base_from_camera[:3, 3], atol=0.01
    )
    np.testing.assert_allclose(
        pose.world_from_camera[:3, :3], view.base_from_camera[:3, :3], atol=0.01
    )


def board_view(spec: Charuco) -> Frame:
    """Returns a picture of a board as a pinhole sees it; `base_from_camera` is its pose in the board's frame."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    board = cv2.aruco.CharucoBoard(
        (spec.columns, spec.rows), spec.square_m, spec.marker_m, dictionary
    )
    extent = np.array([spec.columns, spec.rows]) * spec.square_m
    drawn = board.generateImage((np.rint(extent * 1000).astype(int)).tolist(), marginSize=0)
    eye, at = np.array([0.9, -0.6, -1.1]), np.array([*(extent / 2), 0.0])
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross([0.0, 1.0, 0.0], forward) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], forward))
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix = np.array([[700.0, 0.0, 479.5], [0.0, 700.0, 269.5], [0.0, 0.0, 1.0]])
    # the board's pixels, 1 mm each, to the picture: a homography, pixel centres half a pixel in
    metres = np.array([[1e-3, 0.0, 0.5e-3], [0.0, 1e-3, 0.5e-3], [0.0, 0.0, 1.0]])
    flat = (
        matrix @ np.column_stack([rotation.T[:, 0], rotation.T[:, 1], -rotation.T @ eye]) @ metres
    )
    picture = cv2.warpPerspective(drawn, flat, (960, 540), flags=cv2.INTER_AREA, borderValue=200)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, eye
    color = np.repeat(picture[..., None], 3, 2)
    return Frame(
        color=color,
        depth_m=np.ones((540, 960), np.float32),
        camera_matrix=matrix,
        base_from_camera=pose,
        t_s=0.0,
    )
