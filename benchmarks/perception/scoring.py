"""Scores of a finder on rendered frames, by their truth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brokk_rl.contracts.vision import BoreholeFinder, FrameDetections, HolePose
from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from perception import dataset

NEAR_M = 0.05
"""A found hole belongs to a true one whose line of sight it lies this near to: its radius. How deep
it lies is its error."""
ONE_SIGMA_2D = 1.515
"""Radius that holds 68.3 % of a round Gaussian in two dimensions, in standard deviations of one."""
THREE_SIGMA_2D = 3.439
"""Radius that holds 99.73 % of it, as 3 standard deviations do in one dimension."""


@dataclass
class FinderScore:
    """Counts and errors over the frames of one row.

    Attributes:
        frames: Frames looked at; those that were refused as a whole count too.
        refused: Frames refused as a whole.
        true: Holes that could be found.
        found: Of these, those that were.
        false: Targets where there is neither a hole nor a decoy.
        decoys: Flat discs in view.
        fooled: Of these, those taken for a hole.
        position_m: Error of each found centre.
        normal_rad: Error of each axis.
        along_m: Error along the line of sight, signed.
        across_m: Error across it, `(2,)` each.
        along_sigmas: Error along the line of sight in standard deviations claimed.
        across_sigmas: Length of the error across it in standard deviations claimed.
        normal_sigmas: Error of the axis in standard deviations claimed.
        ms: Time of each stage, by name, one a frame.
    """

    frames: int = 0
    refused: int = 0
    true: int = 0
    found: int = 0
    false: int = 0
    decoys: int = 0
    fooled: int = 0
    position_m: list[float] = field(default_factory=list)
    normal_rad: list[float] = field(default_factory=list)
    along_m: list[float] = field(default_factory=list)
    across_m: list[list[float]] = field(default_factory=list)
    along_sigmas: list[float] = field(default_factory=list)
    across_sigmas: list[float] = field(default_factory=list)
    normal_sigmas: list[float] = field(default_factory=list)
    ms: dict[str, list[float]] = field(default_factory=dict)

    def row(self) -> dict[str, float | int | None]:
        """Return the figures of a table; `None` for those that there is nothing to say about."""
        position, normal = 1000 * np.array(self.position_m), np.degrees(self.normal_rad)
        targets = self.found + self.false + self.fooled
        return {
            "frames": self.frames,
            "refused": self.refused,
            "recall": self.found / self.true if self.true else None,
            "precision": self.found / targets if targets else None,
            "false": self.false,
            "decoys_accepted": self.fooled / self.decoys if self.decoys else None,
            "position_mm_median": _compute_percentile(position, 50),
            "position_mm_p95": _compute_percentile(position, 95),
            "normal_deg_p95": _compute_percentile(normal, 95),
            "along_inside_1_sigma": _share(self.along_sigmas, 1.0),
            "across_inside_1_sigma": _share(self.across_sigmas, ONE_SIGMA_2D),
            "normal_inside_1_sigma": _share(self.normal_sigmas, ONE_SIGMA_2D),
            "along_beyond_3_sigma": _share_beyond(self.along_sigmas, 3.0),
            "across_beyond_3_sigma": _share_beyond(self.across_sigmas, THREE_SIGMA_2D),
            "normal_beyond_3_sigma": _share_beyond(self.normal_sigmas, THREE_SIGMA_2D),
            "ms_median": _compute_percentile(np.array(self.ms.get("total", [])), 50),
        }

    def noise(self) -> dict[str, float | None]:
        """Return the error model for training: errors of an episode and errors of a frame.

        A camera that stands still sees the same face with the same matcher: nearly all of the error
        is the episode's. The policy's task draws it as a shift of at most `target_bias_m`, here the
        95th percentile.
        """
        return {
            "target_bias_m": _compute_percentile(np.array(self.position_m), 95),
            "along_std_m": float(np.sqrt(np.mean(np.square(self.along_m))))
            if self.along_m
            else None,
            "across_std_m": float(np.sqrt(np.mean(np.square(self.across_m))))
            if self.across_m
            else None,
        }

    @property
    def is_perfect(self) -> bool:
        """Every hole that could be found was, and nothing else."""
        return self.found == self.true and not (self.refused or self.false or self.fooled)

    def __add__(self, other: FinderScore) -> FinderScore:
        """Return the sum of both."""
        both: dict[str, Any] = {}
        for name in vars(self):
            if name != "ms":
                both[name] = getattr(self, name) + getattr(other, name)
        stages = dict.fromkeys((*self.ms, *other.ms))
        return FinderScore(
            **both, ms={stage: self.ms.get(stage, []) + other.ms.get(stage, []) for stage in stages}
        )


def score_frame(
    finder: BoreholeFinder, frame: Frame, truth: dataset.SceneTruth
) -> tuple[FinderScore, FrameDetections]:
    """Return score and detections of one frame; none where the finder refused the frame."""
    tally = FinderScore(frames=1)
    start = time.perf_counter()
    try:
        found = finder.find(frame)
    except FrameError:
        tally.refused = 1
        found = FrameDetections([])
    for stage, value in {**found.ms, "total": 1000 * (time.perf_counter() - start)}.items():
        tally.ms[stage] = [value]
    match_holes(found.holes, truth, frame, tally)
    return tally, found


def match_holes(
    holes: Sequence[HolePose], truth: dataset.SceneTruth, frame: Frame, tally: FinderScore
) -> None:
    """Add one frame: each hole goes to the target nearest to its line of sight, each target once.

    Holes of which more than half of the rim is hidden, or that leave the picture, need not be
    found; found, they are no mistake.
    """
    left = list(holes)
    eye = np.zeros(3)
    in_base = bool(left) and left[0].frame == "base"
    if in_base and frame.base_from_camera is not None:
        eye = frame.base_from_camera[:3, 3]
    for hole in truth.holes:
        center, axis = (np.array(v) for v in _select_frame(hole, in_base))
        due = hole.in_view and hole.hidden <= 0.5
        tally.true += due
        near = min(left, key=lambda pose: _measure_offset_m(pose, center, eye), default=None)
        if near is None or _measure_offset_m(near, center, eye) > NEAR_M:
            continue
        left = [pose for pose in left if pose is not near]
        if due:
            tally.found += 1
            _measure_errors(near, center, axis, eye, tally)
    discs = [np.array(_select_frame(disc, in_base)[0]) for disc in truth.decoys]
    tally.decoys += sum(disc.in_view for disc in truth.decoys)
    for pose in left:
        fooled = any(_measure_offset_m(pose, disc, eye) <= NEAR_M for disc in discs)
        tally.fooled += fooled
        tally.false += not fooled


def _measure_errors(
    pose: HolePose, center: np.ndarray, axis: np.ndarray, eye: np.ndarray, tally: FinderScore
) -> None:
    ray = (center - eye) / np.linalg.norm(center - eye)
    error = pose.center_m - center
    side = np.linalg.svd(ray[None])[2][1:]
    along, across = float(error @ ray), side @ error
    tally.position_m.append(float(np.linalg.norm(error)))
    tally.along_m.append(along)
    tally.across_m.append(across.tolist())
    tally.along_sigmas.append(abs(along) / float(np.sqrt(ray @ pose.cov_m2 @ ray)))
    tally.across_sigmas.append(
        float(np.sqrt(across @ np.linalg.solve(side @ pose.cov_m2 @ side.T, across)))
    )
    tilt = np.linalg.svd(axis[None])[2][1:]
    turn = tilt @ (pose.axis - axis)
    tally.normal_rad.append(float(np.arccos(np.clip(pose.axis @ axis, -1, 1))))
    spread = tilt @ pose.axis_cov_rad2 @ tilt.T + np.eye(2) * 1e-14
    tally.normal_sigmas.append(float(np.sqrt(turn @ np.linalg.solve(spread, turn))))


def _measure_offset_m(pose: HolePose, center: np.ndarray, eye: np.ndarray) -> float:
    """Return how far from the line of sight to a true centre a found one lies, m."""
    ray = (center - eye) / np.linalg.norm(center - eye)
    apart = pose.center_m - center
    return float(np.linalg.norm(apart - (apart @ ray) * ray))


def _select_frame(
    circle: dataset.TrueCircle, in_base: bool
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (
        (circle.center_in_base_m, circle.axis_in_base)
        if in_base
        else (circle.center_m, circle.axis)
    )


def _compute_percentile(values: np.ndarray, percent: float) -> float | None:
    return float(np.percentile(values, percent)) if len(values) else None


def _share(sigmas: Sequence[float], limit: float) -> float | None:
    return float(np.mean(np.array(sigmas) <= limit)) if sigmas else None


def _share_beyond(sigmas: Sequence[float], limit: float) -> float | None:
    return float(np.mean(np.array(sigmas) > limit)) if sigmas else None
