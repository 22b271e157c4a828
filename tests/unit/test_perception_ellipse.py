"""Conics agree with points drawn by hand; the detector finds what is drawn and nothing else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_ellipses import count_matches, draw_negative, draw_pattern, overlap

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.extensions import load_part
from perception.contracts import SizePrior
from perception.ellipse import conic
from perception.pose.rim import build_chart

K = np.array([[1056.0, 0.0, 959.5], [0.0, 1056.0, 539.5], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def detector():
    return load_part("ellipse")


def rim(center: np.ndarray, axis: np.ndarray, radius_m: float) -> np.ndarray:
    """Returns pixels of the rim of a hole, `(100, 2)`, by projecting its points."""
    first = np.cross(axis, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)[:, None]
    points = center + radius_m * (np.cos(angle) * first + np.sin(angle) * np.cross(axis, first))
    seen = points @ K.T
    return seen[:, :2] / seen[:, 2:]


def test_a_fit_returns_the_ellipse_that_opencv_returns() -> None:
    turn = np.linspace(0, 4, 40)
    c, s = np.cos(0.7), np.sin(0.7)
    points = np.column_stack(
        [
            50 + 30 * c * np.cos(turn) - 12 * s * np.sin(turn),
            80 + 30 * s * np.cos(turn) + 12 * c * np.sin(turn),
        ]
    )
    found = conic.fit_ellipses(points[None], np.ones((1, 40)))[0]
    (x, y), axes, _ = cv2.fitEllipseDirect(points.astype(np.float32))
    assert found[:4] == pytest.approx([x, y, max(axes) / 2, min(axes) / 2], abs=1e-2)
    assert found == pytest.approx([50, 80, 30, 12, 0.7], abs=1e-6)


def test_points_on_a_line_are_no_ellipse() -> None:
    line = np.column_stack([np.arange(20.0), 2 * np.arange(20.0)])
    assert np.isnan(conic.fit_ellipses(line[None], np.ones((1, 20)))).all()


def test_a_rim_on_its_plane_is_the_circle_that_it_is() -> None:
    center, axis = np.array([0.2, 0.1, 2.0]), np.array([0.3, -0.5, -0.8])
    axis /= np.linalg.norm(axis)
    seen = conic.fit_ellipses(rim(center, axis, 0.05)[None], np.ones((1, 100)))[0]
    chart = build_chart(2.0 * center, axis / (axis @ center) / 2.0, K)
    x, y, *axes, _ = chart.flatten(seen)
    # On a plane twice as far everything is twice as large, and the centre is the chart's origin.
    assert [x, y] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert axes == pytest.approx([0.1, 0.1], abs=1e-9)


@pytest.mark.parametrize(
    ("condition", "recall"), [("dark", 0.98), ("haze", 0.98), ("noise_25", 0.9), ("blur", 0.95)]
)
def test_patterns_are_found_in_any_light(condition: str, recall: float, detector) -> None:
    picture, truth = draw_pattern(condition, 5)
    found = [row(one) for one in detector.detect(picture, None, None)]
    hits = count_matches(found, truth)
    assert hits >= recall * len(truth)
    assert hits >= 0.95 * len(found)


@pytest.mark.parametrize("kind", ["noise", "spiral", "squares"])
def test_nothing_is_found_where_nothing_is(kind: str, detector) -> None:
    assert not detector.detect(draw_negative(kind), None, None)


def test_a_line_is_one_ellipse_and_a_ring_two(detector) -> None:
    for width, number in ((2, 1), (12, 2)):
        picture = np.full((200, 240), 200, np.uint8)
        cv2.ellipse(picture, (120, 100), (70, 50), 20, 0, 360, 40, width, cv2.LINE_AA)
        assert len(detector.detect(picture, None, None)) == number


def test_a_round_end_is_no_ellipse_and_as_much_of_a_covered_disc_is(detector) -> None:
    for size in (14, 25, 40):
        gray = np.full((240, 320), 210, np.uint8)
        cv2.line(gray, (90, 120), (230, 150), 40, 2 * size, cv2.LINE_AA)
        assert not detector.detect(cv2.GaussianBlur(gray, (0, 0), 0.8), None, None)
        # Hides all but the end, which has sharp corners then.
        cv2.rectangle(gray, (90 + size // 8, 0), (319, 239), 120, -1)
        found = detector.detect(cv2.GaussianBlur(gray, (0, 0), 0.8), None, None)
        assert len(found) == 1 and np.hypot(found[0].x - 90, found[0].y - 120) < 1.5


def test_what_hides_half_of_a_disc_may_be_as_dark_and_as_wide(detector) -> None:
    gray = np.full((240, 320), 200, np.uint8)
    cv2.ellipse(gray, (100, 120), (30, 22), 0, 0, 360, 40, -1, cv2.LINE_AA)
    cv2.rectangle(gray, (100, 95), (136, 145), 70, -1)
    found = detector.detect(cv2.GaussianBlur(gray, (0, 0), 0.8), None, None)
    assert [overlap(row(one), np.array([100.0, 120, 30, 22, 0])) > 0.9 for one in found] == [True]


def test_centres_are_found_to_a_fraction_of_a_pixel(detector) -> None:
    large = np.full((800, 800), 190, np.uint8)
    cv2.ellipse(large, (403, 398), (200, 120), 30, 0, 360, 40, -1, cv2.LINE_AA)
    found = detector.detect(cv2.resize(large, (100, 100), interpolation=cv2.INTER_AREA), None, None)
    assert len(found) == 1
    assert [found[0].x, found[0].y] == pytest.approx(
        [(403 + 0.5) / 8 - 0.5, (398 + 0.5) / 8 - 0.5], abs=0.05
    )
    assert [found[0].a, found[0].b] == pytest.approx([25, 15], abs=0.3)


def test_a_size_prior_leaves_out_what_is_too_small_or_too_large(detector) -> None:
    picture = np.full((200, 300), 190, np.uint8)
    for x, radius in ((60, 10), (140, 25), (240, 50)):
        cv2.circle(picture, (x, 100), radius, 40, -1, cv2.LINE_AA)
    found = detector.detect(picture, None, SizePrior(20.0, 30.0))
    assert [round(one.x) for one in found] == [140]


def test_only_the_region_is_looked_at(detector) -> None:
    picture = np.full((120, 240), 190, np.uint8)
    for x in (60, 180):
        cv2.circle(picture, (x, 60), 20, 40, -1, cv2.LINE_AA)
    roi = np.zeros(picture.shape, bool)
    roi[:, 120:] = True
    assert [round(one.x) for one in detector.detect(picture, roi, None)] == [180]
    assert detector.detect(picture, np.zeros(picture.shape, bool), None) == []


def row(one: Ellipse) -> np.ndarray:
    return np.array([one.x, one.y, one.a, one.b, one.theta_rad])
