"""Steps of a signal that no machine makes: wraps of a counter or an angle, sign bits, spikes, jumps.

Axes: `T` samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

ANGLES = (math.pi, math.tau, 1.0, 180.0, 360.0, 400.0, 3600.0, 36000.0)
"""Values at which angles begin again, in rad, turns, deg, gon and parts of a degree."""
MODULI = (*ANGLES, *(2.0**k for k in range(8, 33)))
"""The same, and those of counters."""
SIGN_BITS = tuple(2.0**k for k in range(7, 32))
FIT_SHARE = 0.04
"""A step is a wrap where it differs by at most this part of the modulus from going on at the speed beside it."""
SPIKE_SHARE = 0.05
"""Least size of a spike, as a part of the range of a signal: above the noise of a working sensor."""
SPIKE_RATIO = 8.0
"""A spike is so many times the usual change over two samples, which noise and motion have too."""
JUMP_SHARE = 0.1
"""Least size of a jump, as a part of the range."""
LONGEST_LAG_S = 1.5
"""Time within which a joint answers its target: more than twice the 0.55 s of the slowest machine known."""
CAUSE_SHARE = 0.3
"""Least step of a target that causes a step of the position, as a part of the latter."""
JUMP_RATIO = 10.0
"""A jump is so many times the 95 % quantile of the steps of its signal; a joint gains speed over samples."""


@dataclass(frozen=True)
class Wrap:
    """Steps of a signal by a modulus.

    Attributes:
        modulus: Size of the steps; negative for a sign bit of that value.
        rows: Rows before each step.
    """

    modulus: float
    rows: np.ndarray

    def explain(self) -> str:
        """Return what was seen."""
        size = abs(self.modulus)
        if self.modulus < 0:
            return f"values from {size:g} on are negative ones with a sign bit"
        return f"it steps by {size:.6g} in {len(self.rows)} rows and goes on at the same speed"


def find_wrap(values: np.ndarray, moduli: Sequence[float] = MODULI) -> Wrap | None:
    """Return the wraps of a signal, `(T,)`, or `None`.

    All large steps must be by one modulus, the speed must be the same before and after, and the signal must
    reach from one end of the modulus to the other. Steps by a sign bit are looked for beside `MODULI` only.
    """
    values = values[np.isfinite(values)]
    if len(values) < 20 or np.ptp(values) == 0:
        return None
    steps, span = np.diff(values), float(np.ptp(values))
    typical = float(np.quantile(np.abs(steps), 0.9))
    is_count = values.min() >= 0 and bool((values == np.round(values)).all())
    for modulus in moduli:
        if is_count and values.max() >= modulus:
            continue  # a counter never reaches its modulus, a sign bit is above it
        if not 0.85 * modulus <= span <= 1.02 * modulus or typical > 0.2 * modulus:
            continue
        rows = np.flatnonzero(np.abs(steps) > 0.5 * modulus)
        if not len(rows):
            continue
        before, after = steps[np.maximum(rows - 1, 0)], steps[np.minimum(rows + 1, len(steps) - 1)]
        usual = np.where(np.abs(before) < np.abs(after), before, after)
        left = np.abs(steps[rows] - np.sign(steps[rows]) * modulus - usual)
        # a signal runs towards the end at which it begins again; a square wave stands still there
        is_running = usual * steps[rows] < 0
        is_near = left <= max(FIT_SHARE * modulus, 3.0 * typical)
        if np.mean(is_near) >= 0.9 and np.mean(is_running) >= 0.5:
            return Wrap(modulus, rows)
    return _find_sign_bit(values, steps) if moduli is MODULI else None


def _find_sign_bit(values: np.ndarray, steps: np.ndarray) -> Wrap | None:
    """Return the sign bit of whole numbers, which jump to it where the signal passes through zero."""
    if (values != np.round(values)).any() or values.min() < 0:
        return None
    for bit in SIGN_BITS:
        is_negative = values >= bit
        if not (0 < is_negative.sum() < len(values)) or values.max() >= 1.5 * bit:
            continue
        if values[~is_negative].max() >= 0.5 * bit:
            continue
        true = np.where(is_negative, bit - values, values)
        rows = np.flatnonzero(np.abs(steps) > 0.5 * bit)
        is_smooth = np.abs(np.diff(true)).max() < 0.2 * bit
        if len(rows) and is_smooth:
            return Wrap(-bit, rows)
    return None


def find_spikes(values: np.ndarray) -> np.ndarray:
    """Return the rows, `(K,)`, at which a signal leaves its neighbours, which agree, and comes back."""
    span = float(np.ptp(values)) if len(values) > 2 else 0.0
    if span == 0.0:
        return np.empty(0, dtype=int)
    back, on = values[1:-1] - values[:-2], values[1:-1] - values[2:]
    size = np.minimum(np.abs(back), np.abs(on))
    apart = np.abs(values[2:] - values[:-2])
    least = max(SPIKE_SHARE * span, SPIKE_RATIO * float(np.median(apart)))
    is_spike = (back * on > 0) & (size > least) & (apart < 0.3 * size)
    return np.flatnonzero(is_spike) + 1


def find_jumps(t_s: np.ndarray, q: np.ndarray, cause: np.ndarray) -> np.ndarray:
    """Return the rows, `(K,)`, before steps of a position that its command does not cause.

    Args:
        t_s: Times, `(T,)` s.
        q: Positions, `(T,)`.
        cause: Its target in the same unit, `(T,)`; zeros for a command of another kind.
    """
    if len(q) < 20:
        return np.empty(0, dtype=int)
    steps = np.diff(median_filter(q, 5, mode="nearest"))
    size, span = np.abs(steps), float(np.ptp(q))
    moving = size[size > 0]
    if not len(moving):
        return np.empty(0, dtype=int)
    least = max(JUMP_RATIO * float(np.quantile(size, 0.95)), JUMP_SHARE * span)
    found = []
    for row in np.flatnonzero(size > least):
        begin = int(np.searchsorted(t_s, t_s[row] - LONGEST_LAG_S))
        # only a step causes a step; a target that moves slowly does not
        largest = np.abs(np.diff(cause[begin : row + 2])).max(initial=0.0)
        if begin == 0 and cause.any():  # a target may have stepped before the log began
            largest = max(largest, abs(cause[0] - q[0]))
        if largest < CAUSE_SHARE * size[row]:
            found.append(row)
    return np.array(found, dtype=int)
