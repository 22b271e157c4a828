"""Exact permutation tests: the observed statistic among all assignments of the design.

No distribution is assumed. Two kinds of assignment are possible: exchange of a person's two
conditions (`flips`, the paired test), and the draw of the sequences as `study.design` makes
it: one coin for each pair of persons, whose second gets the other sequence. A person whose partner
dropped out keeps the coin. The second test keeps the effect of practice, which stays with the
period. scipy's permutation test handles one study at a time; here thousands of simulated studies
share one table of assignments.
Axes: `S` studies at once, `P` persons, `M` assignments.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import stats

MOST_WAYS = 300_000
"""Largest number of assignments that are all counted; above it the test is a Monte-Carlo test.
Chosen by hand: 300,000 rows of 20 persons take 50 MB."""
MANY_WAYS = 20_000
"""Assignments drawn by the Monte-Carlo test; the p-value is then exact to about 0.002."""
ROUNDING = 1e-9
"""Relative difference below which two statistics count as equal; above rounding of float64 sums."""
CHUNK = 8_000_000
"""Largest number of products held in memory at once, 64 MB."""


def count_flips(num_persons: int) -> int:
    """Return the number of exchanges of the two conditions over `num_persons`."""
    return 2**num_persons


def count_sequences(num_pairs: int) -> int:
    """Return the number of draws of the sequences of `num_pairs` pairs, whole or not."""
    return 2**num_pairs


def get_smallest_paired_p(num_persons: int) -> float:
    """Return the smallest two-sided p of an exact paired test: all differences of one sign."""
    return min(1.0, 2.0 / count_flips(num_persons)) if num_persons else 1.0


def get_smallest_sequence_p(num_pairs: int) -> float:
    """Return the smallest two-sided p of the test over sequences: the extreme draw and its mirror.

    Args:
        num_pairs: Pairs of which at least one person is left.
    """
    return min(1.0, 2.0 / count_sequences(num_pairs))


def compute_paired_p(difference: np.ndarray) -> np.ndarray:
    """Return the two-sided p of the paired permutation test, for `(…, P)` differences.

    Source: Fisher, The Design of Experiments, 1935, section 21.
    """
    difference = np.asarray(difference, float)
    return _count_two_sided(difference, _list_flips(difference.shape[-1]))


def compute_wilcoxon_p(difference: np.ndarray) -> float:
    """Return the two-sided exact p of Wilcoxon's signed-rank test, for `(P,)` differences.

    Zeros are left out and ties share a rank. The result is exact with ties too, unlike that of
    tables and most packages.
    """
    difference = np.asarray(difference, float)
    difference = difference[difference != 0]
    if not len(difference):
        return 1.0
    return float(compute_paired_p(np.sign(difference) * stats.rankdata(np.abs(difference))))


def compute_sequence_p(
    period_difference: np.ndarray, guided_first: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Return the two-sided p of guidance with the period in the model.

    The statistic is the difference of the two sequences' means. Practice shifts both alike and
    cancels; a draw that leaves one sequence empty counts as no difference. The permutation
    counterpart of Hills and Armitage, Br. J. Clin. Pharmacol. 8 (1979) 7-20, equation for the
    treatment effect.

    Args:
        period_difference: First period minus the second, `(…, P)`.
        guided_first: Who was guided in the first period, `(P,)` bool.
        pairs: Number of the pair in which each person's sequence was drawn, `(P,)`.

    Raises:
        ValueError: only one sequence occurs.
    """
    first = np.asarray(guided_first, bool)
    if first.all() or not first.any():
        raise ValueError(
            "both sequences must occur: with one alone guidance and order cannot be told apart"
        )
    numbers = np.unique(np.asarray(pairs), return_inverse=True)[1]
    weights = _list_draws(tuple(first.tolist()), tuple(numbers.tolist()))
    own = _weigh_sequences(first[None])[0]
    return _count_two_sided(np.asarray(period_difference, float), weights, own)


def adjust_by_holm(p: np.ndarray) -> np.ndarray:
    """Return p-values after Holm's correction; NaN stays NaN and is not counted.

    Source: Holm, Scand. J. Statist. 6 (1979) 65-70.
    """
    p = np.asarray(p, float)
    adjusted = np.full_like(p, np.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    steps = p[order] * (len(order) - np.arange(len(order)))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(steps)) if len(order) else steps
    return adjusted


def _count_two_sided(
    values: np.ndarray, weights: np.ndarray, own: np.ndarray | None = None
) -> np.ndarray:
    """Return the share of assignments with a statistic at least as extreme as the observed one.

    Args:
        values: One value for each person, `(…, P)`.
        weights: Weights of the persons in each assignment, `(M, P)`.
        own: Weights of the observed assignment; `None` for the plain mean.
    """
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
def _list_flips(num: int) -> np.ndarray:
    if count_flips(num) > MOST_WAYS:
        return np.random.default_rng(0).choice((-1.0, 1.0), (MANY_WAYS, num)) / num
    return (1.0 - 2.0 * ((np.arange(count_flips(num))[:, None] >> np.arange(num)) & 1)) / max(
        1, num
    )


@lru_cache(maxsize=16)
def _list_draws(guided_first: tuple[bool, ...], pairs: tuple[int, ...]) -> np.ndarray:
    """Return the weights of the persons in each draw of the sequences, `(M, P)`."""
    num_pairs = max(pairs) + 1
    if count_sequences(num_pairs) > MOST_WAYS:
        coins = np.random.default_rng(0).integers(0, 2, (MANY_WAYS, num_pairs))
    else:
        coins = (np.arange(count_sequences(num_pairs))[:, None] >> np.arange(num_pairs)) & 1
    # The coin of a pair turns the sequences of both of it.
    return _weigh_sequences(coins[:, list(pairs)].astype(bool) ^ np.array(guided_first))


def _weigh_sequences(first: np.ndarray) -> np.ndarray:
    """Return weights whose products with values are the difference of the sequences' means, `(M, P)`."""
    num_first = first.sum(1, keepdims=True)
    num_second = first.shape[1] - num_first
    both = (num_first > 0) & (num_second > 0)
    weights = np.where(first, 1.0 / np.maximum(num_first, 1), -1.0 / np.maximum(num_second, 1))
    return np.where(both, weights, 0.0)
