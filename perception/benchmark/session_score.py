"""Score of a perceive run against the truth of its frames: rendered, or measured by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.contracts.vision import HolePose

NEAR_M = 0.05
"""A found hole belongs to the true one whose centre lies this near: a hole's radius."""


@dataclass(frozen=True)
class HoleError:
    """Error of one found hole.

    Attributes:
        frame: Name of the frame.
        distance_m: From the camera.
        position_m: Error of the centre.
        std_m: Its standard deviation as stated, the root of the covariance's trace.
        sigmas: Error in standard deviations as stated (Mahalanobis).
        normal_rad: Error of the axis.
    """

    frame: str
    distance_m: float
    position_m: float
    std_m: float
    sigmas: float
    normal_rad: float


def match_found_holes(
    name: str, found: Sequence[HolePose], true: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[list[HoleError], int]:
    """Return the errors of the found holes of one frame, and how many belong to none that is there.

    Args:
        name: Of the frame.
        found: Holes in the camera's coordinates.
        true: Centre and axis of each hole that could be found, in the same coordinates.
    """
    errors, left = [], list(found)
    for center_m, axis in true:
        best = min(left, key=lambda one: _measure_away_m(one, center_m), default=None)
        if best is None or _measure_away_m(best, center_m) > NEAR_M:
            continue
        left = [one for one in left if one is not best]
        away = best.center_m - center_m
        errors.append(
            HoleError(
                frame=name,
                distance_m=float(np.linalg.norm(center_m)),
                position_m=float(np.linalg.norm(away)),
                std_m=float(np.sqrt(np.trace(best.cov_m2))),
                sigmas=float(np.sqrt(away @ np.linalg.pinv(best.cov_m2) @ away)),
                normal_rad=float(np.arccos(np.clip(np.dot(best.axis, axis), -1, 1))),
            )
        )
    return errors, len(left)


def _measure_away_m(hole: HolePose, center_m: np.ndarray) -> float:
    return float(np.linalg.norm(hole.center_m - center_m))
