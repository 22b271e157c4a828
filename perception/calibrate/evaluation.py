"""Evaluation of a hand-eye solution: residuals, cross-validation, and poses that are missing."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from brokk_rl.machine import Machine
from perception.calibrate.clock_offset import ClockEstimate
from perception.calibrate.hand_eye import HandEyeSolution, HandEyeViews

CLOCK_NAME = "clock"
"""Name of the clocks' offset among the systematic errors."""
AXES = ("forward axis", "axis to the left", "vertical")
"""Axes of the base frame in messages."""
RANGE_PERCENT = (5, 95)
"""Percentiles between which a range of turns is measured, so that one outlier does not widen it."""
MIN_DISTANCE_RATIO = 1.2
"""Ratio of farthest to nearest board; chosen by hand, a fifth decouples depth from focal length."""


def list_residuals(views: HandEyeViews, solution: HandEyeSolution) -> list[dict[str, Any]]:
    """Return the residual of each view, and why it was left out, as the file has them."""
    residuals = []
    for k, name in enumerate(views.names):
        left_out = None
        if not solution.used[k]:
            ratio = np.sqrt(solution.distance[k] / 6.0)
            left_out = f"{ratio:.0f} times as far off as it should be"
        residuals.append(describe_residual(name, left_out, solution.away[k]))
    return residuals


def describe_residual(
    name: str, left_out: str | None, away: np.ndarray | None = None
) -> dict[str, Any]:
    """Return the file's entry on one frame.

    Args:
        name: Of the frame.
        left_out: Why it was not used; `None` if it was.
        away: Its residual as a small motion, `(6,)`; `None` where there is none.
    """
    sizes: tuple[float | None, ...] = (None, None)
    if away is not None:
        sizes = tuple(round(float(np.linalg.norm(part)), 6) for part in (away[:3], away[3:]))
    return {"name": name, "away_m": sizes[0], "away_rad": sizes[1], "left_out": left_out}


def summarise_solution(
    views: HandEyeViews, solution: HandEyeSolution, clock: ClockEstimate | None
) -> dict[str, Any]:
    """Return the file's entries on systematic errors, clocks and cross-validation.

    Args:
        views: The views; their times include `clock.applied_s`.
        solution: Of these views.
        clock: Offset of the clocks by speeds; `None` where it was not estimated.
    """
    std = np.sqrt(np.diag(solution.cov)[12:])
    errors = {}
    for name, mean, one_std in zip(views.shared_names, solution.guess.shared, std, strict=True):
        errors[name] = {"mean": round(float(mean), 6), "std": round(float(one_std), 6)}
    refined = errors.pop(CLOCK_NAME, None)
    clock_entry = None
    if clock is not None:
        more_s = refined["mean"] if refined else 0.0
        clock_entry = {
            "offset_s": round(clock.applied_s + more_s, 4),
            "std_s": refined["std"] if refined else None,
            "correlation": round(clock.correlation, 3),
            "trusted": clock.is_trusted,
        }
    return {"joint_zeros": errors, "clock": clock_entry, "arm_factor": round(solution.factor, 3)}


def measure_rotation_ranges(base_from_link: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges of turns about the poses' own principal axes, largest first.

    Args:
        base_from_link: `(N, 4, 4)`.

    Returns:
        `(3,)` rad from the 5th to the 95th percentile, and the axes in the base frame as rows,
            `(3, 3)`.
    """
    poses = Rotation.from_matrix(base_from_link[:, :3, :3])
    vectors = (poses * poses.mean().inv()).as_rotvec()
    axes = np.linalg.svd(vectors - vectors.mean(0), full_matrices=False)[2]
    low, high = np.percentile(vectors @ axes.T, RANGE_PERCENT, axis=0)
    order = np.argsort(low - high)
    return (high - low)[order], axes[order]


def list_missing_poses(
    machine: Machine,
    q: np.ndarray,
    turns_rad: np.ndarray,
    axes: np.ndarray,
    distance_m: np.ndarray,
    least_rad: float,
) -> list[str]:
    """Return in words which poses of a machine to add; empty where they suffice.

    Args:
        machine: Names and travel of the joints.
        q: Joint positions of the poses that were used, `(N, J)`.
        turns_rad: Ranges of turns of the link, largest first; see `measure_rotation_ranges`.
        axes: Their axes as rows.
        distance_m: From the camera to the board, `(N,)`.
        least_rad: Turn that the poses need about two axes.
    """
    missing = []
    for number, ordinal in enumerate(("", "second ")):
        if turns_rad[number] < least_rad:
            nearest = AXES[int(np.abs(axes[number]).argmax())]
            missing.append(
                f"the poses turn by {np.degrees(turns_rad[number]):.0f} degrees about their {ordinal}"
                f"axis (near the {nearest}), {np.degrees(least_rad):.0f} are needed"
            )
    if distance_m.max() < MIN_DISTANCE_RATIO * distance_m.min():
        missing.append(
            f"the board is always {distance_m.min():.1f} to {distance_m.max():.1f} m away: add "
            "poses nearer and farther, by a fifth"
        )
    if turns_rad[1] >= least_rad:
        return missing
    for joint, low, high in zip(machine.joints, q.min(0), q.max(0), strict=True):
        if joint.kind != "hinge" or high - low >= 0.5 * least_rad:
            continue
        side = "lower" if low - joint.lower.value > joint.upper.value - high else "higher"
        missing.append(
            f"{joint.name} stays within {np.degrees(low):.0f} to {np.degrees(high):.0f} degrees: "
            f"add poses with it {side}, as far as the board stays in view"
        )
    return missing
