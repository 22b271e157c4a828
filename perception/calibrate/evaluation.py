"""Whether the poses of a calibration say all that is asked of them, and which are missing."""

from __future__ import annotations

from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from perception.calibrate import transforms
from perception.calibrate.clock_offset import ClockEstimate
from perception.calibrate.extrinsics import PoseResidual
from perception.calibrate.hand_eye import (
    MIN_VIEWS,
    HandEyeSolution,
    HandEyeViews,
    predict_board_poses,
    refine_solution,
)

# --- from judgement: What a solution is worth: how far off each view is, what the other half of
# the views says, what the clocks showed.

AXES = ("forward axis", "axis to the left", "vertical")
RANGE_PERCENT = (5, 95)


def measure_rotation_ranges(base_from_link: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far the poses turn about three perpendicular axes of their own, most first, and these axes in the base frame.

    Args:
        base_from_link: `(N, 4, 4)`.

    Returns:
        `(3,)` rad from the 5th to the 95th percentile, and the axes as rows, `(3, 3)`.
    """
    middle = transforms.find_nearest_rotation(base_from_link[:, :3, :3].sum(0))
    vectors = transforms.compute_rotation_vectors(base_from_link[:, :3, :3] @ middle.T)
    axes = np.linalg.svd(vectors - vectors.mean(0), full_matrices=False)[2]
    low, high = np.percentile(vectors @ axes.T, RANGE_PERCENT, axis=0)
    order = np.argsort(low - high)
    return (high - low)[order], axes[order]


def list_missing_motions(
    base_from_link: np.ndarray, distance_m: np.ndarray, least_rad: float
) -> list[str]:
    """Returns in words what poses, `(N, 4, 4)`, do not show; empty where they say enough.

    Args:
        base_from_link: The link in the poses that were used.
        distance_m: How far the camera was from the board, `(N,)`.
        least_rad: About two axes at least the poses should turn this far.
    """
    turns, axes = measure_rotation_ranges(base_from_link)
    found = []
    for number, what in enumerate(("", "second ")):
        if turns[number] < least_rad:
            nearest = AXES[int(np.abs(axes[number]).argmax())]
            found.append(
                f"the poses turn by {np.degrees(turns[number]):.0f} degrees about their {what}axis (near the {nearest}), "
                f"{np.degrees(least_rad):.0f} are needed"
            )
    if distance_m.max() < 1.2 * distance_m.min():
        found.append(
            f"the board is always {distance_m.min():.1f} to {distance_m.max():.1f} m away: add poses nearer and farther, by a fifth"
        )
    return found


def list_missing_poses(
    machine: Machine,
    q: np.ndarray,
    base_from_link: np.ndarray,
    distance_m: np.ndarray,
    least_rad: float,
) -> list[str]:
    """Returns in words which poses of a machine should be added; see `unturned`.

    Args:
        machine: Names and travel of the joints.
        q: Joint positions of the poses that were used, `(N, J)`.
        base_from_link: The link there.
        distance_m: How far the camera was from the board.
        least_rad: About two axes at least the poses should turn this far.
    """
    found = list_missing_motions(base_from_link, distance_m, least_rad)
    if measure_rotation_ranges(base_from_link)[0][1] < least_rad:
        low, high = q.min(0), q.max(0)
        for column, joint in enumerate(machine.joints):
            if joint.kind == "hinge" and high[column] - low[column] < 0.5 * least_rad:
                room = (
                    "lower"
                    if low[column] - joint.lower.value > joint.upper.value - high[column]
                    else "higher"
                )
                found.append(
                    f"{joint.name} stays within {np.degrees(low[column]):.0f} to {np.degrees(high[column]):.0f} degrees: add poses "
                    f"with it {room}, as far as the board stays in view"
                )
    return found


CLOCK_NAME = "clock"
"""Name of the clocks' offset among what is wrong in all views alike."""


def list_residuals(views: HandEyeViews, solution: HandEyeSolution) -> list[PoseResidual]:
    """Returns how far off each view is, and which were left out."""
    found = zip(views.names, solution.away, solution.distance, solution.used, strict=True)
    return [
        PoseResidual(
            name, float(np.linalg.norm(away[:3])), float(np.linalg.norm(away[3:])),
            None if good else f"{np.sqrt(far / 6.0):.0f} times as far off as it should be",
        )
        for name, away, far, good in found
    ]  # fmt: skip


def summarise_solution(
    views: HandEyeViews, solution: HandEyeSolution, offset: ClockEstimate | None, shift_s: float
) -> dict[str, Any]:
    """Returns what a file says about a solution by views, besides the camera's place.

    Args:
        views: The views.
        solution: What they said.
        offset: Of the clocks, by speeds; `None` where it was not looked for.
        shift_s: The part of it that the views were taken with.
    """
    std = np.sqrt(np.diag(solution.cov)[12:])
    wrong = {
        name: {"mean": round(float(value), 6), "std": round(float(one), 6)}
        for name, value, one in zip(views.shared_names, solution.guess.shared, std, strict=True)
    }
    late = wrong.pop(CLOCK_NAME, None)
    clock = None
    if offset is not None:
        clock = {
            "offset_s": round(shift_s + (late["mean"] if late else 0.0), 4), "std_s": late["std"] if late else None,
            "correlation": round(offset.correlation, 3), "trusted": offset.is_trusted,
        }  # fmt: skip
    return {
        "joint_zeros": wrong,
        "clock": clock,
        "arm_factor": round(solution.factor, 3),
        "other_half": cross_validate_halves(views, solution),
    }


def cross_validate_halves(
    views: HandEyeViews, solution: HandEyeSolution
) -> dict[str, float] | None:
    """Returns how far off the boards of each half of the views are from where the other half's answer expects them."""
    used = np.flatnonzero(solution.used)
    halves = used[::2], used[1::2]
    if min(len(half) for half in halves) < 2 * MIN_VIEWS:
        return None
    away = []
    for half, other in (halves, halves[::-1]):
        found = refine_solution(views.part(half), solution)
        rest = views.part(other)
        seen = transforms.compute_motion(
            rest.camera_from_board, predict_board_poses(rest, found.guess)[:, None]
        )
        away.append(seen[np.arange(len(rest)), np.abs(seen).sum(-1).argmin(1)])
    sizes = np.concatenate(away)
    return {
        "median_m": round(float(np.median(np.linalg.norm(sizes[:, :3], axis=1))), 6),
        "median_rad": round(float(np.median(np.linalg.norm(sizes[:, 3:], axis=1))), 6),
    }
