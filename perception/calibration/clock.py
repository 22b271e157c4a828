"""How much the clock of the camera is off against that of the joints: both saw the same motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.calibration import rigid

STEP_S = 0.01
LONGEST_S = 0.6
"""Between two frames; over a longer gap a speed says nothing."""
FEWEST = 15
"""Pairs of frames that must have a speed."""


@dataclass(frozen=True)
class ClockOffset:
    """What is added to the time of a frame to have the time of the recording.

    Attributes:
        offset_s: The offset.
        correlation: Of both speeds there, in [-1, 1].
    """

    offset_s: float
    correlation: float


def offset(
    frame_s: np.ndarray, turns: np.ndarray, recording_s: np.ndarray, link_turns: np.ndarray, largest_s: float
) -> ClockOffset | None:
    """Returns the offset at which the speeds of turning agree best, `None` where there is too little motion to compare.

    Args:
        frame_s: Times of the frames in which the board was seen, `(N,)`.
        turns: How the camera saw the board turned, `(N, 3, 3)`.
        recording_s: Times of the recording, `(T,)`.
        link_turns: How the joints turned the link, `(T, 3, 3)`.
        largest_s: Offsets of this size and less are tried.
    """
    gap = np.diff(frame_s)
    near = (gap > 1e-6) & (gap <= LONGEST_S)
    if near.sum() < FEWEST:
        return None
    # how far it turned: not about which axis, that is what nobody knows yet
    seen = np.linalg.norm(rigid.turn_of(np.swapaxes(turns[:-1], 1, 2) @ turns[1:]), axis=1)[near] / gap[near]
    begin, end = frame_s[:-1][near], frame_s[1:][near]
    step = np.linalg.norm(rigid.turn_of(np.swapaxes(link_turns[:-1], 1, 2) @ link_turns[1:]), axis=1) / np.diff(recording_s)
    way = np.concatenate([[0.0], np.cumsum(step * np.diff(recording_s))])
    fastest = 1.5 * step.max()
    seen = np.minimum(seen, fastest)  # a board that jumps was seen wrongly
    tried, scores = np.arange(-largest_s, largest_s + STEP_S / 2, STEP_S), []
    for shift in tried:
        inside = (begin + shift >= recording_s[0]) & (end + shift <= recording_s[-1])
        if inside.sum() < FEWEST:
            scores.append(-1.0)
            continue
        told = (np.interp(end + shift, recording_s, way) - np.interp(begin + shift, recording_s, way)) / (end - begin)
        one, other = told[inside], seen[inside]
        both = one.std() * other.std()
        scores.append(float(np.mean((one - one.mean()) * (other - other.mean())) / both) if both > 1e-12 else -1.0)
    best = int(np.argmax(scores))
    if scores[best] <= -1.0:
        return None
    top = tried[best]
    if 0 < best < len(tried) - 1 and min(scores[best - 1], scores[best + 1]) > -1.0:
        before, here, after = scores[best - 1 : best + 2]
        bend = before - 2 * here + after
        top += 0.5 * STEP_S * (before - after) / bend if bend < 0 else 0.0
    return ClockOffset(float(top), scores[best])
