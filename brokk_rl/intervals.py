"""95 % confidence intervals of rates and means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
"""Level of all intervals; the usual one."""


def compute_wilson_interval(successes: float, trials: int) -> tuple[float, float]:
    """Return the Wilson score interval of a rate.

    It stays valid at rates of 0 and 1, where the normal approximation has width 0.

    Source: Wilson 1927, equation (10), without continuity correction.
    """
    if trials < 1:
        return 0.0, 1.0
    z = float(stats.norm.ppf(0.5 + CONFIDENCE / 2))
    rate = successes / trials
    middle = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    return max(0.0, middle - half), min(1.0, middle + half)


def compute_student_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return Student's interval of the mean of independent values; `None` for fewer than two."""
    count = len(values)
    if count < 2:
        return None
    half = float(
        stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * np.std(values, ddof=1) / math.sqrt(count)
    )
    mean = float(np.mean(values))
    return mean - half, mean + half
