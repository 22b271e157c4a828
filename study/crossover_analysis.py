"""Analysis of a two-period crossover: effect of guidance, interval, tests, effect of practice.

Each person has one figure in each period. `first - second` holds plus or minus the effect of
guidance (by who was guided first) and the same effect of the period in both sequences, so that half
the difference of the sequences' means is guidance and half their sum the period (Hills and
Armitage, Br. J. Clin. Pharmacol. 8 (1979) 7-20).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from brokk_rl.statistics import CONFIDENCE
from study import permutation_tests

Interval = tuple[float, float]
ROUNDING = 1e-12
"""Relative spread below which values are the same."""


@dataclass(frozen=True)
class GuidanceEffect:
    """Guidance against no guidance in one measure; differences are guided minus unguided, `None` where too few persons have both.

    Attributes:
        num_persons: Persons with both conditions.
        num_guided_first: Of those, who were guided in the first period.
        guided: Mean with guidance.
        unguided: Mean without.
        difference: Mean difference, paired; it holds the effect of practice where sequences are unequal.
        paired_ci95: Student's interval of it.
        paired_dz: Mean difference over its standard deviation.
        paired_dz_ci95: Interval from the noncentral t distribution.
        hodges_lehmann: Median of the means of all pairs of differences.
        hodges_lehmann_ci95: Exact interval that belongs to the signed-rank test; `None` where there
            is none of 95 %.
        paired_p: Exact paired permutation test.
        wilcoxon_p: Exact signed-rank test.
        adjusted: Difference with the period in the model.
        adjusted_ci95: Student's interval of it.
        dz: The adjusted difference over the standard deviation within sequences.
        dz_ci95: Interval from the noncentral t distribution.
        p: Exact test over sequences: the one that counts. `None` where all had the same sequence.
        period: Second period minus first, by practice or fatigue.
        period_p: Student's test of it.
        carry_over_p: Student's test of unequal sums of the sequences: an after-effect of the first period
            that differs. It sees little at such sizes and decides nothing here (Freeman, Stat. Med.
            8 (1989) 1421-1432).
    """

    num_persons: int
    num_guided_first: int
    guided: float | None = None
    unguided: float | None = None
    difference: float | None = None
    paired_ci95: Interval | None = None
    paired_dz: float | None = None
    paired_dz_ci95: Interval | None = None
    hodges_lehmann: float | None = None
    hodges_lehmann_ci95: Interval | None = None
    paired_p: float | None = None
    wilcoxon_p: float | None = None
    adjusted: float | None = None
    adjusted_ci95: Interval | None = None
    dz: float | None = None
    dz_ci95: Interval | None = None
    p: float | None = None
    period: float | None = None
    period_p: float | None = None
    carry_over_p: float | None = None


def estimate_effect(
    guided: np.ndarray, unguided: np.ndarray, guided_first: np.ndarray, pairs: np.ndarray
) -> GuidanceEffect:
    """Return the effect of guidance on one measure.

    Args:
        guided: One figure a person, `(P,)`; NaN where there is none.
        unguided: Likewise.
        guided_first: Who was guided in the first period, `(P,)` bool.
        pairs: Number of the pair in which each person's sequence was drawn, `(P,)`.
    """
    # A person with one condition only tells nothing about the difference.
    both = ~(np.isnan(guided) | np.isnan(unguided))
    guided, unguided, first = guided[both], unguided[both], np.asarray(guided_first, bool)[both]
    num, num_first = len(guided), int(first.sum())
    facts: dict = {}
    if num:
        facts |= {"guided": float(guided.mean()), "unguided": float(unguided.mean())}
    # Two persons are the least for a standard deviation.
    if num >= 2:
        facts |= _test_pairs(guided - unguided)
    # Each sequence needs two persons: the variance is pooled within sequences.
    if min(num_first, num - num_first) >= 2:
        facts |= _adjust_for_period(
            # First minus second period, whatever the condition was.
            np.where(first, guided - unguided, unguided - guided),
            guided + unguided,
            first,
            np.asarray(pairs)[both],
        )
    return GuidanceEffect(num_persons=num, num_guided_first=num_first, **facts)


def _test_pairs(difference: np.ndarray) -> dict:
    num, mean, std = len(difference), float(difference.mean()), float(difference.std(ddof=1))
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, num - 1)) * std / math.sqrt(num)
    facts = {
        "difference": mean,
        "paired_ci95": (mean - half, mean + half),
        "paired_p": float(permutation_tests.compute_paired_p(difference)),
        "wilcoxon_p": permutation_tests.compute_wilcoxon_p(difference),
        "hodges_lehmann": estimate_hodges_lehmann(difference)[0],
        "hodges_lehmann_ci95": estimate_hodges_lehmann(difference)[1],
    }
    # Equal differences have no scale: dz would be a division by rounding errors.
    if std > ROUNDING * float(np.abs(difference).max()):
        facts |= {
            "paired_dz": mean / std,
            "paired_dz_ci95": compute_dz_interval(mean / std, math.sqrt(num), num - 1),
        }
    return facts


def _adjust_for_period(
    period_difference: np.ndarray, total: np.ndarray, first: np.ndarray, pairs: np.ndarray
) -> dict:
    # Half the difference of the sequences is guidance, half their sum the period (see the
    # module).
    before, after = period_difference[first].mean(), period_difference[~first].mean()
    guidance, period = float(before - after) / 2, -float(before + after) / 2
    shape, free = math.sqrt(1 / first.sum() + 1 / (~first).sum()), len(first) - 2
    std = _pool_variance(period_difference, first)
    # Half, as guidance is half of the difference between the means.
    error = std * shape / 2
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, free)) * error
    facts: dict = {
        "adjusted": guidance,
        "adjusted_ci95": (guidance - half, guidance + half),
        "p": float(permutation_tests.compute_sequence_p(period_difference, first, pairs)),
        "period": period,
    }
    if std > 0:
        facts |= {
            "dz": guidance / std,
            "dz_ci95": compute_dz_interval(guidance / std, 2 / shape, free),
            "period_p": float(2 * stats.t.sf(abs(period / error), free)),
        }
    # Sums of both periods differ between sequences only by a carry-over.
    if (spread := _pool_variance(total, first)) > 0:
        apart = float(total[first].mean() - total[~first].mean())
        facts["carry_over_p"] = float(2 * stats.t.sf(abs(apart) / (spread * shape), free))
    return facts


def _pool_variance(values: np.ndarray, first: np.ndarray) -> float:
    """Return the standard deviation within sequences, 0 where it is rounding only."""
    squares = 0.0
    for part in (values[first], values[~first]):
        squares += float(((part - part.mean()) ** 2).sum())
    # Two means are estimated, one for each sequence.
    std = math.sqrt(squares / (len(values) - 2))
    return std if std > ROUNDING * float(np.abs(values).max()) else 0.0


def compute_dz_interval(dz: float, scale: float, free: int) -> Interval:
    """Return the 95 % interval of a standardised mean difference.

    The noncentralities under which t is just as far out as it may be (Cumming and Finch, Educ.
    Psychol. Meas. 61 (2001) 532-574).

    Args:
        dz: Mean over standard deviation.
        scale: t over dz: the root of the number of persons, for a paired difference.
        free: Degrees of freedom.
    """
    t = dz * scale

    def below(shift: float) -> float:
        share = float(stats.nct.cdf(t, free, shift))
        return share if math.isfinite(share) else float(shift < t)  # far out scipy gives NaN

    def bound(level: float) -> float:
        # With 1 degree of freedom it reaches to 2.24 t.
        low, high = t - 10.0 - 4.0 * abs(t), t + 10.0 + 4.0 * abs(t)
        return float(optimize.brentq(lambda shift: below(shift) - level, low, high)) / scale  # type: ignore[arg-type]

    return bound(0.5 + CONFIDENCE / 2), bound(0.5 - CONFIDENCE / 2)


def estimate_hodges_lehmann(difference: np.ndarray) -> tuple[float, Interval | None]:
    """Return the median of the means of all pairs, and its exact 95 % interval, `None` where so few persons allow none.

    Source: Hollander, Wolfe and Chicken, Nonparametric Statistical Methods, 2014, sections 3.2 and
    3.3.
    """
    num = len(difference)
    rows, columns = np.triu_indices(num)
    means = np.sort((difference[rows] + difference[columns]) / 2)
    ways = np.ones(1)  # in how many assignments ranks 1 … n add up to each sum
    for rank in range(1, num + 1):
        # The convolution adds each rank with both signs.
        ways = np.concatenate((ways, np.zeros(rank))) + np.concatenate((np.zeros(rank), ways))
    below = np.cumsum(ways) / 2.0**num
    # Sums so small occur in less than 2.5 %.
    cut = int(np.searchsorted(below, (1 - CONFIDENCE) / 2 + 1e-12, side="right"))
    interval = (float(means[cut - 1]), float(means[len(means) - cut])) if cut else None
    return float(np.median(means)), interval
