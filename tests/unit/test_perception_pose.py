"""Poses agree with the geometry they were drawn from, and what is no hole is refused for the right reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from composed import option
from drawn import AXIS, CENTER, RAYS, K, as_color, both_views, drawn

from brokk_rl.contracts.vision import Ellipse, HolePose, Masks, Rejection
from brokk_rl.signals import Frame
from perception.ellipse import conic
from perception.ellipse.conic import as_row as pose_row
from perception.pose import alignment, appearance, broken_rim, consistency, plane, rim
from perception.pose.appearance import IN_DUST
from perception.pose.consistency import FocalBelief, compute_focal_covariances
from perception.pose.plane import FacePlane
from perception.pose.plane_conic import convert_to_gray
from perception.pose.rim import build_chart

Drawn = tuple[Frame, Masks, Ellipse]


@pytest.fixture(scope="module")
def estimator():
    return option("perception/pose", "plane_conic").build()


def test_a_hole_is_where_it_was_drawn(estimator) -> None:
    pose = estimator.estimate(*drawn())
    # 0.3 px: the lit wall beyond the far rim blurs into it
    assert pose.center_m == pytest.approx(CENTER, abs=8e-4)
    assert pose.axis == pytest.approx(AXIS, abs=1e-3)
    assert pose.radius_m == pytest.approx(0.05, abs=6e-4)


def test_a_third_of_a_rim_that_is_hidden_is_not_missed(estimator) -> None:
    frame, masks, ellipse = drawn()
    color, depth_m = frame.color.copy(), frame.depth_m.copy()
    edge = int(ellipse.x + 0.35 * ellipse.a)
    color[:, edge:], depth_m[:, edge:] = 210, 0.5
    # an ellipse that takes the arm's edge for the rim
    hidden = replace(ellipse, x=ellipse.x - 1.5, a=ellipse.a - 1.5)
    pose = estimator.estimate(replace(frame, color=color, depth_m=depth_m), masks, hidden)
    assert pose.center_m == pytest.approx(CENTER, abs=1.5e-3)
    assert float(pose.axis @ AXIS) > np.cos(np.radians(0.2))


def test_a_tone_curve_moves_no_rim_and_changes_no_evidence_once_it_is_known(estimator) -> None:
    frame, masks, ellipse = drawn()
    plain = estimator.estimate(frame, masks, ellipse)
    coded = np.rint(255 * (frame.color / 255.0) ** (1 / 2.2)).astype(np.uint8)
    curved = replace(frame, color=coded, gamma=2.2)
    found = estimator.estimate(curved, masks, ellipse)
    taken_for_linear = estimator.estimate(replace(curved, gamma=1.0), masks, ellipse)
    assert found.center_m == pytest.approx(plain.center_m, abs=5e-5)
    assert found.radius_m == pytest.approx(plain.radius_m, abs=5e-5)
    assert taken_for_linear.radius_m < plain.radius_m - 2e-4, "edges move into the dark"
    face = plane.FacePlane(AXIS / (AXIS @ CENTER), np.eye(3) * 1e-6, 1e-4, 7.0)
    slopes = []
    for one in (frame, curved):
        gray = convert_to_gray(one)  # not linearised: the ratio of logarithms needs no exponent
        slopes.append(appearance.measure_interior(gray, one, pose_row(ellipse), face).slope)
    assert slopes[0] < -0.17 and slopes[1] == pytest.approx(slopes[0], rel=0.2)


def test_in_noise_a_face_is_aligned_without_bias_and_as_surely_as_is_claimed() -> None:
    generator = np.random.default_rng(4)
    frame, masks, ellipse = drawn()
    m, row, pull_px = AXIS / (AXIS @ CENTER), pose_row(ellipse), K[0, 0] * 0.12
    off, ray = 0.3 / pull_px, CENTER / CENTER[2]
    depth = (1.0 / (RAYS @ m + off)).astype(np.float32)
    start = m + np.array([0.0, 0.0, off])
    begin = plane.FacePlane(start, np.diag([1e-4, 1e-4, 1.0]), 0.5 / pull_px, 7.0)
    errors, claims = [], []
    for _ in range(16):
        views = both_views(m, pull_px, generator)
        # dust: grain of four grey levels, noise of six
        dusty = [120 + 16 * one + generator.normal(0, 6, one.shape) for one in views]
        color, partner = map(as_color, dusty)
        seen = replace(frame, color=color, right=partner, baseline_m=0.12, depth_m=depth)
        both = alignment.crop_pair(seen, convert_to_gray(seen), begin.m, row, begin.extent)
        found = alignment.align_plane(both, begin, seen, masks.block > 0.5, row, 1.25, 24)
        errors.append(float((found.m - m) @ ray) * pull_px)
        claims.append(float(np.sqrt(ray @ found.cov @ ray)) * pull_px)
    assert abs(np.mean(errors)) < 0.02, "of the 0.3 px that it began with"
    assert 0.6 < np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(claims))) < 1.5


def test_the_right_picture_mends_what_the_matcher_got_wrong_all_over_a_face() -> None:
    generator = np.random.default_rng(3)
    frame, masks, ellipse = drawn()
    m, row = AXIS / (AXIS @ CENTER), pose_row(ellipse)
    pull_px = K[0, 0] * 0.12
    left, right = both_views(m, pull_px, generator)
    color = as_color(120 + 60 * left)
    partner = as_color(0.9 * np.clip(120 + 60 * right, 0, 255) + 8)
    off = 0.1 / pull_px  # a tenth of a pixel
    noisy = RAYS @ m + off + generator.normal(0, 0.3, (480, 640)) / pull_px
    depth = (1.0 / noisy).astype(np.float32)
    frame = replace(frame, color=color, right=partner, baseline_m=0.12, depth_m=depth)
    allowed = masks.block > 0.5
    points = plane.collect_support(depth, allowed, K, row, 0.05, 1.25, 2.6, 7.0, 8000, 24)
    face = plane.fit_plane(points, (2.6, 7.0), 2e-4, generator)
    both = alignment.crop_pair(frame, convert_to_gray(frame), face.m, row, face.extent)
    face = replace(face, cov=face.cov + np.diag([0.0, 0.0, 1e-6]))
    mended = alignment.align_plane(both, face, frame, allowed, row, 1.25, 24)
    shifted = replace(frame, right=np.roll(partner, 7, 0))
    other = alignment.crop_pair(shifted, convert_to_gray(frame), face.m, row, face.extent)
    # rows that belong to others
    assert alignment.align_plane(other, face, shifted, allowed, row, 1.25, 24) is None
    ray = CENTER / CENTER[2]
    assert (face.m - m) @ ray == pytest.approx(off, rel=0.2)
    assert abs((mended.m - m) @ ray) < 0.2 * off
    assert float(mended.normal @ AXIS) > np.cos(np.radians(0.3))


def blind(frame: Frame, masks: Masks, ellipse: Ellipse) -> Drawn:
    return replace(frame, depth_m=np.full_like(frame.depth_m, np.nan)), masks, ellipse


def deny_mouth(frame: Frame, masks: Masks, ellipse: Ellipse) -> Drawn:
    return frame, replace(masks, hole_mask=np.zeros_like(masks.block)), ellipse


def stretch(frame: Frame, masks: Masks, ellipse: Ellipse) -> Drawn:
    return frame, masks, replace(ellipse, a=ellipse.a * 1.25, b=ellipse.b / 1.25)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda *_: drawn(radius_m=0.035), "radius"),
        (lambda *_: drawn(radius_m=0.07), "radius"),
        (lambda *_: drawn(depth_m=0.0), "evidence of depth"),
        (stretch, "axis ratio on the face"),
        (deny_mouth, "mouth probability inside"),
        (blind, "pixels of the face"),
    ],
)
def test_what_is_no_hole_of_this_kind_or_cannot_be_seen_is_refused_by_its_reason(
    spoil: Callable[..., Drawn], reason: str, estimator
) -> None:
    refused = estimator.estimate(*spoil(*drawn()))
    assert isinstance(refused, Rejection) and refused.reason.startswith(reason)


def draw_dust(color: np.ndarray) -> np.ndarray:
    """Return a picture with dust that leaves three tenths of the contrast, denser to the right."""
    airlight = 150.0 + 6.0 * np.linspace(-1.0, 1.0, color.shape[1])[None, :, None]
    return (0.3 * color.astype(float) + 0.7 * airlight).astype(np.uint8)


def test_in_dust_the_light_on_its_wall_tells_a_hole_from_a_flat_disc(estimator) -> None:
    hole, masks, ellipse = drawn()
    found = estimator.estimate(replace(hole, color=draw_dust(hole.color)), masks, ellipse)
    assert isinstance(found, HolePose) and found.score == pytest.approx(0.5 * ellipse.score)
    disc, masks, ellipse = drawn(depth_m=0.0)
    dusty = draw_dust(disc.color)
    refused = estimator.estimate(replace(disc, color=dusty), masks, ellipse)
    assert isinstance(refused, Rejection) and refused.reason == IN_DUST
    shaded = dusty.copy()
    shaded[int(ellipse.y + 4 * ellipse.a) :] //= 4  # something dark nearby: nothing lies over it
    stain = estimator.estimate(replace(disc, color=shaded), masks, ellipse)
    assert isinstance(stain, Rejection) and stain.reason == "brightness inside over outside"


def test_a_plane_among_gross_errors_is_as_uncertain_as_it_varies() -> None:
    chance = np.random.default_rng(3)
    true, sigmas = np.array([0.05, -0.1, 0.25]), []
    for _ in range(60):
        rays = np.column_stack([chance.uniform(-0.2, 0.2, (1500, 2)), np.ones(1500)])
        gross = chance.random(1500) < 0.3
        noise = np.where(gross, chance.uniform(-8e-3, 8e-3, 1500), chance.normal(0, 1e-3, 1500))
        radii = np.sort(chance.uniform(1.25, 12.0, 1500))
        points = plane.FaceSupport(rays, rays @ true + noise, radii, np.arange(1500) % 40)
        face = plane.fit_plane(points, (2.6, 4.0, 7.0, 12.0), 1e-4, np.random.default_rng(0))
        off = face.m - true
        sigmas.append(off @ np.linalg.solve(face.cov, off))
    # chi-squared with three degrees of freedom: its mean is 3, that of 60 within 0.95 in 3 sigma
    assert 1.8 < np.mean(sigmas) < 4.5
    assert max(sigmas) < 25.0


@pytest.mark.parametrize("arm", [True, False])
def test_an_arc_may_be_taken_for_a_smaller_rim_where_something_hides_the_rest(
    arm: bool, estimator
) -> None:
    frame, masks, ellipse = drawn()
    smaller = replace(ellipse, x=ellipse.x - 0.24 * ellipse.a, coverage=0.65)
    smaller = replace(smaller, a=0.75 * ellipse.a, b=0.75 * ellipse.b)
    if arm:
        color, depth_m = frame.color.copy(), frame.depth_m.copy()
        edge = int(ellipse.x + 0.4 * ellipse.a)
        color[:, edge:], depth_m[:, edge:] = 210, 0.5
        pose = estimator.estimate(replace(frame, color=color, depth_m=depth_m), masks, smaller)
        assert isinstance(pose, HolePose) and pose.radius_m == pytest.approx(0.05, abs=2e-3)
    else:
        refused = estimator.estimate(frame, masks, smaller)
        assert isinstance(refused, Rejection) and refused.reason == "radius, m"


@pytest.mark.parametrize("arm", [True, False])
def test_what_only_one_camera_sees_beside_an_arm_nobody_can_tell_from_a_disc(
    arm: bool, estimator
) -> None:
    frame, masks, ellipse = drawn()
    m, row, pull_px = AXIS / (AXIS @ CENTER), pose_row(ellipse), K[0, 0] * 0.12
    left, right = (120 + 60 * one for one in both_views(m, pull_px, np.random.default_rng(5)))
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
    left[conic.measure_radii(row, columns, rows) < 1] = 15  # a flat disc
    back = columns + pull_px * (RAYS @ m) / (1 - pull_px * m[0] / K[0, 0])
    right[conic.measure_radii(row, back, rows) < 1] = 15
    depth_m = (1.0 / (RAYS @ m)).astype(np.float32)
    if arm:  # from 5 px beside it on, 0.5 m away: 127 px of disparity where the face has 53
        edge = int(ellipse.x + ellipse.a + 5)
        left[:, edge : edge + 90] = 60
        right[:, edge - 127 : edge - 37] = 60
        depth_m[:, edge : edge + 90] = 0.5
        depth_m[:, edge - 74 : edge] = np.nan
    pair = {"color": as_color(left), "right": as_color(right), "baseline_m": 0.12}
    frame = replace(frame, **pair, depth_m=depth_m)
    found = estimator.estimate(frame, masks, ellipse)
    if arm:
        assert isinstance(found, HolePose) and found.score == pytest.approx(0.5 * ellipse.score)
    else:
        assert isinstance(found, Rejection) and found.reason == "evidence of depth inside"
        # no network overrules two cameras
        everywhere = replace(masks, hole_mask=np.ones_like(masks.block))
        learned = estimator.estimate(frame, everywhere, ellipse)
        assert isinstance(learned, Rejection) and learned.reason == found.reason


def test_points_on_a_line_or_of_one_patch_alone_determine_no_plane() -> None:
    generator, m = np.random.default_rng(5), np.array([0.1, 0.4, 0.7])
    line = np.column_stack([np.full(400, 0.25), np.linspace(-0.2, 0.2, 400), np.ones(400)])
    for rays in (line, np.ones((400, 3))):
        support = plane.FaceSupport(rays, rays @ m, np.full(400, 2.0), np.arange(400) // 20)
        assert plane.fit_plane(support, (2.6,), 2e-4, generator) is None
    rays = np.column_stack([generator.uniform(-0.1, 0.1, (400, 2)), np.ones(400)])
    # the rest agrees with nothing
    lonely = rays @ m + np.where(np.arange(400) < 240, 0.0, generator.uniform(1.0, 9.0, 400))
    cell = np.maximum(np.arange(400) - 240, 0) // 10
    support = plane.FaceSupport(rays, lonely, np.full(400, 2.0), cell)
    assert plane.fit_plane(support, (2.6,), 2e-4, generator) is None


def test_an_inside_that_is_nearer_than_its_face_is_no_hole(estimator) -> None:
    frame, masks, ellipse = drawn()
    rows, columns = np.mgrid[0:480, 0:640]
    inside = np.hypot(columns - ellipse.x, rows - ellipse.y) < 1.1 * ellipse.a
    near_m = np.where(inside, np.float32(CENTER[2] - 0.1), frame.depth_m)
    found = estimator.estimate(replace(frame, depth_m=near_m.astype(np.float32)), masks, ellipse)
    assert found.reason == consistency.NEARER and found.value > found.limit


def test_a_belt_below_a_block_is_not_its_face(estimator) -> None:
    frame, masks, ellipse = drawn()
    rows, columns = np.mgrid[0:480, 0:640]
    radii = np.hypot(columns - ellipse.x, rows - ellipse.y) / ellipse.a
    # a small block stands 4 cm before what a mask takes for its face, and is left out of the mask
    depth_m = np.where(radii < 2.4, frame.depth_m - 0.04, frame.depth_m).astype(np.float32)
    block = np.where(radii < 2.4, 0.0, masks.block).astype(np.float32)
    found = estimator.estimate(replace(frame, depth_m=depth_m), Masks(block, None), ellipse)
    assert isinstance(found, Rejection) or abs(found.center_m[2] - (CENTER[2] - 0.04)) < 0.004


@pytest.mark.parametrize("factor", [0.67, 1.1])
def test_a_focal_length_with_which_no_rim_is_round_is_refused_by_its_name(
    estimator, factor: float
) -> None:
    frame, masks, ellipse = drawn()
    wrong = K * [[factor], [factor], [1.0]]
    wrong[:2, 2] = K[:2, 2]
    # depth of a pair grows with the focal length that it is told
    stretched = replace(frame, camera_matrix=wrong, depth_m=frame.depth_m * np.float32(factor))
    found = estimator.estimate(stretched, masks, ellipse)
    assert found.reason == consistency.STRETCH
    assert found.value == pytest.approx(factor, rel=0.02)


@pytest.mark.parametrize("factor", [0.93, 1.13])
def test_a_baseline_by_which_a_rim_has_another_size_is_refused_by_its_factor(
    estimator, factor: float
) -> None:
    frame, masks, ellipse = drawn()
    scaled = replace(frame, depth_m=frame.depth_m * np.float32(factor))
    found = estimator.estimate(scaled, masks, ellipse)
    assert found.reason == consistency.SIZE
    assert found.value == pytest.approx(factor, rel=0.01)


M = AXIS / (AXIS @ CENTER)


def draw_broken(depths_m: np.ndarray) -> np.ndarray:
    """Returns a dark hole `(480, 640)` whose wall begins at these depths below the face, by angle."""
    chart = rim.build_chart(CENTER, M, K)
    angle = np.linspace(0.0, 2 * np.pi, len(depths_m), endpoint=False)
    circle = np.cos(angle)[:, None] * chart.first + np.sin(angle)[:, None] * chart.second
    # the axis points out of the hole
    points = CENTER + 0.05 * circle - depths_m[:, None] * AXIS
    pixels = points @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    picture = np.full((480 * 4, 640 * 4), 170, np.uint8)
    cv2.fillPoly(picture, [np.rint(4 * pixels + 1.5).astype(np.int32)], 25)
    small = cv2.resize(picture, (640, 480), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.7)


@pytest.mark.parametrize("broken", [0.0, 0.5, 0.8])
def test_the_centre_of_a_broken_rim_is_that_of_its_whole_pieces(broken: float) -> None:
    angle = np.linspace(0.0, 1.0, 360, endpoint=False)
    # four chips of 12 mm around the rim, of which a part is whole
    depths_m = 0.012 * np.maximum(np.sin(8 * np.pi * angle) - np.cos(np.pi * broken), 0.0)
    depths_m = depths_m * (broken > 0)
    chart = rim.build_chart(CENTER, M, K)
    start_m = np.array([0.012, -0.008])
    found = broken_rim.fit_broken_rim(draw_broken(depths_m), chart, None, start_m, 0.05, 0.024)
    assert found.coverage > 0.7
    off = found.center_m - CENTER
    assert np.linalg.norm(off) < 3e-3
    # the error is what is claimed, within three deviations
    claimed = np.sqrt(np.trace(found.cov_m2))
    assert np.linalg.norm(off) < 3.0 * claimed
    # without a right picture the depth of the breaks is unknown
    assert claimed < 6e-3


def test_the_depth_of_a_break_is_read_from_both_pictures() -> None:
    frame, _, ellipse = drawn()
    # all of the surroundings lie 16 mm below the face
    below = M / (1.0 + 0.016 * np.linalg.norm(M))
    views = both_views(below, K[0, 0] * 0.12, np.random.default_rng(5))
    color, right = (as_color(120 + 60 * one) for one in views)
    frame = replace(frame, color=color, right=right, baseline_m=0.12)
    row = pose_row(ellipse)
    both = alignment.crop_pair(frame, convert_to_gray(frame), M, row, 4.0)
    chart = rim.build_chart(CENTER, M, K)
    profiles = rim.find_profile_edges(convert_to_gray(frame), row, 10.0, chart)
    odds = broken_rim.compare_depths(both, chart, profiles, float(np.sqrt(row[2] * row[3])))
    assert broken_rim.DEPTHS_M[int(np.argmax(odds.sum(0)))] == pytest.approx(0.016, abs=2e-3)


DOUBT = option("perception/pose", "plane_conic").focal


def believe(factors: tuple[float, ...], is_same_rim: bool = False) -> FocalBelief:
    """Returns what rims with these factors leave, each measured to a hundredth."""
    belief = FocalBelief(DOUBT)
    belief.begin(drawn()[0])
    for number, factor in enumerate(factors):
        place = 0.0 if is_same_rim else 100.0 * number
        row = np.array([place, 200.0, 20.0, 15.0, 0.0])
        belief.learn(row, K, float(np.log(factor)), 0.01)
    return belief


def test_without_a_rim_a_focal_length_may_be_off_by_the_usual_slip() -> None:
    # The grid ends at three of these deviations.
    assert believe(()).std == pytest.approx(np.sqrt(DOUBT.wrong) * DOUBT.slip_std, rel=0.03)
    assert believe(()).find_slip() is None


def test_rims_that_agree_make_a_right_focal_length_surer() -> None:
    stds = [believe((1.0,) * number).std for number in (0, 1, 2, 4)]
    assert stds == sorted(stds, reverse=True)
    assert stds[-1] < 0.003
    assert believe((1.0,) * 4, is_same_rim=True).std > stds[-1]


def test_a_wrong_focal_length_is_covered_before_it_is_named_and_named_by_several_rims() -> None:
    once = believe((1.15,))
    assert once.find_slip() is None and 3.0 * once.std > np.log(1.15)
    assert believe((1.15, 1.14, 1.16)).find_slip() == pytest.approx(1.15, abs=0.01)
    gross = believe((1.0, 1.0, 1.3))
    assert gross.find_slip() is None and gross.std < 0.03


def test_another_camera_is_believed_anew_and_another_part_of_the_picture_is_not() -> None:
    belief, frame = believe((1.0,) * 4), drawn()[0]
    matrix = K.copy()
    matrix[0, 2] += 200.0
    belief.begin(replace(frame, camera_matrix=matrix))
    assert belief.std < 0.003
    belief.begin(replace(frame, camera_matrix=K * [[1.1], [1.1], [1.0]]))
    assert belief.std > 0.2


def test_the_covariance_of_a_hole_is_what_stretched_depth_does_to_it() -> None:
    std, m = 0.01, AXIS / (AXIS @ CENTER)
    shared_m2, shared_rad2 = compute_focal_covariances(CENTER, AXIS, std)
    longer = m / [1.0, 1.0, 1.0 + std]
    moved_m = CENTER * [1.0, 1.0, 1.0 + std] - CENTER
    turned = -longer / np.linalg.norm(longer) - AXIS
    np.testing.assert_allclose(shared_m2, np.outer(moved_m, moved_m), atol=1e-12)
    np.testing.assert_allclose(shared_rad2, np.outer(turned, turned), atol=2e-6)


def test_a_face_whose_tilt_is_wrong_stretches_a_rim_as_a_wrong_focal_length_does() -> None:
    tilt_rad, std_rad = 0.6, 0.01
    normal, across = np.array([0.0, -np.sin(tilt_rad), -np.cos(tilt_rad)]), np.eye(3)[0]
    m = normal / float(normal @ [0.0, 0.0, 2.0])
    # The plane of such a covariance turns about the axis across the slope by `std_rad`.
    moved = float(np.linalg.norm(m)) * std_rad * np.cross(across, normal)
    face = FacePlane(m, np.outer(moved, moved), 1e-4, 7.0)
    chart = build_chart(np.array([0.0, 0.0, 2.0]), m, K)
    # As it is seen, a rim is shorter by the cosine; on a steeper plane it is longer than it is wide.
    longer = np.cos(tilt_rad) / np.cos(tilt_rad + std_rad)
    by_focal = np.sqrt((longer**2 - np.cos(tilt_rad) ** 2) / np.sin(tilt_rad) ** 2)
    doubt = consistency.measure_tilt_doubt(chart, face)
    assert doubt == pytest.approx(np.log(by_focal), rel=0.03)
