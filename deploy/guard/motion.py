"""What a joint does when its valve gets flow: sign, dead time and speed, from a piece of a log. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SMALLEST_FLOW = 0.1
"""Of full; less may lie in a valve's dead band."""
MOVED = 0.004
"""Part of the travel that counts as motion."""
LONGEST_S = 2.0
"""Time after the beginning of flow within which the joint must have moved."""


@dataclass(frozen=True)
class Motion:
    """How a joint answers.

    Attributes:
        agrees: Whether it moves in the direction of its flow, both ways.
        dead_time_s: From the beginning of flow to the first motion, the middle of what was seen.
        speed: Largest speed seen, rad/s or m/s.
    """

    agrees: bool
    dead_time_s: float
    speed: float

    @property
    def text(self) -> str:
        """In words."""
        sign = "sign agrees" if self.agrees else "SIGN TURNED"
        return f"{sign}, dead time {self.dead_time_s:.2f} s, up to {self.speed:.2f} rad/s"


def judge(t_s: np.ndarray, q: np.ndarray, flow: np.ndarray, travel: float) -> Motion | None:
    """Returns how a joint answers, or `None` before it was seen to move after flow of both signs.

    Args:
        t_s: Times, `(T,)`.
        q: Positions of the joint, `(T,)`, rad or m.
        flow: What its valve gets, `(T,)`, of full.
        travel: Length of its travel.
    """
    began = (
        np.flatnonzero((np.abs(flow[1:]) >= SMALLEST_FLOW) & (np.abs(flow[:-1]) < SMALLEST_FLOW))
        + 1
    )
    found: dict[int, list[tuple[bool, float]]] = {1: [], -1: []}
    for row in began:
        # at rest before, or what moves is the answer to something else
        before = t_s > t_s[row] - 0.5
        if np.ptp(q[: row + 1][before[: row + 1]]) > MOVED * travel / 2:
            continue
        window = (t_s >= t_s[row]) & (t_s <= t_s[row] + LONGEST_S)
        away = np.flatnonzero(np.abs(q[window] - q[row]) > MOVED * travel)
        if len(away):
            sign = int(np.sign(flow[row]))
            agrees = bool(np.sign(q[window][away[0]] - q[row]) == sign)
            found[sign].append(
                (agrees, _began_s(t_s[window], q[window] - q[row], away[0]) - float(t_s[row]))
            )
    if not found[1] or not found[-1]:
        return None
    both = [*found[1], *found[-1]]
    step = max(1, round(0.2 / max(1e-3, float(np.median(np.diff(t_s))))))
    speed = np.abs(q[step:] - q[:-step]) / np.maximum(t_s[step:] - t_s[:-step], 1e-6)
    return Motion(
        all(agrees for agrees, _ in both),
        float(np.median([dead_s for _, dead_s in both])),
        float(speed.max()),
    )


def _began_s(t_s: np.ndarray, moved: np.ndarray, row: int) -> float:
    """Returns when a motion began that was noticed at `row`: a line through it and what follows, back to zero."""
    later = min(len(t_s) - 1, int(np.searchsorted(t_s, t_s[row] + 0.15)))
    speed = (moved[later] - moved[row]) / max(1e-6, t_s[later] - t_s[row])
    return float(t_s[row] - (moved[row] / speed if speed * moved[row] > 0 else 0.0))
