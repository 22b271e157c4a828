"""Labels for real footage: a measured block is projected; held against what a renderer knows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cuboid
import numpy as np
import pytest
import yaml
from composed import option

from brokk_rl.errors import FrameError
from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from perception import dataset
from perception.camera import CameraModel, write_camera
from perception.label.camera_pose import BoardPose, Charuco
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
