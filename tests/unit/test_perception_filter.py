"""The filter averages what agrees, leaves out what does not, and knows when it is blind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from composed import option

from brokk_rl.contracts.vision import HolePose
from brokk_rl.errors import ConfigError
from perception.calibrate import transforms


def seen(center: tuple[float, float, float], std_m: float = 0.002, t_s: float = 0.0) -> HolePose:
    up = np.array([0.0, 0.0, 1.0])
    return HolePose(
        np.array(center), up, 0.05, np.eye(3) * std_m**2, np.diag([1e-4, 1e-4, 0]), "base", 0.8, t_s
    )


def test_a_target_needs_frames_that_agree() -> None:
    track = option("perception/filter", "fusion").build()
    targets = [track.update([seen((2, 0, 0.4))], 0.1 * k) for k in range(3)]
    assert targets[0] is None and targets[1] is None
    assert targets[2] is not None and targets[2].num_frames == 3


def test_averaging_takes_noise_away_but_not_the_floor() -> None:
    spec = replace(option("perception/filter", "fusion"), drift_m=0.0)
    track, generator = spec.build(), np.random.default_rng(0)
    target = None
    for k in range(50):
        target = track.update(
            [seen(tuple(np.array([2, 0, 0.4]) + generator.normal(0, 0.002, 3)))], 0.1 * k
        )
    assert target is not None
    assert np.linalg.norm(target.pose.center_m - [2, 0, 0.4]) < 0.0015
    assert np.diag(target.pose.cov_m2) == pytest.approx(spec.floor_m**2 + 0.002**2 / 50, rel=0.05)


def test_a_camera_that_may_stand_elsewhere_makes_the_target_as_uncertain_however_many_frames_there_are() -> (
    None
):
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0.1, 0.2, 1.5]
    cov = np.diag([0.002, 0.001, 0.003, 0.0005, 0.001, 0.0008]) ** 2
    inside = replace(
        seen((0.3, -0.2, 2.5), 1e-6),
        frame="camera",
        axis=np.array([0.0, -0.6, -0.8]),
        axis_cov_rad2=np.zeros((3, 3)),
    )
    pose, generator = inside.moved(camera, cov), np.random.default_rng(0)
    steps = generator.multivariate_normal(np.zeros(6), cov, 20_000)
    moved = [
        inside.moved(transforms.apply_motion(camera, step)) for step in steps
    ]  # as if the camera really stood there
    spread, turned = (
        np.cov(np.array([getattr(one, name) for one in moved]).T) for name in ("center_m", "axis")
    )
    np.testing.assert_allclose(pose.cov_m2, spread, atol=0.03 * np.trace(spread))
    np.testing.assert_allclose(pose.axis_cov_rad2, turned, atol=0.03 * np.trace(turned))

    spec = replace(option("perception/filter", "fusion"), drift_m=0.0, floor_m=0.0)
    track, noise = spec.build(), np.eye(3) * 0.002**2
    for k in range(20):
        target = track.update([replace(pose, cov_m2=pose.cov_m2 + noise)], 0.1 * k)
    assert target is not None and pose.shared_m2 is not None
    np.testing.assert_allclose(
        target.pose.cov_m2, pose.shared_m2 + noise / 20, rtol=1e-3, atol=1e-9
    )


def test_an_outlier_moves_nothing() -> None:
    track = option("perception/filter", "fusion").build()
    for k in range(5):
        track.update([seen((2, 0, 0.4))], 0.1 * k)
    target = track.update([seen((2.1, 0, 0.4))], 0.6)
    assert target is not None
    assert target.pose.center_m == pytest.approx([2, 0, 0.4])
    assert target.age_s == pytest.approx(0.2)


def test_a_target_that_nobody_sees_becomes_stale_and_is_forgotten() -> None:
    spec = option("perception/filter", "fusion")
    track = spec.build()
    for k in range(3):
        target = track.update([seen((2, 0, 0.4))], 0.1 * k)
    assert target is not None and not target.stale
    known = np.trace(target.pose.cov_m2)
    target = track.update([], 0.2 + 1.01 * spec.stale_s)
    assert target is not None and target.stale
    assert np.trace(target.pose.cov_m2) > known
    assert track.update([], 0.3 + spec.forget_s) is None


def test_absurd_times_are_refused() -> None:
    with pytest.raises(ConfigError, match="stale_s"):
        replace(option("perception/filter", "fusion"), stale_s=60.0)
