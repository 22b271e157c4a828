"""Statistics of a two-period crossover: effect of guidance, interval, exact tests, power.

Each person has one figure in each period. `first - second` holds plus or minus the effect of
guidance (by who was guided first) and the same effect of the period in both sequences, so that half
the difference of the sequences' means is guidance and half their sum the period (Hills and
Armitage, Br. J. Clin. Pharmacol. 8 (1979) 7-20). The p-value that decides is exact, over all draws
of the sequences as `study.design` makes them: one coin for each pair of persons.
Axes: `S` studies at once, `P` persons, `M` draws.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from brokk_rl.statistics import CONFIDENCE

MOST_DRAWS = 1 << 16
"""Draws of the sequences that are all counted; of more, as many are drawn by chance."""
ROUNDING = 1e-9
"""Relative difference below which two numbers count as equal."""
LARGE_DZ, SUFFICIENT_POWER = 0.8, 0.8
"""A large effect (Cohen 1988), and the usual share of studies that must find it."""
EFFECTS_DZ = (0.5, LARGE_DZ, 1.2)
"""A medium, a large and a very large effect, in standard deviations of a person's difference."""
NUM_STUDIES, MOST_PRODUCTS = 1000, 10_000_000
"""Studies drawn for each power, and fewer where there are so many draws to count."""


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
    first, difference = np.asarray(guided_first, bool)[both], (guided - unguided)[both]
    num, num_first = len(difference), int(first.sum())
    effect = GuidanceEffect(num, num_first)
    if num:
        means = float(guided[both].mean()), float(unguided[both].mean())
        effect = replace(effect, guided=means[0], unguided=means[1])
    if num < 2:
        return effect
    if min(num_first, num - num_first) < 2:
        mean, error, free = float(difference.mean()), float(stats.sem(difference)), num - 1
        return replace(effect, **_describe(mean, error, free, float(difference.std(ddof=1))))
    by_period = np.where(first, difference, -difference)
    before, after = by_period[first], by_period[~first]
    free = num - 2
    squares = ((before - before.mean()) ** 2).sum() + ((after - after.mean()) ** 2).sum()
    std = math.sqrt(float(squares) / free)
    # Guidance and period are half of a difference and half of a sum of two means.
    error = std * math.sqrt(1 / len(before) + 1 / len(after)) / 2
    guidance, period = (before.mean() - after.mean()) / 2, -(before.mean() + after.mean()) / 2
    facts = _describe(float(guidance), error, free, std)
    if facts["dz"] is not None:
        facts["period_p"] = float(2 * stats.t.sf(abs(period / error), free))
    p = float(compute_sequence_p(by_period[None], first, pairs[both])[0])
    return replace(effect, **facts, period=float(period), p=p)


def compute_sequence_p(
    by_period: np.ndarray, guided_first: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Return the two-sided p of guidance with the period in the model, `(S,)`.

    The statistic is the difference of the two sequences' means: practice shifts both alike and
    cancels. A draw that leaves one sequence empty counts as no difference.

    Args:
        by_period: First period minus the second, `(S, P)`.
        guided_first: Who was guided in the first period, `(P,)` bool.
        pairs: Number of the pair in which each person's sequence was drawn, `(P,)`.
    """
    numbers = np.unique(pairs, return_inverse=True)[1]
    num_pairs = int(numbers.max()) + 1
    if 1 << num_pairs <= MOST_DRAWS:
        coins = (np.arange(1 << num_pairs)[:, None] >> np.arange(num_pairs)) & 1
    else:
        coins = np.random.default_rng(0).integers(0, 2, (MOST_DRAWS, num_pairs))
        coins[0] = 0  # what was observed is one of them
    # The coin of a pair turns the sequences of both of it.
    first = coins[:, numbers].astype(bool) ^ guided_first
    num_first = first.sum(1, keepdims=True)
    num_second = first.shape[1] - num_first
    weights = np.where(first, 1 / np.maximum(num_first, 1), -1 / np.maximum(num_second, 1))
    weights = np.where((num_first > 0) & (num_second > 0), weights, 0.0)
    statistics = np.abs(by_period @ weights.T)
    limit = statistics[:, :1] - ROUNDING * np.abs(by_period).max(1, keepdims=True)
    return (statistics >= limit).mean(1)


def get_smallest_p(num_pairs: int) -> float:
    """Return the smallest two-sided p over the draws of so many pairs of persons."""
    return min(1.0, 2.0 / 2**num_pairs)


def find_smallest_size(alpha: float) -> int:
    """Return the smallest number of persons with which the test can reach `alpha`."""
    num_pairs = math.ceil(1 - math.log2(alpha))
    return 2 * num_pairs - 1


def estimate_power(num_persons: int, dz: float, alpha: float) -> float:
    """Return the share of studies of `num_persons` that find an effect of `dz`."""
    persons = np.arange(num_persons)
    first, pairs = persons % 2 == 0, persons // 2
    num_draws = min(MOST_DRAWS, 1 << (num_persons + 1) // 2)
    num_studies = min(NUM_STUDIES, MOST_PRODUCTS // num_draws)
    # Seeded by the size: a table is the same each time.
    chance = np.random.default_rng(num_persons).standard_normal((num_studies, num_persons))
    p = compute_sequence_p(chance + np.where(first, dz, -dz), first, pairs)
    return float((p <= alpha).mean())


def adjust_by_holm(p: np.ndarray) -> np.ndarray:
    """Return p-values after Holm's correction (Scand. J. Statist. 6 (1979) 65-70); NaN is not counted."""
    adjusted = np.full_like(p, np.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    steps = p[order] * (len(order) - np.arange(len(order)))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(steps))
    return adjusted


def _describe(
    mean: float, error: float, free: int, std: float
) -> dict[str, float | tuple[float, float] | None]:
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, free)) * error
    # Equal differences have no scale: dz would be a division by rounding errors.
    dz = mean / std if std > ROUNDING * abs(mean) else None
    return {"difference": mean, "ci95": (mean - half, mean + half), "dz": dz}
