"""Pairs that are not perfect: how they are rendered, noticed, and told in the covariance."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from composed import option
from drawn import K, as_color, drawn
from hydra.utils import instantiate
from omegaconf import OmegaConf

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from perception import pair_check
from perception.render.stereo_camera import MisalignedPinhole, PairMisalignment
from perception.segment.window import Window
from perception.stereo import PairDepth, Stereo

BASELINE_M, DEPTH_M = 0.12, 2.0


def test_a_misaligned_camera_is_the_one_of_opencv() -> None:
    shifts = {"offset_px": (0.25, -0.3), "distortion_px": 0.2, "seed": None}
    error = PairMisalignment(turn_rad=(2e-4, -3e-4, 5e-4), focal=4e-4, **shifts)
    camera = MisalignedPinhole(1920, 1080, 1056.0, np.array([0.12, 0.0, 0.0]), error)
    pixel = np.random.default_rng(0).uniform([0, 0], [1919, 1079], (200, 2))
    points = camera.origin_m + 3.0 * camera.rays(pixel).astype(float)
    into_camera = cv2.Rodrigues(np.array(error.turn_rad))[0].T
    matrix = camera.matrix.copy()
    matrix[:2, :2] *= 1.0 + error.focal
    matrix[:2, 2] += error.offset_px
    # a shift of `distortion_px` at half the width: x (1 + k r²) with r = 960 / 1056 there
    k = error.distortion_px / 960.0 * (1056.0 / 960.0) ** 2
    turn, shift = cv2.Rodrigues(into_camera)[0], -into_camera @ camera.origin_m
    seen, _ = cv2.projectPoints(points, turn, shift, matrix, np.array([k, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(seen[:, 0], pixel, atol=2e-3)


def pair(down_px: float, roll_rad: float, seed: int = 0) -> Frame:
    """Returns two pictures of a wall; the right one is shifted down and rolled about its middle."""
    grain = np.random.default_rng(seed).uniform(60, 200, (540, 960)).astype(np.float32)
    grain = cv2.GaussianBlur(grain, (0, 0), 2.0)
    matrix = np.array([[528.0, 0.0, 479.5], [0.0, 528.0, 269.5], [0.0, 0.0, 1.0]])
    disparity = 528.0 * BASELINE_M / DEPTH_M
    u, v = np.meshgrid(np.arange(960.0), np.arange(540.0))
    x, y = u - 479.5, v - 269.5 - down_px
    from_u = np.cos(roll_rad) * x + np.sin(roll_rad) * y + 479.5 + disparity
    from_v = -np.sin(roll_rad) * x + np.cos(roll_rad) * y + 269.5
    right = cv2.remap(
        grain, from_u.astype(np.float32), from_v.astype(np.float32), cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    noise = np.random.default_rng(seed + 1).normal(0, 1.5, (2, 540, 960))
    left, right = as_color(grain + noise[0]), as_color(right + noise[1])
    depth_m = np.full((540, 960), DEPTH_M, np.float32)
    return Frame(left, depth_m, matrix, None, 0.0, right=right, baseline_m=BASELINE_M)


def fault(frame: Frame) -> str | None:
    found = load_part("pair_check").find_fault(frame)
    return None if found is None else found.reason


def test_pitch_and_roll_of_a_pair_are_measured() -> None:
    roll_rad = np.radians(0.05)
    check = load_part("pair_check")

    def measure(frame: Frame) -> pair_check.PairAlignment:
        matches = check.match_features(frame.color, frame.right)
        return pair_check.fit_alignment(matches, frame, check.alike)

    found = measure(pair(0.4, roll_rad))
    # 0.4 px in the middle and at the border: 1 + y² is 1.09 on average
    assert found.numbers_px[0] == pytest.approx(0.4 / 1.09, abs=0.03)
    # registration begins without a shift, and comes out up to an eighth short
    assert found.numbers_px[1] == pytest.approx(528.0 * roll_rad, rel=0.125)
    assert found.numbers_px[2] == pytest.approx(0.0, abs=0.04)
    assert measure(pair(0.0, 0.0)).rms_px < 0.02


def test_a_good_pair_of_a_repeated_pattern_is_not_refused() -> None:
    rows, columns = np.mgrid[0:540, 0:960].astype(float)

    def draw_chessboard(shift_px: float, seed: int) -> np.ndarray:
        x, y = (columns + shift_px - 250.0) / 40.0, (rows - 80.0) / 40.0
        x, y = x + 0.05 * y, y - 0.05 * x
        on = (x > 0) & (x < 12) & (y > 0) & (y < 9)
        gray = np.where(on, 60 + 140 * ((np.floor(x) + np.floor(y)) % 2), 130.0)
        noise = np.random.default_rng(seed).normal(0, 4.0, gray.shape)
        return as_color(cv2.GaussianBlur(gray, (0, 0), 1.0) + noise)

    disparity_px = 528.0 * BASELINE_M / DEPTH_M
    left, right = draw_chessboard(0.0, 1), draw_chessboard(disparity_px, 2)
    assert fault(replace(pair(0.0, 0.0), color=left, right=right)) is None


def turn(frame: Frame, quarters: int) -> Frame:
    """Returns a frame whose pictures are turned, with a camera matrix of their own."""
    matrix = frame.camera_matrix.copy()
    matrix[:2, 2] = matrix[[1, 0], 2]
    return replace(
        frame, camera_matrix=matrix,
        color=np.ascontiguousarray(np.rot90(frame.color, quarters)),
        right=np.ascontiguousarray(np.rot90(frame.right, quarters)),
        depth_m=np.ascontiguousarray(np.rot90(frame.depth_m, quarters)),
    )  # fmt: skip


def test_every_slip_of_a_pair_has_its_name() -> None:
    good = pair(0.0, 0.0)
    blank = np.full_like(good.color, 128)
    unknown = replace(good, depth_m=np.full_like(good.depth_m, np.nan))
    assert fault(good) is None
    assert fault(unknown) is None
    assert fault(replace(good, right=None)) is None
    assert fault(replace(good, color=good.right, right=good.color)) == pair_check.ORDER
    assert fault(turn(good, 1)) == pair_check.TURN
    # raw lenses: rows are apart, or one camera is rolled; depth is unknown where it is worst
    assert fault(replace(unknown, right=pair(11.0, 0.0).right)) == pair_check.ROWS
    assert fault(replace(unknown, right=pair(0.0, 0.01).right)) == pair_check.ROWS
    assert fault(replace(good, color=blank, right=blank)) == pair_check.FEW
    assert fault(replace(good, depth_m=0.1 * good.depth_m)) == pair_check.SCALE
    assert fault(replace(good, baseline_m=0.063)) == pair_check.SCALE
    assert fault(replace(unknown, baseline_m=12.0)) == pair_check.RANGE


def test_a_pair_that_is_not_rectified_is_refused_and_calibration_is_asked_for() -> None:
    finder = option("perception", "plane_conic").build()
    found = finder.find(pair(0.4, 0.0))
    assert not found.holes
    (refused,) = found.rejected
    assert refused.stage == "frame"
    assert refused.value > refused.limit
    assert "calibrate the camera pair" in finder.explain(refused)


def test_a_pair_once_found_good_stays_good_where_nothing_can_be_told() -> None:
    watch = replace(load_part("pair_check"), every=1).build()
    good = pair(0.0, 0.0)
    blank = replace(good, color=np.full_like(good.color, 128), right=np.full_like(good.color, 128))
    assert watch.find_fault(blank) is not None
    assert watch.find_fault(good) is None
    assert watch.find_fault(blank) is None
    other = replace(blank, camera_matrix=1.1 * blank.camera_matrix)
    assert watch.find_fault(other) is not None


def test_the_shared_covariance_is_what_a_wrong_disparity_does() -> None:
    estimator = option("perception/pose", "plane_conic").build()
    frame, masks, ellipse = drawn()
    pull_px, std_px = K[0, 0] * BASELINE_M, 0.25
    frame = replace(frame, baseline_m=BASELINE_M)
    plain = estimator.estimate(replace(frame, disparity_std_px=0.0), masks, ellipse)
    told = estimator.estimate(replace(frame, disparity_std_px=std_px), masks, ellipse)
    assert plain.shared_m2 is None
    np.testing.assert_allclose(told.cov_m2 - plain.cov_m2, told.shared_m2, atol=1e-15)
    rows, columns = np.mgrid[0:480, 0:640]
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    moved_m2, turned_rad2 = np.zeros((3, 3)), np.zeros((3, 3))
    for pattern in (np.ones_like(x), x, y):
        disparity = pull_px / frame.depth_m + std_px * pattern
        depth_m = (pull_px / disparity).astype(np.float32)
        wrong = replace(frame, depth_m=depth_m, disparity_std_px=0.0)
        pose = estimator.estimate(wrong, masks, ellipse)
        moved_m2 += np.outer(pose.center_m - plain.center_m, pose.center_m - plain.center_m)
        turned_rad2 += np.outer(pose.axis - plain.axis, pose.axis - plain.axis)
    # relative to the largest entry: the circle on the plane moves a little with it
    np.testing.assert_allclose(told.shared_m2, moved_m2, atol=0.06 * moved_m2.max())
    np.testing.assert_allclose(told.shared_rad2, turned_rad2, atol=0.06 * turned_rad2.max())


FOCAL_PX = 1056.0
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
