"""A rim with broken pieces: proposed from its region, and placed by the wall of the hole."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn import AXIS, CENTER, K, both_views, drawn

from perception.ellipse.conic import as_row as pose_row
from perception.pose import alignment, broken_rim, rim
from perception.pose.plane_conic import convert_to_gray

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
    return cv2.GaussianBlur(
        cv2.resize(picture, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), 0.7
    )


@pytest.mark.parametrize("broken", [0.0, 0.5, 0.8])
def test_the_centre_of_a_broken_rim_is_that_of_its_whole_pieces(broken: float) -> None:
    angle = np.linspace(0.0, 1.0, 360, endpoint=False)
    # four chips of 12 mm around the rim, of which a part is whole
    depths_m = 0.012 * np.maximum(np.sin(8 * np.pi * angle) - np.cos(np.pi * broken), 0.0)
    depths_m = depths_m * (broken > 0)
    chart = rim.build_chart(CENTER, M, K)
    start_m = np.array([0.012, -0.008])
    found = broken_rim.fit_broken_rim(draw_broken(depths_m), chart, None, start_m, 0.05, 0.024)
    assert found is not None
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
    color, right = (
        np.repeat(np.clip(120 + 60 * one, 0, 255).astype(np.uint8)[..., None], 3, 2)
        for one in views
    )
    frame = replace(frame, color=color, right=right, baseline_m=0.12)
    row = pose_row(ellipse)
    both = alignment.crop_pair(frame, convert_to_gray(frame), M, row, 4.0)
    chart = rim.build_chart(CENTER, M, K)
    profiles = rim.find_profile_edges(convert_to_gray(frame), row, 10.0, chart)
    assert both is not None and profiles is not None
    odds = broken_rim.compare_depths(both, chart, profiles, float(np.sqrt(row[2] * row[3])))
    assert broken_rim.DEPTHS_M[int(np.argmax(odds.sum(0)))] == pytest.approx(0.016, abs=2e-3)
