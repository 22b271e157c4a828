"""Labels for real footage: placed by hand, refined, projected; held against what a renderer knows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cuboid
import cv2
import numpy as np
import pytest
import yaml
from composed import option

from brokk_rl.signals import Frame
from perception import dataset
from perception.label.camera_pose import Charuco

SIZE_PX = (480, 270)
EYES_M = ((-1.8, -0.9, 1.0), (-2.0, 0.3, 0.8), (-1.5, 0.9, 1.2), (-2.4, -0.3, 0.7))
BALL_M = (-0.5, 0.15, 0.55)
CORNERS_M = np.array([[0.0, -0.4, 0.0], [0.0, 0.4, 0.0], [0.0, -0.4, 0.6]])


@pytest.fixture(scope="module")
def footage(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[cuboid.View]]:
    """A folder of frames around one block, something hanging before it, the camera's poses beside them, and what is true."""
    folder = tmp_path_factory.mktemp("footage")
    views, poses = [], {}
    for number, eye in enumerate(EYES_M):
        view = cuboid.seen(
            cuboid.looking(eye, (0.1, 0.0, 0.3)), SIZE_PX, 0.003, BALL_M, seed=number
        )
        dataset.write_frame(
            folder / "frames" / f"{number:02d}", view.frame.color, view.frame.depth_m
        )
        poses[f"{number:02d}"] = view.world_from_camera.tolist()
        views.append(view)
    first = views[0].frame
    size_px = first.color.shape[1::-1]
    dataset.write_camera(folder / "frames", first.camera_matrix, size_px, None, None)
    (folder / "poses.yaml").write_text(yaml.safe_dump(poses))
    return folder, views


def clicked(view: cuboid.View, points_m: np.ndarray, miss_px: float) -> list[list[float]]:
    """Returns where a person clicks who misses by so much."""
    local = (points_m - view.world_from_camera[:3, 3]) @ view.world_from_camera[:3, :3]
    pixels = (local @ view.frame.camera_matrix.T)[:, :2] / local[:, 2:]
    return (pixels + np.random.default_rng(3).choice([-miss_px, miss_px], pixels.shape)).tolist()


def labelled(
    brokk: Callable[..., Any], folder: Path, placing: dict[str, Any], *overrides: str
) -> tuple[Any, Path]:
    out = folder / f"out{len(list(folder.glob('out*')))}"
    (folder / "placing.yaml").write_text(yaml.safe_dump(placing))
    done = brokk(
        "mode=label", f"label.source.folder={folder / 'frames'}", "perception/camera_pose@label.camera=given",
        f"label.camera.poses={folder / 'poses.yaml'}", f"label.placing={folder / 'placing.yaml'}", f"session.out={out}",
        "label.noise_per_m=0.003", "label.reach_px=10", "label.num_refined=4", *overrides,
    )  # fmt: skip
    return done, out


def test_labels_from_three_sloppy_clicks_are_those_of_the_renderer(
    brokk: Callable[..., Any], footage: tuple[Path, list[cuboid.View]]
) -> None:
    folder, views = footage
    placing = {
        "frame": "01",
        "corners_px": clicked(views[1], CORNERS_M, 2.5),
        "thickness_m": 1.2,
        "mouths": [
            {
                "center_px": clicked(views[1], cuboid.HOLE_M[None], 2.0)[0],
                "radius_m": cuboid.RADIUS_M,
            }
        ],
    }
    done, out = labelled(brokk, folder, placing)
    assert done.code == 0, done.err
    for number, view in enumerate(views):
        label = dataset.read_label(out / "frames" / f"{number:02d}")
        assert cuboid.overlap(label.block, view.block) > 0.95
        assert cuboid.overlap(label.hole_mask, view.mouth) > 0.8
        assert (label.arm & ~view.occluder).sum() < 0.01 * view.block.sum()
        assert (label.block & view.occluder).sum() < 0.01 * view.block.sum()
    truth = dataset.read_truth(out / "frames" / "00")
    local = (cuboid.HOLE_M - views[0].world_from_camera[:3, 3]) @ views[0].world_from_camera[:3, :3]
    assert np.linalg.norm(np.array(truth.holes[0].center_m) - local) < 0.004
    assert len(list((out / "overlays").glob("*.png"))) == len(views)


def test_a_block_in_the_wrong_place_is_left_out_and_said(
    brokk: Callable[..., Any], footage: tuple[Path, list[cuboid.View]]
) -> None:
    folder, views = footage
    # 5 cm at 1.9 m and a focal length of 264 px: 7 px
    shifted_m = CORNERS_M + np.array([0.0, 0.05, 0.0])
    placing = {
        "frame": "01", "corners_px": clicked(views[1], shifted_m, 0.0), "thickness_m": 1.2,
    }  # fmt: skip
    done, out = labelled(brokk, folder, placing, "label.num_refined=0")
    assert done.code == 2
    assert "no frame could be labelled: edges of the picture lie" in done.err
    assert not list(out.glob("frames/*"))


def test_a_board_tells_where_the_camera_was() -> None:
    spec = option("perception/camera_pose", "charuco")
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
