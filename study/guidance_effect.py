"""Statistics of a two-period crossover: effect of guidance, interval, exact test, power.

Each person has one figure a condition, and the two conditions are done in two periods. A linear
model with a term for each person, for guidance and for the second period gives the effect and its
interval (Senn, Cross-over Trials in Clinical Research, 2nd ed. 2002, chapter 3). Where nothing is
missing this is the mixed model with random persons. The p-value that decides is exact, over all
draws of the sequences as `study.design` makes them: one coin for each pair of persons.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# The stubs of pandas and SciPy name more types than are returned here.

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import stats

from brokk_rl.statistics import CONFIDENCE

MOST_DRAWS = 1 << 16
"""Draws of the sequences that are all counted; of more, as many are drawn by chance."""
ROUNDING_DIGITS = 9
"""Decimals, over the largest value, to which two numbers have to agree to count as equal."""
LARGE_DZ, SUFFICIENT_POWER = 0.8, 0.8
"""A large effect (Cohen 1988), and the usual share of studies that must find it."""
NUM_STUDIES, NUM_DRAWS = 1000, 2000
"""Studies drawn for each power, and draws of the sequences in each: p near 0.05 within 0.01."""


@dataclass(frozen=True)
class GuidanceEffect:
    """Guidance against no guidance in one measure; `None` where too few persons have both.

    Attributes:
        num_persons: Persons with both conditions.
        num_guided_first: Of those, who were guided in the first period.
        guided: Mean with guidance.
        unguided: Mean without.
        difference: Guided minus unguided, with the period in the model where both sequences occur
            twice.
        ci95: Student's interval of it.
        dz: The difference over the standard deviation of a person's difference.
        p: Exact test over sequences: the one that counts. `None` where order and guidance cannot be
            told apart.
        period: Second period minus first, by practice or fatigue.
        period_p: Student's test of it.
    """

    num_persons: int
    num_guided_first: int
    guided: float | None = None
    unguided: float | None = None
    difference: float | None = None
    ci95: tuple[float, float] | None = None
    dz: float | None = None
    p: float | None = None
    period: float | None = None
    period_p: float | None = None


def estimate_effect(means: pd.DataFrame, measure: str) -> GuidanceEffect:
    """Return the effect of guidance on one measure.

    Args:
        means: A row for each person and condition with `participant`, `pair` (number of the pair in
            which the sequence was drawn), `condition`, `period` and the measures.
        measure: Column of the measure; NaN where a person has none.
    """
    from statsmodels.regression.linear_model import OLS  # takes 2 s, which only a report needs

    known = means.dropna(subset=[measure])
    # A person with one condition only tells nothing about the difference.
    known = known[known.duplicated("participant", keep=False)].sort_values("participant")
    guided, unguided = known[known.condition == "guided"], known[known.condition == "unguided"]
    guided_first = (guided.period == 1).to_numpy()
    num, num_first = len(guided), int(guided_first.sum())
    if num < 2:
        return GuidanceEffect(num, num_first)
    terms = pd.get_dummies(known.participant, dtype=float)
    terms["guided"] = (known.condition == "guided").astype(float)
    has_both_orders = min(num_first, num - num_first) >= 2
    if has_both_orders:
        terms["second"] = (known.period == 2).astype(float)
    fit = OLS(known[measure].astype(float), terms).fit()
    # A person's difference has twice the variance of one figure.
    std, difference = math.sqrt(2 * fit.scale), float(fit.params["guided"])
    # Equal differences have no scale: dz would be a division by rounding errors.
    has_scale = std > 10.0**-ROUNDING_DIGITS * abs(difference)
    low, high = fit.conf_int(1 - CONFIDENCE).loc["guided"]
    effect = GuidanceEffect(
        num,
        num_first,
        guided=float(guided[measure].mean()),
        unguided=float(unguided[measure].mean()),
        difference=difference,
        ci95=(float(low), float(high)),
        dz=difference / std if has_scale else None,
    )
    if not has_both_orders:
        return effect
    by_period = guided[measure].to_numpy() - unguided[measure].to_numpy()
    by_period = np.where(guided_first, by_period, -by_period)
    return replace(
        effect,
        p=compute_sequence_p(by_period, guided_first, guided.pair.to_numpy()),
        period=float(fit.params["second"]),
        period_p=float(fit.pvalues["second"]) if has_scale else None,
    )


def compute_sequence_p(by_period: np.ndarray, guided_first: np.ndarray, pairs: np.ndarray) -> float:
    """Return the two-sided p of guidance over all draws of the sequences.

    The coin of a pair turns the sequences of both of it. The statistic is the difference of the two
    sequences' means: practice shifts both alike and cancels.

    Args:
        by_period: First period minus the second, `(P,)`.
        guided_first: Who was guided in the first period, `(P,)` bool.
        pairs: Number of the pair in which each person's sequence was drawn, `(P,)`.
    """
    rows = np.unique(pairs, return_inverse=True)[1]
    # A row of the table is a pair; a partner that is lost leaves NaN.
    table = np.full((rows.max() + 1, 2), np.nan)
    table[rows, np.where(guided_first, 0, 1)] = by_period / max(np.abs(by_period).max(), 1e-300)
    return float(_permute_sequences(table[:, 0], table[:, 1], MOST_DRAWS))


def get_smallest_p(num_pairs: int) -> float:
    """Return the smallest two-sided p over the draws of so many pairs of persons."""
    return min(1.0, 2.0 / 2**num_pairs)


def find_smallest_size(alpha: float) -> int:
    """Return the smallest number of persons with which the test can reach `alpha`."""
    num_pairs = math.ceil(1 - math.log2(alpha))
    return 2 * num_pairs - 1


def estimate_power(num_persons: int, dz: float, alpha: float) -> float:
    """Return the share of studies of `num_persons` that find an effect of `dz`."""
    num_pairs = (num_persons + 1) // 2
    if get_smallest_p(num_pairs) > alpha:
        return 0.0
    # Seeded by the size: a table is the same each time.
    chance = np.random.default_rng(num_persons).standard_normal((NUM_STUDIES, num_pairs, 2))
    if num_persons % 2:
        chance[:, -1, 1] = np.nan
    p = _permute_sequences(chance[..., 0] + dz, chance[..., 1] - dz, NUM_DRAWS)
    return float((p <= alpha).mean())


def adjust_by_holm(
    effects: Mapping[str, GuidanceEffect], family: Iterable[str]
) -> dict[str, float]:
    """Return p of a family after Holm's correction (Scand. J. Statist. 6 (1979) 65-70), where there is one."""
    from statsmodels.stats.multitest import multipletests

    p = {name: effects[name].p for name in family if effects[name].p is not None}
    adjusted = np.asarray(multipletests(list(p.values()), method="holm")[1]) if p else ()
    return dict(zip(p, map(float, adjusted), strict=True))


def _permute_sequences(first: np.ndarray, other: np.ndarray, num_draws: int) -> np.ndarray:
    """Return p of the pairs on the last axis, all draws where there are at most `num_draws`."""
    test = stats.permutation_test(
        (first, other),
        _compare_means,
        permutation_type="samples",
        n_resamples=num_draws,
        batch=256,
        axis=-1,
        rng=0,
    )
    return np.asarray(test.pvalue)


def _compare_means(first: np.ndarray, other: np.ndarray, axis: int) -> np.ndarray:
    """Return the difference of two means over what is not NaN, 0 where one of them has nothing."""
    num_first, num_other = (~np.isnan(first)).sum(axis), (~np.isnan(other)).sum(axis)
    difference = np.nansum(first, axis) / np.maximum(num_first, 1)
    difference = difference - np.nansum(other, axis) / np.maximum(num_other, 1)
    # Draws that only rounding tells apart are equal.
    return np.where((num_first > 0) & (num_other > 0), difference, 0.0).round(ROUNDING_DIGITS)
