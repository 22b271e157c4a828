"""Verdict on a calibration, and the wrong joint or log that explains a bad one.

A solver finds the best camera for whatever it is given, wrong signs and scales too. Their traces are
an arm that must be far less accurate than assumed, zeros of joints beyond their prior, and views that
agree with nothing. One changed joint, or one inverted log, that lets the views agree is named.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.machine import Machine
from perception.calibrate import arm
from perception.calibrate.hand_eye import (
    HandEyeSolution,
    HandEyeViews,
    compute_deviance,
    solve_hand_eye,
)

log = logging.getLogger(__name__)

GOOD, WRONG, OPEN = "good", "not to be trusted", "cannot tell"
VerdictStatus = Literal["good", "not to be trusted", "cannot tell"]

MAX_LEFT_OUT = 0.5
"""Share of views left out beyond which those that agree may be the wrong ones."""
MAX_ARM_FACTOR = 2.0
"""Factor on the arm's assumed uncertainty. Right arms reach 1.1, one joint off by a tenth 1.8 to 5."""
MAX_ZERO_SIGMAS = 3.0
"""Zeros of joints beyond so many standard deviations of their prior are called wrong."""
MIN_VIEWS_JUDGED = 8
"""Views below which a right and a wrong joint cannot be told apart: two for each unknown of a joint."""
SCALE_STD = 0.3
"""Standard deviation of a joint's relative scale error before the views are looked at."""
MIN_SCALE_ERROR = 0.02
"""Relative scale error below which a joint is not called wrong: half a degree over 30 degrees."""
MIN_DEVIANCE_GAIN = 50.0
"""Fall of the deviance by which a change explains the views; chance gives 15 in a hundred trials."""


UNEXPLAINED = (
    "no scale or sign of one joint explains this: look at the axes and the order of the joints in "
    "the machine's file, and whether the joint positions belong to these frames"
)


@dataclass(frozen=True)
class Verdict:
    """Judgement of a calibration and its reasons.

    Attributes:
        status: `good`, `not to be trusted` or `cannot tell`.
        reasons: In words; empty for `good`.
    """

    status: VerdictStatus
    reasons: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of `calibration.yaml`."""
        return {"status": self.status, "reasons": list(self.reasons)}


def judge_fit(
    num_used: int,
    num_views: int,
    arm_factor: float,
    zeros: Mapping[str, tuple[float, float]],
    missing: Sequence[str],
) -> Verdict:
    """Return the verdict on a fit, without a comparison with other models.

    Args:
        num_used: Views that agree.
        num_views: Those that could be used.
        arm_factor: The arm's uncertainty over the assumed one.
        zeros: Estimated zero and standard deviation of its prior by joint, rad or m.
        missing: Motions that the poses lack, in words.
    """
    reasons = []
    if num_views - num_used > MAX_LEFT_OUT * num_views:
        reasons.append(f"{num_views - num_used} of {num_views} contradict the others")
    if arm_factor > MAX_ARM_FACTOR:
        reasons.append(f"the arm would be {arm_factor:.1f} times as inaccurate as assumed")
    for name, (mean, std) in zeros.items():
        if abs(mean) > MAX_ZERO_SIGMAS * std:
            reasons.append(
                f"the zero of {name} would be off by {mean:+.4f}, {abs(mean) / std:.1f} standard "
                "deviations of what was assumed"
            )
    if reasons:
        return Verdict(WRONG, tuple(reasons))
    if num_used < MIN_VIEWS_JUDGED:
        return Verdict(OPEN, (f"{num_used} agree, {MIN_VIEWS_JUDGED} are needed for a verdict",))
    return Verdict(OPEN, tuple(missing)) if missing else Verdict(GOOD)


def explain_by_joint(
    machine: Machine,
    q: np.ndarray,
    views: HandEyeViews,
    solution: HandEyeSolution,
    build_views: Callable[[np.ndarray], HandEyeViews],
) -> str | None:
    """Return the scale or sign of one joint that explains views which do not agree, in words.

    Args:
        machine: Names of the joints.
        q: Joint positions of the views, `(N, J)`, rad or m.
        views: The views of these positions.
        solution: Their solution.
        build_views: Views of other positions.

    Returns:
        The change that lowers the deviance most; `None` where none does by `MIN_DEVIANCE_GAIN`, or
        where it leaves a calibration that is as wrong.
    """
    least = compute_deviance(views, solution.guess) - MIN_DEVIANCE_GAIN
    best = None
    for words, changed in _list_joint_changes(machine, q, views):
        found = solve_hand_eye(other := build_views(changed))
        if found is not None and (deviance := compute_deviance(other, found.guess)) <= least:
            least, best = deviance, (words, found)
    if best is None:
        return None
    words, found = best
    num_used, num_views = int(found.used.sum()), len(found.used)
    if judge_fit(num_used, num_views, found.factor, {}, []).status == WRONG:
        return None
    return f"{words}: then {num_used} of {num_views} views agree"


def _list_joint_changes(
    machine: Machine, q: np.ndarray, views: HandEyeViews
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield a change of one joint's positions in words, and all positions after it."""
    links = arm.compute_link_poses(machine, q)
    for k, name in enumerate(machine.joint_names):
        turned = q.copy()
        turned[:, k] *= -1.0
        yield f"{name}: its sign is reversed", turned
        motion = (q[:, k, None] * links.joints[:, k])[:, None]
        scaled_views = replace(
            views,
            shared=np.concatenate([views.shared, motion], 1),
            shared_std=np.append(views.shared_std, SCALE_STD),
            shared_names=(*views.shared_names, "scale"),
        )
        solution = solve_hand_eye(scaled_views)
        if solution is None or abs(solution.guess.shared[-1]) < MIN_SCALE_ERROR:
            continue
        factor = 1.0 + float(solution.guess.shared[-1])
        scaled = q.copy()
        scaled[:, k] *= factor
        yield f"{name}: its positions are to be multiplied by {factor:.3f}", scaled


def add_explanation(verdict: Verdict, explanation: str | None) -> Verdict:
    """Return the verdict with the explanation as its first reason.

    An explanation makes a good verdict a bad one: the views say that the input is wrong.

    Args:
        verdict: By the solution alone.
        explanation: What explains the views, if anything.
    """
    if explanation is None:
        if verdict.status != WRONG:
            return verdict
        return Verdict(WRONG, (*verdict.reasons, UNEXPLAINED))
    reasons = verdict.reasons if verdict.status == WRONG else ()
    return Verdict(WRONG, (explanation, *reasons))


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
