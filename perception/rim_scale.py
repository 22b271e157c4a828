"""Scale of depth, asked of rims: a hole of known size is as large as its ellipse and depth say.

A wrong baseline, unit of depth or focal length makes every rim too large or too small by one
factor. The finder then finds nothing, since it searches rims of the right size alone.
"""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, Share, spec
from perception.ellipse import conic
from perception.ellipse.detector import ContourArcs

OF_PAIR = "size of dark rims over that of the holes, by the pair"
OF_DEPTH = "size of dark rims over that of the holes, by depth"
EXPLANATIONS = {
    OF_PAIR: (
        "no rim has the size of a hole, but dark ones have it by this factor. baseline_m is "
        "too large by it, or perception.radius_m too small."
    ),
    OF_DEPTH: (
        "no rim has the size of a hole, but dark ones have it by this factor. 10, 100 or 1000, "
        "or a part of it, is the unit of depth. Else K is too small by it (that of another "
        "resolution), or perception.radius_m."
    ),
}
"""Explanation and remedy for both reasons."""
RING = 1.25, 1.8
"""Radii of the ring around a rim in which its depth is read."""


@spec
class RimScale:
    """Compare the size of round, dark, whole rims with that of the holes.

    Attributes:
        width_px: Width of the picture in which rims of any size are searched.
        coverage: Least visible part of such a rim.
        darkness: Largest brightness inside over that of the ring around it.
        least: Factor on the size from which the scale is in doubt.
    """

    width_px: Count
    coverage: Share
    darkness: Share
    least: Annotated[float, Ge(1)]

    def measure_scale(
        self, frame: Frame, detector: ContourArcs, radius_m: float
    ) -> tuple[float, float] | None:
        """Return the size of the surest rim over that of the holes, and its score.

        Returns:
            `None` where nothing is in doubt.
        """
        shrink = max(1, round(frame.color.shape[1] / self.width_px))
        small = frame.color[::shrink, ::shrink]
        if shrink > 1:
            size = frame.color.shape[1] // shrink, frame.color.shape[0] // shrink
            small = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
        gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        depth_m = frame.depth_m[shrink // 2 :: shrink, shrink // 2 :: shrink]
        focal_px = float(frame.camera_matrix[0, 0]) / shrink
        for one in detector.detect(gray, None, None):
            ring_m = self._measure_depth(one, gray, depth_m)
            if one.coverage >= self.coverage and ring_m is not None:
                scale = one.a * ring_m / (focal_px * radius_m)
                return (scale, one.score) if abs(np.log(scale)) > np.log(self.least) else None
        return None

    def _measure_depth(self, one: Ellipse, gray: np.ndarray, depth_m: np.ndarray) -> float | None:
        """Return the depth around a rim, m; `None` for one that is not dark, or without depth."""
        shape = min(len(gray), len(depth_m)), min(len(gray[0]), len(depth_m[0]))
        row = conic.as_row(one)
        part = conic.bound_ellipse(row, RING[1] * one.a, shape)
        rows, columns = np.ogrid[part]
        radii = conic.measure_radii(row, columns, rows)
        ring = (radii > RING[0]) & (radii < RING[1])
        inside = radii < 0.8
        if not ring.any() or not inside.any():
            return None
        bright = float(np.median(gray[part][ring]))
        if float(np.median(gray[part][inside])) > self.darkness * bright:
            return None
        around_m = depth_m[part][ring]
        known_m = around_m[np.isfinite(around_m)]
        return float(np.median(known_m)) if len(known_m) > 0.5 * len(around_m) else None
