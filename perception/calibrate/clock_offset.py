"""How much the clock of the camera is off against that of the joints: both saw the same motion."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from perception.calibrate import transforms

log = logging.getLogger(__name__)

STEP_S = 0.01
OVER_S, LONGEST_S = 0.25, 0.7
"""Speeds are taken over the first; over a gap longer than the second one says nothing."""
MIN_SPEEDS = 15
"""Pairs of frames that must have a speed."""
CLOCK_STD_S = 0.02
"""How well the correlation of speeds tells the offset; the poses tell the rest."""
FRAME_JITTER_S = 0.005
"""By which the time of a single frame may be off."""


@dataclass(frozen=True)
class ClockEstimate:
    """What is added to the time of a frame to have the time of the recording.

    Attributes:
        offset_s: The offset.
        correlation: Of both speeds there, in [-1, 1].
        is_trusted: They correlate well enough to believe it.
    """

    offset_s: float
    correlation: float
    is_trusted: bool


def estimate_clock_offset(
    frame_s: np.ndarray,
    turns: np.ndarray,
    recording_s: np.ndarray,
    link_turns: np.ndarray,
    largest_s: float,
    least_correlation: float,
) -> ClockEstimate | None:
    """Returns the offset at which the speeds of turning agree best, `None` where there is too little motion to compare.

    Args:
        frame_s: Times of the frames in which the board was seen, `(N,)`.
        turns: How the camera saw the board turned, `(N, 3, 3)`.
        recording_s: Times of the recording, `(T,)`.
        link_turns: How the joints turned the link, `(T, 3, 3)`.
        largest_s: Offsets of this size and less are tried.
        least_correlation: From which on an offset is believed; a warning says when it is not.
    """
    later = np.searchsorted(frame_s, frame_s + OVER_S)
    here = np.flatnonzero(later < len(frame_s))
    here = here[frame_s[later[here]] - frame_s[here] <= LONGEST_S]
    begin, end = frame_s[here], frame_s[later[here]]
    # how far it turned: not about which axis, that is what nobody knows yet
    seen = _compute_angles(turns[here], turns[later[here]]) / (end - begin)
    link = Slerp(recording_s, Rotation.from_matrix(link_turns))
    fastest = float((_compute_angles(link_turns[:-1], link_turns[1:]) / np.diff(recording_s)).max())
    believed = seen <= 1.3 * fastest + 1e-9  # a board that jumps was seen wrongly
    begin, end, seen = begin[believed], end[believed], seen[believed]
    if len(seen) < MIN_SPEEDS:
        return None
    tried, scores = np.arange(-largest_s, largest_s + STEP_S / 2, STEP_S), []
    for shift in tried:
        inside = (begin + shift >= recording_s[0]) & (end + shift <= recording_s[-1])
        if inside.sum() < MIN_SPEEDS:
            scores.append(-1.0)
            continue
        ends = (link(times[inside] + shift).as_matrix() for times in (begin, end))
        one, other = _compute_angles(*ends) / (end - begin)[inside], seen[inside]
        both = one.std() * other.std()
        scores.append(
            float(np.mean((one - one.mean()) * (other - other.mean())) / both)
            if both > 1e-9
            else -1.0
        )
    best = int(np.argmax(scores))
    if scores[best] <= -1.0:
        return None
    top = tried[best]
    if 0 < best < len(tried) - 1 and min(scores[best - 1], scores[best + 1]) > -1.0:
        before, here, after = scores[best - 1 : best + 2]
        bend = before - 2 * here + after
        top += 0.5 * STEP_S * (before - after) / bend if bend < 0 else 0.0
    found = ClockEstimate(float(top), scores[best], scores[best] >= least_correlation)
    if not found.is_trusted:
        log.warning(
            "clocks: speeds of board and arm correlate by %.2f, %g is needed to tell an offset; it is taken for 0. Move the "
            "arm while recording, with starts and stops.", found.correlation, least_correlation,
        )  # fmt: skip
    return found


def _compute_angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns by which angles rotations differ, rad."""
    return np.linalg.norm(
        transforms.compute_rotation_vectors(np.swapaxes(one, 1, 2) @ other), axis=1
    )
