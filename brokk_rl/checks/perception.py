"""Checker of borehole finders."""

from __future__ import annotations

import numpy as np

from brokk_rl.checks.exercise import require
from brokk_rl.contracts.vision import FinderSpec
from brokk_rl.signals import Frame


def check_finder(backend: FinderSpec) -> None:
    """Checks what `PerceptionBackend.build` returns against `BoreholeFinder`, on a frame of noise and on one without depth."""
    finder = backend.build()
    generator = np.random.default_rng(0)
    color = generator.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    noise = generator.uniform(1.0, 4.0, (120, 160)).astype(np.float32)
    camera_matrix = np.array([[140.0, 0.0, 80.0], [0.0, 140.0, 60.0], [0.0, 0.0, 1.0]])
    for depth_m in (noise, np.full_like(noise, np.nan)):
        frame = Frame(
            color=color.copy(),
            depth_m=depth_m.copy(),
            camera_matrix=camera_matrix,
            base_from_camera=np.eye(4),
            t_s=0.0,
        )
        found, again = finder.find(frame), finder.find(frame)
        require(
            np.array_equal(frame.color, color)
            and np.array_equal(frame.depth_m, depth_m, equal_nan=True),
            "find: changed the frame",
        )
        require((found is None) == (again is None), "find: the same frame gives another answer")
        if found is None or again is None:
            continue
        center, axis, covariance = (
            np.asarray(v) for v in (found.center_in_base_m, found.axis_in_base, found.cov_m2)
        )
        require(
            np.array_equal(center, again.center_in_base_m),
            "find: the same frame gives another answer",
        )
        require(
            center.shape == (3,) and bool(np.isfinite(center).all()),
            f"find: centre {center} is no point",
        )
        require(
            axis.shape == (3,) and abs(float(np.linalg.norm(axis)) - 1.0) < 1e-5,
            f"find: axis {axis} is not a unit vector",
        )
        require(found.radius_m > 0, f"find: radius {found.radius_m}")
        require(
            covariance.shape == (3, 3) and np.allclose(covariance, covariance.T),
            "find: cov_m2 is not symmetric",
        )
        require(
            bool((np.linalg.eigvalsh(covariance) >= -1e-12).all()),
            "find: cov_m2 has negative variances",
        )
