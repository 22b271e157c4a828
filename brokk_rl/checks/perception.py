"""Checker of borehole finders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brokk_rl.contracts.vision import BoreholeFinder, FinderSpec, FrameDetections, HolePose
from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame

HEIGHT_PX, WIDTH_PX = 120, 160
"""Size of the picture of a check, px. Chosen by hand: small is fast."""
UNIT_TOLERANCE = 1e-5
"""Largest departure of an axis' length from 1: that of float32."""
NEGATIVE_VARIANCE = -1e-12
"""Smallest eigenvalue of a covariance that rounding may leave, m² or rad²."""


def check_finder(finder_spec: FinderSpec) -> None:
    """Check a finder against `BoreholeFinder` on three synthetic frames.

    One frame shows a dark hole in a flat face, one shows noise, one has no depth. A finder need not
    find the hole. It must answer the way that `mode=perceive` and the camera process expect, with
    and without a known pose of the camera.

    Raises:
        AssertionError: a promise is broken; the message says which.
    """
    finder = finder_spec.build()
    assert callable(getattr(finder, "find", None)), "build: the finder has no method find(frame)"
    generator = np.random.default_rng(0)
    hole = _draw_hole(generator)
    noise = replace(
        hole,
        color=generator.integers(0, 255, hole.color.shape, dtype=np.uint8),
        depth_m=generator.uniform(1.0, 4.0, hole.depth_m.shape).astype(np.float32),
    )
    blind = replace(noise, depth_m=np.full_like(noise.depth_m, np.nan))
    for frame in (hole, noise, blind, replace(hole, base_from_camera=None)):
        _check_frame(finder, frame)


def _draw_hole(generator: np.random.Generator) -> Frame:
    """Return a frame of a dark disc of 0.05 m in a bright face 1 m away, without depth inside."""
    camera_matrix = np.array([[140.0, 0.0, 80.0], [0.0, 140.0, 60.0], [0.0, 0.0, 1.0]])
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    inside = np.hypot(columns - 80.0, rows - 60.0) < 7.0  # px: 140 px focal length, 0.05 m at 1 m
    gray = np.where(inside, 30, 180) + generator.integers(-3, 4, inside.shape)
    return Frame(
        color=np.repeat(gray[..., None], 3, 2).astype(np.uint8),
        depth_m=np.where(inside, np.nan, 1.0).astype(np.float32),
        camera_matrix=camera_matrix,
        base_from_camera=np.eye(4),
        t_s=0.0,
    )


def _check_frame(finder: BoreholeFinder, frame: Frame) -> None:
    """Call `find` twice on copies of a frame and check both answers."""
    copy = replace(frame, color=frame.color.copy(), depth_m=frame.depth_m.copy())
    found, again = _list_holes(finder, copy), _list_holes(finder, copy)
    assert np.array_equal(copy.color, frame.color), "find: changed the frame"
    is_kept = np.array_equal(copy.depth_m, frame.depth_m, equal_nan=True)
    assert is_kept, "find: changed the frame"
    assert len(found) == len(again), "find: the same frame gives another answer"
    for hole, same in zip(found, again, strict=True):
        _check_hole(hole)
        is_same = np.array_equal(hole.center_m, same.center_m)
        assert is_same, "find: the same frame gives another answer"
    scores = [hole.score for hole in found]
    is_sorted = scores == sorted(scores, reverse=True)
    assert is_sorted, f"find: the surest first, got scores {scores}"


def _list_holes(finder: BoreholeFinder, frame: Frame) -> list[HolePose]:
    """Return the holes that a finder sees, none where it refuses the frame."""
    try:
        found = finder.find(frame)
    except FrameError:
        return []
    kind = type(found).__name__
    text = f"find: expected FrameDetections (brokk_rl.contracts.vision), got {kind}"
    assert isinstance(found, FrameDetections), text
    return list(found.holes)


def _check_hole(hole: HolePose) -> None:
    center, axis = np.asarray(hole.center_m), np.asarray(hole.axis)
    is_point = center.shape == (3,) and bool(np.isfinite(center).all())
    assert is_point, f"find: centre {center} is no point"
    is_unit = axis.shape == (3,) and abs(float(np.linalg.norm(axis)) - 1.0) < UNIT_TOLERANCE
    assert is_unit, f"find: axis {axis} is not a unit vector"
    assert hole.radius_m > 0, f"find: radius {hole.radius_m}"
    assert 0 <= hole.score <= 1, f"find: score {hole.score}, expected 0 to 1"
    frame = hole.frame
    assert frame in ("camera", "base"), f"find: frame '{frame}', expected camera or base"
    for name in ("cov_m2", "axis_cov_rad2"):
        covariance = np.asarray(getattr(hole, name))
        is_symmetric = covariance.shape == (3, 3) and np.allclose(covariance, covariance.T)
        assert is_symmetric, f"find: {name} is not symmetric"
        smallest = float(np.linalg.eigvalsh(covariance).min())
        assert smallest >= NEGATIVE_VARIANCE, f"find: {name} has negative variances"
