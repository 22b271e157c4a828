"""Offset between the clocks of camera and arm, by the correlation of their rotation speeds."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

log = logging.getLogger(__name__)

# All numbers below were chosen by hand.
STEP_S = 0.01
"""Grid of offsets that are tried; a parabola through the best three refines it."""
SPEED_INTERVAL_S = 0.25
"""Speeds are taken over this time: longer smooths starts and stops, shorter amplifies noise."""
MAX_GAP_S = 0.7
"""A longer gap between two frames gives no speed."""
MIN_SPEEDS = 15
"""Pairs of frames that must have a speed."""
MAX_SPEED_RATIO = 1.3
"""A board faster than the arm ever was, by more than this factor, was detected wrongly."""
CLOCK_STD_S = 0.02
"""Standard deviation of the offset by correlation; the poses refine it."""
FRAME_JITTER_S = 0.005
"""Standard deviation of the time stamp of a single frame."""


@dataclass(frozen=True)
class ClockEstimate:
    """Time to add to that of a frame to have the recording's.

    Attributes:
        offset_s: The offset.
        correlation: Of both speeds there, in [-1, 1].
        is_trusted: The correlation is high enough to use the offset.
    """

    offset_s: float
    correlation: float
    is_trusted: bool

    @property
    def applied_s(self) -> float:
        """The offset where it is trusted, else 0."""
        return self.offset_s if self.is_trusted else 0.0


def estimate_clock_offset(
    frame_s: np.ndarray,
    turns: np.ndarray,
    recording_s: np.ndarray,
    link_turns: np.ndarray,
    largest_s: float,
    least_correlation: float,
) -> ClockEstimate | None:
    """Return the offset at which the rotation speeds of board and link correlate best.

    Args:
        frame_s: Times of the frames that show the board, `(N,)`.
        turns: Rotation of the board in the camera, `(N, 3, 3)`.
        recording_s: Times of the recording, `(T,)`.
        link_turns: Rotation of the link in the base, `(T, 3, 3)`.
        largest_s: Largest offset that is tried, either way.
        least_correlation: Below this the offset is not trusted, and a warning is logged.

    Returns:
        `None` where there is too little motion to compare.
    """
    later = np.searchsorted(frame_s, frame_s + SPEED_INTERVAL_S)
    first = np.flatnonzero(later < len(frame_s))
    first = first[frame_s[later[first]] - frame_s[first] <= MAX_GAP_S]
    begin, end = frame_s[first], frame_s[later[first]]
    # the size of the turn alone: the rotation between the two frames is not known yet
    start, stop = Rotation.from_matrix(turns[first]), Rotation.from_matrix(turns[later[first]])
    seen = (start.inv() * stop).magnitude() / (end - begin)
    arm = Rotation.from_matrix(link_turns)
    link = Slerp(recording_s, arm)
    arm_speeds = (arm[:-1].inv() * arm[1:]).magnitude() / np.diff(recording_s)
    believed = seen <= MAX_SPEED_RATIO * float(arm_speeds.max()) + 1e-9
    begin, end, seen = begin[believed], end[believed], seen[believed]
    if len(seen) < MIN_SPEEDS:
        return None
    offsets = np.arange(-largest_s, largest_s + STEP_S / 2, STEP_S)
    scores = []
    for shift in offsets:
        inside = (begin + shift >= recording_s[0]) & (end + shift <= recording_s[-1])
        scores.append(_correlate_speeds(link, begin[inside], end[inside], seen[inside], shift))
    best = int(np.argmax(scores))
    if scores[best] <= -1.0:
        return None
    top = offsets[best]
    if 0 < best < len(offsets) - 1 and min(scores[best - 1], scores[best + 1]) > -1.0:
        before, middle, after = scores[best - 1 : best + 2]
        bend = before - 2 * middle + after
        top += 0.5 * STEP_S * (before - after) / bend if bend < 0 else 0.0
    found = ClockEstimate(float(top), scores[best], scores[best] >= least_correlation)
    if not found.is_trusted:
        log.warning(
            "clocks: speeds of board and arm correlate by %.2f, not by %g; the offset is taken as 0. "
            "Move the arm while recording, with starts and stops.",
            *(found.correlation, least_correlation),
        )
    return found


def _correlate_speeds(
    link: Slerp, begin_s: np.ndarray, end_s: np.ndarray, seen_rad_s: np.ndarray, shift_s: float
) -> float:
    """Return the correlation of the link's speeds with those seen; -1 where it is undefined."""
    if len(seen_rad_s) < MIN_SPEEDS:
        return -1.0
    begin, end = link(begin_s + shift_s), link(end_s + shift_s)
    speed = (begin.inv() * end).magnitude() / (end_s - begin_s)
    if not speed.std() * seen_rad_s.std() > 1e-9:
        return -1.0
    return float(np.corrcoef(speed, seen_rad_s)[0, 1])
