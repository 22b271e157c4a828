"""Exact tests by counting: what would have come out had the design's coin fallen otherwise, over all the ways it could have fallen.

No distribution is assumed. Two coins are possible: which of a person's two conditions is called
guided (`flips`, the paired test), and which persons had the guided condition first (`sequences`,
the draw that was really made; it keeps what practice does, because that stays with the period).
Axes: `S` studies at once, `P` persons, `M` ways.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy import stats

MOST_WAYS = 300_000
"""Ways that are all counted; of more so many are drawn, and the p-value is that of a Monte-Carlo
test."""
MANY_WAYS = 20_000
"""Ways drawn where there are more."""
ROUNDING = 1e-9
"""Statistics this close, relative to their size, are equal."""
CHUNK = 8_000_000
"""Numbers held at once."""


def num_flips(num_persons: int) -> int:
    """Returns in how many ways the two conditions of each of `num_persons` could have been exchanged."""
    return 2**num_persons


def num_sequences(num_guided_first: int, num_persons: int) -> int:
    """Returns in how many ways `num_guided_first` of `num_persons` could have been drawn."""
    return math.comb(num_persons, num_guided_first)


def smallest_paired_p(num_persons: int) -> float:
    """Returns the least two-sided p that an exact paired test can give: all differences of one sign."""
    return min(1.0, 2.0 / num_flips(num_persons)) if num_persons else 1.0


def smallest_sequence_p(num_guided_first: int, num_persons: int) -> float:
    """Returns the least two-sided p of the test over sequences: the most extreme draw, and where sequences are equal its mirror."""
    ways = num_sequences(num_guided_first, num_persons)
    return min(1.0, (2.0 if 2 * num_guided_first == num_persons else 1.0) / ways)


def paired_p(difference: np.ndarray) -> np.ndarray:
    """Returns the two-sided p of the paired permutation test of the mean difference, for `(…, P)` differences.

    Source: Fisher, The Design of Experiments, 1935, section 21.
    """
    difference = np.asarray(difference, float)
    return _two_sided(difference, _flips(difference.shape[-1]))


def wilcoxon_p(difference: np.ndarray) -> float:
    """Returns the two-sided exact p of Wilcoxon's signed-rank test, for `(P,)` differences; zeros are left out, ties share a rank.

    Exact also with ties, where tables and most packages are not.
    """
    difference = np.asarray(difference, float)
    difference = difference[difference != 0]
    if not len(difference):
        return 1.0
    return float(paired_p(np.sign(difference) * stats.rankdata(np.abs(difference))))


def sequence_p(period_difference: np.ndarray, guided_first: np.ndarray) -> np.ndarray:
    """Returns the two-sided p of guidance with the period in the model, for `(…, P)` differences first period minus second.

    The difference of the two sequences' means over all draws of the same size; practice shifts both
    sequences alike and drops out. The permutation counterpart of Hills and Armitage, Br. J. Clin.
    Pharmacol. 8 (1979) 7-20, equation for the treatment effect.
    """
    first = np.asarray(guided_first, bool)
    num, num_first = len(first), int(first.sum())
    if not 0 < num_first < num:
        raise ValueError(
            "both sequences must occur: with one alone guidance and order cannot be told apart"
        )
    weights = np.where(_draws(num, num_first), 1.0 / num_first, -1.0 / (num - num_first))
    own = np.where(first, 1.0 / num_first, -1.0 / (num - num_first))
    return _two_sided(np.asarray(period_difference, float), weights, own)


def holm(p: np.ndarray) -> np.ndarray:
    """Returns p-values adjusted for looking at all of them (Holm, Scand. J. Statist. 6 (1979) 65-70); NaN stays NaN, uncounted."""
    p = np.asarray(p, float)
    adjusted = np.full_like(p, np.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    steps = p[order] * (len(order) - np.arange(len(order)))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(steps)) if len(order) else steps
    return adjusted


def _two_sided(
    values: np.ndarray, weights: np.ndarray, own: np.ndarray | None = None
) -> np.ndarray:
    """Returns the share of ways, `(M, P)` weights, whose statistic is as far from 0 as that of `own` (all ones where not given)."""
    num = values.shape[-1]
    rows = values.reshape(-1, num)
    observed = np.abs(rows @ (np.ones(num) / num if own is None else own))
    limit = observed - ROUNDING * np.maximum(np.abs(rows).max(1, initial=0.0), 1e-300)
    count = np.zeros(len(rows))
    step = max(1, CHUNK // max(1, len(rows)))
    for start in range(0, len(weights), step):
        count += (np.abs(rows @ weights[start : start + step].T) >= limit[:, None]).sum(1)
    drawn = len(weights) == MANY_WAYS
    return ((count + drawn) / (len(weights) + drawn)).reshape(values.shape[:-1])


@lru_cache(maxsize=16)
def _flips(num: int) -> np.ndarray:
    if num_flips(num) > MOST_WAYS:
        return np.random.default_rng(0).choice((-1.0, 1.0), (MANY_WAYS, num)) / num
    return (1.0 - 2.0 * ((np.arange(num_flips(num))[:, None] >> np.arange(num)) & 1)) / max(1, num)


@lru_cache(maxsize=16)
def _draws(num: int, num_first: int) -> np.ndarray:
    """Returns which persons begin guided, `(M, P)` bool."""
    if num_sequences(num_first, num) > MOST_WAYS:
        return np.random.default_rng(0).random((MANY_WAYS, num)).argsort(1) < num_first
    chosen = np.array(list(combinations(range(num), num_first)))
    drawn = np.zeros((len(chosen), num), bool)
    drawn[np.arange(len(chosen))[:, None], chosen] = True
    return drawn
