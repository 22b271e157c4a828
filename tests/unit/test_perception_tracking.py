"""The tracker averages what agrees, keeps names, forgets, and never averages a shared error away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brokk_rl.contracts.vision import HolePose
from brokk_rl.extensions import load_part
from perception.calibrate import transforms

FUSION = replace(load_part("tracker"), drift_m_sqrt_s=0.0)
"""A base that does not move: what is averaged can be worked out by hand."""
UP = np.array([0.0, 0.0, 1.0])


def detect(
    center_m: tuple[float, float, float], std_m: float = 0.004, score: float = 0.8
) -> HolePose:
    cov = np.eye(3) * std_m**2
    return HolePose(np.array(center_m), UP, 0.05, cov, np.diag([1e-4, 1e-4, 0]), "base", score, 0.0)


def test_a_hole_is_confirmed_by_enough_detections() -> None:
    tracker = FUSION.build()
    found = [tracker.update([detect((2, 0, 0.4))], 0.1 * number)[0] for number in range(3)]
    assert FUSION.confirm == 3
    assert [(one.num_frames, one.confirmed) for one in found] == [(1, False), (2, False), (3, True)]


def test_holes_keep_their_names_are_averaged_by_variance_and_forgotten() -> None:
    tracker = replace(FUSION, forget_s=10.0).build()
    tracker.update([detect((2.6, 0, 0.75), 0.004), detect((2.2, 0.4, 0.75))], 1.0)
    first, second = tracker.update([detect((2.2, 0.4, 0.75)), detect((2.61, 0, 0.75), 0.008)], 2.0)
    assert (first.name, second.name) == (1, 2)
    # four times the variance, a fifth of the weight
    assert first.pose.center_m[0] == pytest.approx(2.6 + 0.01 / 5, abs=1e-9)
    assert first.std_m == pytest.approx(0.004 * np.sqrt(0.8), abs=1e-9)
    assert [one.name for one in tracker.update([detect((2.6, 0, 0.75))], 11.9)] == [1, 2]
    # the second was not seen for more than 10 s
    assert [one.name for one in tracker.update([detect((2.9, -0.4, 0.75))], 12.5)] == [1, 3]


def test_a_direction_that_is_measured_badly_stays_the_worst() -> None:
    cov = np.diag([0.001, 0.001, 0.004]) ** 2
    tracker = FUSION.build()
    for number in range(4):
        (hole,) = tracker.update([replace(detect((2, 0, 0.4)), cov_m2=cov)], 0.1 * number)
    np.testing.assert_allclose(hole.pose.cov_m2, cov / 4)
    assert hole.std_m**2 == pytest.approx(np.trace(hole.pose.cov_m2) / 3)


def test_a_base_that_moved_is_noticed_within_a_few_detections() -> None:
    tracker = FUSION.build()
    for number in range(200):
        (hole,) = tracker.update([detect((2.6, 0, 0.75), 0.002)], 0.1 * number)
    # As sure as its memory and the newest detection make it, and no surer.
    assert np.diag(hole.pose.cov_m2) == pytest.approx(0.002**2 / (FUSION.memory + 1))
    for number in range(30):
        (hole,) = tracker.update([detect((2.65, 0, 0.75), 0.002)], 20.0 + 0.1 * number)
    assert hole.pose.center_m[0] > 2.645


def test_the_error_of_the_calibration_is_never_averaged_away() -> None:
    shared_m2 = 0.003**2 * np.eye(3)
    calibrated = detect((2.6, 0, 0.75), 0.004)
    calibrated = replace(calibrated, cov_m2=calibrated.cov_m2 + shared_m2, shared_m2=shared_m2)
    tracker = FUSION.build()
    for number in range(4):
        (hole,) = tracker.update([calibrated], float(number))
    # of its own 4 mm, over four frames 2 mm; of the calibration 3 mm, in all of them: sqrt(4 + 9)
    assert hole.std_m == pytest.approx(0.001 * np.sqrt(13.0), abs=1e-9)
    np.testing.assert_allclose(hole.pose.cov_m2, 13e-6 * np.eye(3))
    surer = detect((2.605, 0, 0.75), 0.002)
    surer = replace(surer, cov_m2=surer.cov_m2 + shared_m2, shared_m2=shared_m2)
    # 2 mm of its own, as what is known: half way
    (hole,) = tracker.update([surer], 4.0)
    assert hole.pose.center_m[0] == pytest.approx(2.6025, abs=1e-9)


def test_the_shared_covariance_is_what_a_displaced_camera_does() -> None:
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0.1, 0.2, 1.5]
    cov = np.diag([0.002, 0.001, 0.003, 0.0005, 0.001, 0.0008]) ** 2
    axis = {"axis": np.array([0.0, -0.6, -0.8]), "axis_cov_rad2": np.zeros((3, 3))}
    inside = replace(detect((0.3, -0.2, 2.5), 1e-6), frame="camera", **axis)
    pose, generator = inside.moved(camera, cov), np.random.default_rng(0)
    steps = generator.multivariate_normal(np.zeros(6), cov, 20_000)
    # as if the camera really stood there
    moved = [inside.moved(transforms.apply_motion(camera, step)) for step in steps]
    spread = np.cov(np.array([one.center_m for one in moved]).T)
    turned = np.cov(np.array([one.axis for one in moved]).T)
    np.testing.assert_allclose(pose.cov_m2, spread, atol=0.03 * np.trace(spread))
    np.testing.assert_allclose(pose.axis_cov_rad2, turned, atol=0.03 * np.trace(turned))

    tracker, noise = replace(FUSION, memory=1000).build(), np.eye(3) * 0.002**2
    for number in range(20):
        (hole,) = tracker.update([replace(pose, cov_m2=pose.cov_m2 + noise)], 0.1 * number)
    np.testing.assert_allclose(hole.pose.cov_m2, pose.shared_m2 + noise / 20, rtol=1e-3, atol=1e-9)


def test_another_hole_moves_nothing() -> None:
    tracker = FUSION.build()
    for number in range(5):
        tracker.update([detect((2, 0, 0.4))], 0.1 * number)
    far, *_ = tracker.update([detect((2.0 + 1.01 * FUSION.near_m, 0, 0.4))], 0.6)
    assert far.pose.center_m == pytest.approx([2, 0, 0.4])
    assert far.seen_s == pytest.approx(0.4)


def test_a_hole_that_nobody_sees_becomes_stale_and_is_forgotten() -> None:
    tracker = FUSION.build()
    (hole,) = tracker.update([detect((2, 0, 0.4))], 0.2)
    assert not hole.stale
    (hole,) = tracker.update([], 0.2 + 1.01 * FUSION.stale_s)
    assert hole.stale
    assert tracker.update([], 0.3 + FUSION.forget_s) == []


def test_what_is_not_seen_ages_and_is_corrected_when_it_is_seen_again() -> None:
    fusion = replace(load_part("tracker"), drift_m_sqrt_s=0.001)
    pose = detect((2.6, 0.0, 0.75), 0.001)
    tracker = fusion.build()
    tracker.update([pose], 0.0)
    (hole,) = tracker.update([], 8.0)
    # a random walk: 1 mm² of its own, 1 mm² more in each second
    assert hole.std_m == pytest.approx(0.003)
    np.testing.assert_allclose(hole.pose.cov_m2, 9e-6 * np.eye(3))
    moved = replace(pose, center_m=np.array([2.61, 0.0, 0.75]))
    (hole,) = tracker.update([moved], 8.0)
    # weights 1 to 9
    assert hole.pose.center_m[0] == pytest.approx(2.609)
    assert hole.std_m == pytest.approx(np.sqrt(0.9) * 0.001)
