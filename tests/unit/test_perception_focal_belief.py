"""A focal length is believed as far as rims show it: holes are stated no surer than that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from composed import option
from drawn import AXIS, CENTER, K, drawn

from perception.pose import consistency
from perception.pose.focal_belief import FocalBelief, compute_focal_covariances
from perception.pose.plane import FacePlane
from perception.pose.rim import build_chart

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
