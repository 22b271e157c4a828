"""Evaluation of a hand-eye solution: residuals, poses that are missing, and the verdict.

A solver finds the best camera for whatever it is given, wrong signs and scales too. Their traces are
an arm that must be far less accurate than assumed, zeros of joints beyond their prior, and views that
agree with nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from brokk_rl.errors import FrameError
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


log = logging.getLogger(__name__)

GOOD, WRONG, OPEN = "good", "not to be trusted", "cannot tell"
VerdictStatus = Literal["good", "not to be trusted", "cannot tell"]

MAX_LEFT_OUT = 0.5
"""Share of views left out beyond which those that agree may be the wrong ones."""
MAX_ARM_FACTOR = 1.5
"""Factor on the arm's assumed uncertainty. 40 right arms reach 1.1. Arms with one joint off by a tenth
or reversed have 2 to 10, and of 15 with one off by a twentieth one passes."""
MAX_ZERO_SIGMAS = 3.0
"""Zeros of joints beyond so many standard deviations of their prior are called wrong."""
MIN_VIEWS_JUDGED = 8
"""Views below which a right and a wrong joint cannot be told apart: two for each unknown of a joint."""
CAUSES = (
    "look at scale, sign, axes and order of the joints in the machine's file, and whether the joint "
    "positions belong to these frames"
)


@dataclass(frozen=True)
class Verdict:
    """Judgement of a calibration and its reasons.

    Attributes:
        status: `good`, `not to be trusted` or `cannot tell`.
        reasons: In words; empty for `good`.
    """

    status: VerdictStatus
    reasons: list[str]


def judge_fit(
    used: np.ndarray,
    arm_factor: float,
    zeros: Mapping[str, float],
    zero_std: float,
    missing: Sequence[str],
) -> Verdict:
    """Return the verdict on a fit.

    Args:
        used: Views that agree, of those that could be used, `(N,)` bool.
        arm_factor: The arm's uncertainty over the assumed one.
        zeros: Estimated zero by joint, rad or m.
        zero_std: Standard deviation of its prior.
        missing: Motions that the poses lack, in words.
    """
    reasons, num_used, num_views = [], int(used.sum()), len(used)
    if num_views - num_used > MAX_LEFT_OUT * num_views:
        reasons.append(f"{num_views - num_used} of {num_views} contradict the others")
    if arm_factor > MAX_ARM_FACTOR:
        reasons.append(f"the arm would be {arm_factor:.1f} times as inaccurate as assumed")
    for name, mean in zeros.items():
        if abs(mean) > MAX_ZERO_SIGMAS * zero_std:
            reasons.append(
                f"the zero of {name} would be off by {mean:+.4f}, {abs(mean) / zero_std:.1f} standard "
                "deviations of what was assumed"
            )
    if reasons:
        return Verdict(WRONG, [*reasons, CAUSES])
    if num_used < MIN_VIEWS_JUDGED:
        return Verdict(OPEN, [f"{num_used} agree, {MIN_VIEWS_JUDGED} are needed for a verdict"])
    return Verdict(OPEN if missing else GOOD, list(missing))


def check_verdict(content: Mapping[str, Any], where: str) -> None:
    """Refuse a calibration that its own verdict calls wrong; warn where it could not tell.

    Files from before there were verdicts pass.

    Raises:
        FrameError: the calibration is not to be trusted.
    """
    verdict = content.get("verdict") or {}
    reasons = "; ".join(verdict.get("reasons", ()))
    if verdict.get("status") == WRONG:
        raise FrameError(
            f"{where}: this calibration is not to be trusted: {reasons}. Mend it and run "
            "`brokk mode=calibrate` again"
        )
    if verdict.get("status") == OPEN:
        log.warning("%s: whether this calibration is right cannot be told: %s", where, reasons)
