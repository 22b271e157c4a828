"""Verdict on a calibration.

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

from brokk_rl.errors import FrameError

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
