"""Quality of fit of ellipse candidates, and the tests that need nothing else."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from brokk_rl.contracts.vision import Ellipse
from perception.ellipse import conic
from perception.ellipse.edges import Edges
from perception.ellipse.support import STROKE_PX, EllipseCandidates

# Each of these times 0.8 or 1.25 left every count of 8 drawn patterns, 3 pictures of hidden discs and
# 6 negatives as it was.
SAME_AREA = 0.6
"""Least ratio of areas of the two edges of one thin line."""


@dataclass(frozen=True)
class CandidateFit:
    """Quality of fit of `C` candidates.

    Attributes:
        candidates: Ellipses and polarity.
        support: Number of the edge point at each place, `(C, NUM_SAMPLES)`, -1 for none.
        length: Arc length per radian at each place, `(C, NUM_SAMPLES)`.
        coverage: Part of the circumference with support, `(C,)`.
        off_px: Distance of the support at each place, `(C, NUM_SAMPLES)`.
        rms_px: Root mean square of these distances.
        spread_px: Robust standard deviation of these distances.
        spread_limit_px: Its limit.
        angle_rad: Robust standard deviation of the angles between gradient and normal.
        angle_limit_rad: Its limit.
    """

    candidates: EllipseCandidates
    support: np.ndarray
    length: np.ndarray
    coverage: np.ndarray
    off_px: np.ndarray
    rms_px: np.ndarray
    spread_px: np.ndarray
    spread_limit_px: np.ndarray
    angle_rad: np.ndarray
    angle_limit_rad: np.ndarray

    def __getitem__(self, keep: np.ndarray) -> CandidateFit:
        return CandidateFit(*(getattr(self, field.name)[keep] for field in fields(self)))


def measure_wholeness(coverage: np.ndarray) -> np.ndarray:
    """Return 1 at full coverage, falling to 0 at one half.

    A part of an ellipse must fit better than a whole one: the lobe of a heart nearly fits.
    """
    return np.clip(2 * coverage - 1, 0.0, 1.0)


def is_centre_inside(ellipses: np.ndarray, edges: Edges) -> np.ndarray:
    """Find ellipses with their centre in the picture, `(C,)`."""
    height, width = edges.nearest.shape
    x, y = ellipses[:, 0], ellipses[:, 1]
    return (x >= 0) & (y >= 0) & (x < width) & (y < height)


def is_other_side_of_line(row: np.ndarray, others: list[Ellipse]) -> bool:
    """Return whether an ellipse and one of the others are the two edges of a thin line."""
    for other in others:
        apart = np.abs(conic.as_row(other) - row)
        areas = row[2] * row[3], other.a * other.b
        is_near = apart[:2].max() < 0.5 * STROKE_PX and apart[2:4].max() < STROKE_PX
        if is_near and min(areas) > SAME_AREA * max(areas):
            return True
    return False
