"""Matching in parts and resolutions, on pairs whose disparity is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.signals import Frame
from perception.pair_depth import PairDepth
from perception.segment.window import Window
from perception.stereo import Stereo

FOCAL_PX, BASELINE_M = 1056.0, 0.12
PULL_PX = FOCAL_PX * BASELINE_M
HEIGHT, WIDTH = 240, 480
SLANT = 30.0 + 0.02 * np.arange(WIDTH, dtype=np.float32)[None, :].repeat(HEIGHT, 0)
"""Disparity of a slanted face at about 4 m, px."""


@pytest.fixture(scope="module")
def stereo() -> Stereo:
    return instantiate(OmegaConf.load("conf/stereo.yaml"))


def make_pair(disparity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a textured right picture and the left one that it makes by a disparity, grey."""
    chance = np.random.default_rng(3)
    texture = cv2.GaussianBlur(chance.normal(0.0, 1.0, disparity.shape), (0, 0), 1.2)
    right = np.clip(128.0 + 40.0 * texture / texture.std(), 0, 255).astype(np.float32)
    columns, rows = np.meshgrid(*[np.arange(n, dtype=np.float32) for n in disparity.shape[::-1]])
    left = cv2.remap(right, columns - disparity, rows, cv2.INTER_CUBIC)
    return np.clip(left, 0, 255).astype(np.uint8), right.astype(np.uint8)


def make_frame(disparity: np.ndarray, coarse_px: np.ndarray, shrink: int) -> Frame:
    left, right = (cv2.cvtColor(some, cv2.COLOR_GRAY2RGB) for some in make_pair(disparity))
    matrix = np.array([[FOCAL_PX, 0.0, WIDTH / 2], [0.0, FOCAL_PX, HEIGHT / 2], [0.0, 0.0, 1.0]])
    depth_m = (PULL_PX / coarse_px).astype(np.float32)
    return Frame(
        left, depth_m, matrix, None, 0.0,
        right=right, baseline_m=BASELINE_M, depth_shrink=shrink,
    )  # fmt: skip


@pytest.mark.parametrize("shrink", [1, 2])
def test_a_part_in_a_band_is_matched_as_exactly_as_the_picture(stereo: Stereo, shrink: int) -> None:
    left, right = make_pair(SLANT)
    part = Window(200, 40, 161, 121)
    found = replace(stereo, shrink=shrink).match_part(left, right, part, 25.0, 45.0)
    assert found.shape == (121, 161)
    error = (found - SLANT[40:161, 200:361])[:, :-8]
    assert np.isfinite(error).mean() > 0.9
    assert np.nanmedian(np.abs(error)) < 0.1 * shrink


@pytest.mark.parametrize(("size_px", "shrink"), [(13.0, 1), (53.0, 4)])
def test_the_face_of_a_known_hole_is_matched_as_finely_as_it_needs(
    stereo: Stereo, size_px: float, shrink: int
) -> None:
    nothing = np.full_like(SLANT, np.nan)
    frame = make_frame(SLANT, nothing, 1)
    rise = np.array([SLANT[0, 1] - SLANT[0, 0], SLANT[1, 0] - SLANT[0, 0], SLANT[0, 0]])
    place = Ellipse(260.0, 120.0, size_px, size_px, 0.0, rms_px=0.0, coverage=1.0, score=1.0)
    matcher = PairDepth(stereo=stereo, radius_px=12.0, extent=3.0)
    seen, face = matcher.match_near(frame, place, frame.camera_matrix.T @ rise / PULL_PX)
    assert seen.depth_shrink == shrink
    near = np.s_[100:140, 240:280]
    assert np.nanmedian(np.abs(PULL_PX / seen.depth_m[near] - SLANT[near])) < 0.1 * shrink
    assert face[near].mean() > 0.9
    assert not np.isfinite(seen.depth_m[:, :90]).any() and not face[:, :90].any()
