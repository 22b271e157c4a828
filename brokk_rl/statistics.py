"""Statistics of evaluations: intervals of rates and means, interquartile means over seeds.

Source of the interquartile mean and its stratified bootstrap: Agarwal et al. 2021, Deep
reinforcement learning at the edge of the statistical precipice (arXiv 2108.13264), sections 4.1
and 4.3, and its library rliable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
"""Level of all intervals; the usual one."""
TRIMMED = 0.25
"""Share of scores dropped at each end; the middle half is left."""
RESAMPLES = 50_000
"""Bootstrap resamples, as rliable's default."""


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


def compute_interquartile_mean(
    strata: Sequence[np.ndarray], generator: np.random.Generator
) -> tuple[float, tuple[float, float] | None]:
    """Return the interquartile mean of all scores with its stratified bootstrap interval.

    Runs are drawn again within each stratum. The interval is that of percentiles; it is `None`
    where no stratum has two runs.

    Args:
        strata: Scores of the runs on each task or plant, `(seeds,)` each.
        generator: Draws the resamples.
    """
    mean = float(stats.trim_mean(np.concatenate(strata), TRIMMED))
    drawn = [scores for scores in strata if len(scores) > 1]
    if not drawn:
        return mean, None
    # A stratum of one run is the same in every resample.
    constant = np.concatenate([np.empty(0), *(scores for scores in strata if len(scores) == 1)])

    def compute_means(*samples: np.ndarray, axis: int) -> np.ndarray:
        shape = (*np.shape(samples[0])[:-1], len(constant))
        joined = np.concatenate((*samples, np.broadcast_to(constant, shape)), axis=-1)
        return stats.trim_mean(joined, TRIMMED, axis=axis)

    found = stats.bootstrap(
        drawn,
        compute_means,
        n_resamples=RESAMPLES,
        vectorized=True,
        axis=-1,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=generator,
    ).confidence_interval
    return mean, (float(found.low), float(found.high))
