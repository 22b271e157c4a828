"""What a solution is worth: how far off each view is, what the other half of the views says, what the clocks showed."""

from __future__ import annotations

from typing import Any

import numpy as np

from perception.calibrate import rigid
from perception.calibrate.clock import ClockOffset
from perception.calibrate.hand_eye import FEWEST, Solution, refine
from perception.calibrate.result import Judged
from perception.calibrate.views import Views, expected

CLOCK = "clock"
"""Name of the clocks' offset among what is wrong in all views alike."""


def of_views(views: Views, solution: Solution) -> list[Judged]:
    """Returns how far off each view is, and which were left out."""
    found = zip(views.names, solution.away, solution.distance, solution.used, strict=True)
    return [
        Judged(
            name, float(np.linalg.norm(away[:3])), float(np.linalg.norm(away[3:])),
            None if good else f"{np.sqrt(far / 6.0):.0f} times as far off as it should be",
        )
        for name, away, far, good in found
    ]  # fmt: skip


def told(
    views: Views, solution: Solution, offset: ClockOffset | None, shift_s: float
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
    late = wrong.pop(CLOCK, None)
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
        "other_half": other_half(views, solution),
    }


def other_half(views: Views, solution: Solution) -> dict[str, float] | None:
    """Returns how far off the boards of each half of the views are from where the other half's answer expects them."""
    used = np.flatnonzero(solution.used)
    halves = used[::2], used[1::2]
    if min(len(half) for half in halves) < 2 * FEWEST:
        return None
    away = []
    for half, other in (halves, halves[::-1]):
        found = refine(views.part(half), solution)
        rest = views.part(other)
        seen = rigid.apart(rest.camera_from_board, expected(rest, found.guess)[:, None])
        away.append(seen[np.arange(len(rest)), np.abs(seen).sum(-1).argmin(1)])
    sizes = np.concatenate(away)
    return {
        "median_m": round(float(np.median(np.linalg.norm(sizes[:, :3], axis=1))), 6),
        "median_rad": round(float(np.median(np.linalg.norm(sizes[:, 3:], axis=1))), 6),
    }
