"""Statistics of evaluations: intervals of rates and of means over seeds."""

from __future__ import annotations

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
    test = stats.binomtest(round(successes), trials)
    low, high = test.proportion_ci(CONFIDENCE, method="wilson")
    return float(low), float(high)


def compute_student_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return Student's interval of the mean of independent values; `None` for fewer than two."""
    if len(values) < 2:
        return None
    quantile = stats.t.ppf(0.5 + CONFIDENCE / 2, len(values) - 1)
    half = float(quantile * stats.sem(values))
    mean = float(np.mean(values))
    return mean - half, mean + half
