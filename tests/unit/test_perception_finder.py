"""The finder puts the stages together, keeps every refusal, and its figures are counted right."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from composed import option
from conftest import Brokk
from drawn import AXIS, CENTER, K, as_color, both_views, drawn

from brokk_rl.contracts.vision import Ellipse, HolePose, Masks
from perception import dataset, pair_check, search
from perception.camera import CameraModel, write_camera
from perception.contracts import SizePrior
from perception.finder import StagedFinder, rectify


def finder_with(masks: Masks) -> StagedFinder:
    """Returns the default finder with a segmenter that always says the same."""
    segmenter = SimpleNamespace(build=lambda: SimpleNamespace(segment=lambda frame: masks))
    return replace(option("perception", "plane_conic"), segmenter=segmenter).build()


def test_the_base_frame_is_where_the_camera_is_said_to_be() -> None:
    frame, masks, _ = drawn()
    moved = np.eye(4)
    moved[:3, 3] = 1.0, 2.0, 3.0
    (hole,) = finder_with(masks).find(replace(frame, base_from_camera=moved)).holes
    assert hole.frame == "base"
    assert hole.center_m == pytest.approx(CENTER + moved[:3, 3], abs=1e-3)
    (hole,) = finder_with(masks).find(replace(frame, base_from_camera=None)).holes
    assert hole.frame == "camera"
    assert hole.center_m == pytest.approx(CENTER, abs=1e-3)


def test_without_a_block_nothing_is_looked_at_and_it_is_said() -> None:
    frame, masks, _ = drawn()
    found = finder_with(Masks(np.zeros_like(masks.block), None)).find(frame)
    assert not found.holes and found.rejected[0].stage == "segment"


@pytest.mark.parametrize("factor", [0.5, 2.0, 10.0])
def test_depth_of_a_wrong_scale_is_named_by_its_factor(factor: float) -> None:
    frame, masks, _ = drawn()
    wrong = replace(frame, depth_m=(factor * frame.depth_m).astype(np.float32))
    finder = finder_with(masks)
    found = finder.find(wrong)
    assert not found.holes
    (named,) = [one for one in found.rejected if one.reason == pair_check.OF_DEPTH]
    assert named.value == pytest.approx(factor, rel=0.1)
    assert "unit of depth" in finder.explain(named)
    assert not any(one.reason == pair_check.OF_DEPTH for one in finder.find(frame).rejected)


@pytest.mark.parametrize(("score", "is_kept"), [(0.3, False), (0.9, True)])
def test_a_rim_of_another_size_outweighs_holes_that_are_less_sure(
    score: float, is_kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, masks, _ = drawn()
    hole = HolePose(CENTER, AXIS, 0.05, np.eye(3), np.eye(3), "camera", score, 0.0)
    estimator = SimpleNamespace(estimate=lambda *seen: hole)
    settings = replace(finder_with(masks).settings, size_slack=2.0)
    monkeypatch.setattr(type(settings.pose), "build", lambda pose: estimator)
    doubled = replace(frame, depth_m=(2.0 * frame.depth_m).astype(np.float32))
    found = settings.build().find(doubled)
    assert bool(found.holes) == is_kept
    assert any(one.reason == pair_check.OF_DEPTH for one in found.rejected) != is_kept


def test_a_pair_without_depth_is_matched_and_its_hole_is_where_it_is() -> None:
    frame, masks, _ = drawn()
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    views = both_views(AXIS / (AXIS @ CENTER), K[0, 0] * 0.12, np.random.default_rng(5))
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(float)
    shift = K[0, 0] * 0.12 / frame.depth_m
    place = (u + shift).astype(np.float32), v.astype(np.float32)
    moved = cv2.remap(gray.astype(np.float32), *place, 1)
    color, other = as_color(gray + 12 * views[0]), as_color(moved + 12 * views[1])
    nothing = np.full_like(frame.depth_m, np.nan)
    pair = replace(frame, color=color, right=other, baseline_m=0.12, depth_m=nothing)
    (hole,) = finder_with(masks).find(pair).holes
    assert hole.center_m == pytest.approx(CENTER, abs=4e-3)


def test_a_hole_is_where_it_is_through_a_lens_that_bends() -> None:
    frame, masks, _ = drawn()
    coefficients = np.array([-0.25, 0.05, 0.0, 0.0, 0.0])
    # A camera that is turned by 20 degrees shows the hole near its border, where a lens bends most.
    turn = cv2.Rodrigues(np.array([0.0, 0.35, 0.0]))[0]
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
    places = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    rays = cv2.convertPointsToHomogeneous(cv2.undistortPoints(places, K, coefficients))
    before = rays.reshape(480, 640, 3) @ turn
    pixels = (before / before[..., 2:] @ K.T).astype(np.float32)
    maps = pixels[..., 0], pixels[..., 1]
    depth_m = cv2.remap(frame.depth_m, *maps, cv2.INTER_NEAREST, borderValue=np.nan)
    bent = replace(
        frame,
        color=cv2.remap(frame.color, *maps, cv2.INTER_CUBIC),
        depth_m=(depth_m / before[..., 2]).astype(np.float32),
        distortion=coefficients,
    )
    (hole,) = finder_with(masks).find(bent).holes
    assert hole.center_m == pytest.approx(turn @ CENTER, abs=2e-3)
    # The same pictures without the numbers of their lens show it elsewhere, or not at all.
    wrong = finder_with(masks).find(replace(bent, distortion=None)).holes
    assert all(np.linalg.norm(one.center_m - turn @ CENTER) > 5e-3 for one in wrong)
    straight_m = rectify(bent).depth_m
    assert np.isin(straight_m[np.isfinite(straight_m)], bent.depth_m).all()


class Drawn:
    """An ellipse detector that always finds the same."""

    def __init__(self, ellipses: list[Ellipse]) -> None:
        self.ellipses = ellipses
        self.roi = np.empty((0, 0), bool)

    def detect(
        self, gray: np.ndarray, roi: np.ndarray | None, prior: SizePrior | None
    ) -> list[Ellipse]:
        """Returns them, and keeps where it was to look."""
        self.roi = self.roi if roi is None else roi
        return self.ellipses


def test_an_ellipse_that_is_too_large_where_it_lies_is_none() -> None:
    depth_m = np.full((480, 640), 2.0, np.float32)
    depth_m[:, 320:] = 3.2  # two faces: holes of 26 and 16 px
    matrix = np.array([[1056.0, 0, 319.5], [0, 1056.0, 239.5], [0, 0, 1]])
    frame = replace(drawn()[0], depth_m=depth_m, camera_matrix=matrix)
    one = Ellipse(150.0, 240.0, 25.0, 20.0, 0.0, rms_px=0.1, coverage=1.0, score=0.8)
    detector, missed = Drawn([one, replace(one, x=500.0)]), {}
    everywhere, gray = np.ones(depth_m.shape, bool), np.zeros(depth_m.shape, np.uint8)
    for level in search.plan_search_levels(frame, everywhere, 0.05, 0.35, 10.0):
        for found in level.detect(detector, gray):
            missed[found.x] = level.find_missed_limit(found)
    assert missed[150.0] is None
    # 16.5 px at 3.2 m, and a slack of 35 %
    assert missed[500.0] == pytest.approx(16.5 * 1.35, rel=1e-6)


def test_the_edge_of_what_stands_before_a_face_is_no_rim_and_beside_it_one_looks_closer() -> None:
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    mask = (columns > 120) & (columns < 520) & (rows > 80) & (rows < 400)
    inverse = 0.52 + 0.00005 * (columns - 320)  # a face that leans, on which a hole has 27 px
    arm = np.abs(rows - 300) < 40
    matrix = np.array([[1056.0, 0.0, 320.0], [0.0, 1056.0, 240.0], [0.0, 0.0, 1.0]])

    def looked(depth_m: np.ndarray) -> tuple[int, np.ndarray]:
        """Returns the finest resolution, and what of the whole one is looked at in it."""
        frame = replace(drawn()[0], depth_m=depth_m.astype(np.float32), camera_matrix=matrix)
        found = search.plan_search_levels(frame, mask, 0.05, 0.35, 6.5)
        level = min(found, key=lambda level: level.shrink)
        detector = Drawn([])
        level.detect(detector, np.zeros(mask.shape, np.uint8))
        where = np.zeros(mask.shape, bool)
        top, left = (np.flatnonzero(level.region.any(1 - k))[0] * search.STEP for k in (0, 1))
        part = np.kron(detector.roi, np.ones((level.shrink, level.shrink))) > 0
        part = part[: 480 - top, : 640 - left]
        where[top : top + part.shape[0], left : left + part.shape[1]] = part
        return level.shrink, where

    plain, everywhere = looked(1 / inverse)
    closer, beside = looked(np.where(arm, 1.5, 1 / inverse))
    assert everywhere[120:360, 160:480].all()
    assert closer < plain
    assert not beside[[260, 261, 262, 338, 339, 340]][:, 160:480].any()  # its edges
    assert beside[240:257, 160:480].all() and beside[344:360, 160:480].all()


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


def test_holes_overlays_and_refusals_are_written(folder: Path, brokk: Brokk) -> None:
    brokk(
        "mode=perceive", f"perceive.input={folder}", "session.out=out", "tracker.confirm=1",
    )  # fmt: skip
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


def test_ellipses_of_a_picture_need_no_depth(folder: Path, brokk: Brokk) -> None:
    for path in folder.glob("*.depth.npy"):
        path.unlink()
    command = ("mode=perceive", f"perceive.input={folder}", "perceive.until=ellipses")
    brokk(*command, "source.needs=camera", "session.out=out")
    frame = json.loads(Path("out/holes.json").read_text())["frames"][0]
    x, y, z = K @ CENTER
    away_px = [np.hypot(one["x"] - x / z, one["y"] - y / z) for one in frame["ellipses"]]
    assert min(away_px) < 2.0 and frame["holes"] == []
    refused = brokk(*command, "perception=truth", "session.out=no", code=2)
    assert "expected perception=plane_conic" in refused.err
