"""`mode=perceive` end to end on a small folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn import CENTER, K, drawn

from perception import dataset
from perception.camera import CameraModel, write_camera


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "frames"
    place.mkdir()
    write_camera(place, CameraModel(K, size_px=(640, 480), base_from_camera=np.eye(4)))
    frame, masks, _ = drawn()
    label = dataset.FrameLabel(
        masks.block > 0.5, np.zeros(masks.block.shape, bool), np.zeros(masks.block.shape, bool)
    )
    for number in range(3):
        dataset.write_frame(place / f"{number:05d}", frame.color, frame.depth_m, label=label)
    cut = (place / "00001.color.png").read_bytes()
    (place / "00001.color.png").write_bytes(cut[: len(cut) // 2])
    return place


def test_holes_overlays_and_refusals_are_written(folder: Path, brokk: Callable) -> None:
    done = brokk(
        "mode=perceive", f"perceive.input={folder}", "session.out=out", "tracker.confirm=1",
    )  # fmt: skip
    assert done.code == 0, done.err
    frames = json.loads(Path("out/holes.json").read_text())["frames"]
    assert [("refused" in frame) for frame in frames] == [False, True, False]
    assert "truncated" in frames[1]["refused"] and "00001" in frames[1]["refused"]
    hole = frames[0]["holes"][0]
    assert hole["center_m"] == pytest.approx(CENTER.tolist(), abs=1e-3)
    assert hole["frame"] == "base" and np.array(hole["cov_m2"]).shape == (3, 3)
    assert frames[2]["target"]["num_frames"] == 2
    assert cv2.imread("out/overlays/00000.png") is not None
    assert not Path("out/overlays/00001.png").exists()
    assert "1 hole" in Path("out/explain.txt").read_text()


def test_ellipses_of_a_picture_need_no_depth(folder: Path, brokk: Callable) -> None:
    for path in folder.glob("*.depth.npy"):
        path.unlink()
    command = ("mode=perceive", f"perceive.input={folder}", "perceive.until=ellipses")
    done = brokk(*command, "source.needs=camera", "session.out=out")
    assert done.code == 0, done.err
    frame = json.loads(Path("out/holes.json").read_text())["frames"][0]
    x, y, z = K @ CENTER
    away_px = [np.hypot(one["x"] - x / z, one["y"] - y / z) for one in frame["ellipses"]]
    assert min(away_px) < 2.0 and frame["holes"] == []
    refused = brokk(*command, "perception=truth", "session.out=no")
    assert refused.code == 2 and "expected perception=plane_conic" in refused.err


def test_a_finder_that_only_finds_holes_is_enough(folder: Path, brokk: Callable) -> None:
    done = brokk("mode=perceive", f"perceive.input={folder}", "perception=truth", "session.out=out")
    assert done.code == 0, done.err
    frames = json.loads(Path("out/holes.json").read_text())["frames"]
    assert [len(frame["holes"]) for frame in (frames[0], frames[2])] == [1, 1]
    assert frames[0]["holes"][0]["center_m"] == [2.6, 0.0, 0.4]
    assert Path("out/overlays/00000.png").exists()
