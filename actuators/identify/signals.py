"""Delay, lag, play and a second-order loop, each applied to a whole recording at once."""

import numpy as np
from scipy.signal import cont2discrete, lfilter


def delay_signal(u: np.ndarray, periods: float) -> np.ndarray:
    """Return `u` `(T, …)` later by a fractional number of samples, its mean over each period."""
    whole = int(np.floor(periods + 5e-7))
    part = periods - whole
    known = np.concatenate([np.repeat(u[:1], whole + 1, 0), u])
    return (1.0 - part) * known[1 : len(u) + 1] + part * known[: len(u)]


def lag_signal(u: np.ndarray, time_constant_s: float, period_s: float) -> np.ndarray:
    """Return a first-order lag of `u` `(T, …)`, as it stands at the end of each period."""
    if time_constant_s < 1e-4:
        return u
    kept = np.exp(-period_s / time_constant_s)
    return lfilter([1.0 - kept], [1.0, -kept], u, axis=0, zi=kept * u[:1])[0]


def apply_play(u: np.ndarray, width: float) -> np.ndarray:
    """Return `u` `(T,)` behind a play operator of a width, which begins in its middle."""
    held, found = u[0], np.empty(len(u))
    low, high = u - 0.5 * width, u + 0.5 * width
    for row in range(len(u)):
        held = min(max(held, low[row]), high[row])
        found[row] = held
    return found


def discretise_loop(w: float, damping: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator of a second-order loop under targets that are held for a step."""
    loop = ([w * w], [1.0, 2.0 * damping * w, w * w])
    # The stubs of scipy know no kind of system that is discretised.
    numerator, denominator, _ = cont2discrete(loop, step_s)  # pyright: ignore[reportAssignmentType, reportGeneralTypeIssues]
    return numerator[0], denominator  # pyright: ignore[reportIndexIssue, reportReturnType]
