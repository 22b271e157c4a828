"""Score of a perceive run against the truth of its frames: rendered, or measured by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

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


@dataclass(frozen=True)
class SessionScore:
    """Score of all frames.

    Attributes:
        num_frames: Frames that were looked at.
        num_holes: Holes that could be found.
        num_found: Of these, those that were.
        num_false: Targets where there is no hole.
        errors: Of the found ones.
    """

    num_frames: int
    num_holes: int
    num_found: int
    num_false: int
    errors: tuple[HoleError, ...]

    def compute_position_m(self, percent: float) -> float | None:
        """Return a percentile of the errors of the centre; `None` without any."""
        values = [one.position_m for one in self.errors]
        return float(np.percentile(values, percent)) if values else None

    def count_inside(self, sigmas: float) -> int:
        """Return how many errors lie inside so many stated standard deviations."""
        return sum(one.sigmas <= sigmas for one in self.errors)


def score_holes(
    name: str,
    found: Sequence[Mapping[str, Any]],
    true: Sequence[tuple[Sequence[float], Sequence[float], float]],
) -> SessionScore:
    """Return the score of one frame.

    Args:
        name: Of the frame.
        found: Holes as `holes.json` holds them.
        true: Centre, axis and distance of each hole that could be found, in the same coordinates.
    """
    errors, left = [], list(found)
    for center_m, axis, distance_m in true:
        best = min(left, key=lambda one: _measure_away(one, center_m), default=None)
        if best is None or _measure_away(best, center_m) > NEAR_M:
            continue
        left = [one for one in left if one is not best]
        away = np.array(best["center_m"]) - center_m
        cov = np.array(best["cov_m2"])
        errors.append(
            HoleError(
                frame=name,
                distance_m=distance_m,
                position_m=float(np.linalg.norm(away)),
                std_m=float(np.sqrt(np.trace(cov))),
                sigmas=float(np.sqrt(away @ np.linalg.pinv(cov) @ away)),
                normal_rad=float(np.arccos(np.clip(np.dot(best["axis"], axis), -1, 1))),
            )
        )
    return SessionScore(1, len(true), len(errors), len(left), tuple(errors))


def merge_scores(scores: Sequence[SessionScore]) -> SessionScore:
    """Return the score of several frames together."""
    errors: list[HoleError] = []
    for one in scores:
        errors += one.errors
    return SessionScore(
        len(scores),
        sum(one.num_holes for one in scores),
        sum(one.num_found for one in scores),
        sum(one.num_false for one in scores),
        tuple(errors),
    )


def _measure_away(hole: Mapping[str, Any], center_m: Sequence[float]) -> float:
    return float(np.linalg.norm(np.array(hole["center_m"]) - center_m))
