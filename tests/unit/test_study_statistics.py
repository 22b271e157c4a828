"""Exact tests, effects and intervals of a study, against scipy, published tables and numbers worked by hand."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from scipy import stats

from study import permutation_tests, sample_size
from study.crossover_analysis import compute_dz_interval, estimate_effect, estimate_hodges_lehmann
from study.design import Design, Hole, Success, draw_sequences
from study.practice import Practice, share_significant

DARWIN = np.array([49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48], float)
"""Darwin's maize, eighths of an inch; Fisher 1935 counted by hand that 1726 of 32768 flips are as
extreme: p = 0.0527."""
PEOPLE = Practice(
    base_s=60.0,
    skill_sd=0.3,
    hole_sd=0.1,
    learning=0.37,
    learning_sd=0.08,
    guidance_sd=0.1,
    chance_sd=0.25,
)


def test_the_paired_test_counts_what_fisher_counted() -> None:
    assert permutation_tests.compute_paired_p(DARWIN) == pytest.approx(1726 / 32768, abs=1e-12)


def test_tests_agree_with_scipys_permutations() -> None:
    rng = np.random.default_rng(3)
    difference = rng.normal(0.6, 1.0, 9)
    paired = stats.permutation_test(
        (difference,),
        lambda x, axis: x.mean(axis),
        permutation_type="samples",
        n_resamples=np.inf,
        vectorized=True,
    )
    assert permutation_tests.compute_paired_p(difference) == pytest.approx(paired.pvalue)
    assert permutation_tests.compute_wilcoxon_p(difference) == pytest.approx(
        stats.wilcoxon(difference, method="exact").pvalue
    )


def test_wilcoxon_with_ties_counts_midranks() -> None:
    # |d| = 1 1 2: ranks 1.5 1.5 3, sum of signed ranks 6 is the largest; 2 of 8 sign patterns are
    # as extreme
    assert permutation_tests.compute_wilcoxon_p(np.array([1.0, 1.0, 2.0, 0.0])) == 0.25
    assert permutation_tests.compute_wilcoxon_p(np.zeros(4)) == 1.0


def test_five_persons_cannot_reach_five_percent_and_six_can() -> None:
    assert (
        permutation_tests.get_smallest_paired_p(5)
        == 0.0625
        == permutation_tests.compute_paired_p(np.arange(1.0, 6.0))
    )
    assert permutation_tests.get_smallest_paired_p(6) == 0.03125
    pairs = np.arange(8) // 2
    first = np.arange(8) % 2 == 0
    extreme = np.where(first, 1.0, -1.0) + 0.01 * np.arange(8)
    assert (
        permutation_tests.get_smallest_sequence_p(4)
        == 0.125
        == permutation_tests.compute_sequence_p(extreme, first, pairs)
    )
    assert permutation_tests.get_smallest_sequence_p(6) == 2 / 64
    assert sample_size.find_smallest_sizes(0.05) == (6, 11)


def build_design(num_participants: int) -> Design:
    holes = {name: Hole(center_in_base_m=(2.5, 0.0, 0.75), radius_m=0.05) for name in "ab"}
    return Design(
        num_participants=num_participants, order="counterbalanced", holes=holes, starts={"a": (), "b": ()}, practice_trials=0,
        practice_minutes=1.0, limit_s=150.0, success=Success(depth_m=0.1, clearance_m=0.01), primary="time_s", alpha=0.05,
    )  # fmt: skip


class Coins:
    """Gives the coins of a draw, one after the other."""

    def __init__(self, coins: tuple[int, ...]) -> None:
        self._left = list(coins)

    def integers(self, end: int) -> int:
        return self._left.pop(0)


def list_first(design: Design, left: list[int]) -> list[np.ndarray]:
    """Who begins guided in each draw that the plan could have made, of those who are left."""
    found = []
    for coins in product((0, 1), repeat=(design.num_participants + 1) // 2):
        drawn = draw_sequences(design, Coins(coins))  # type: ignore[arg-type]
        first = np.array([one[0] == "guided" for one in drawn.values()])
        found.append(first[left])
    return found


def compare_sequences(values: np.ndarray, first: np.ndarray) -> float:
    """Difference of the means; 0 where a sequence is empty."""
    if first.all() or not first.any():
        return 0.0
    return abs(float(values[first].mean() - values[~first].mean()))


@pytest.mark.parametrize(
    ("num", "dropped"),
    [(8, ()), (9, ()), (8, (3,)), (10, (0, 1)), (10, (0, 3, 4, 8)), (7, (6,)), (5, (1, 3))],
)
def test_sequences_are_permuted_as_the_plan_draws_them(num: int, dropped: tuple[int, ...]) -> None:
    design = build_design(num)
    left = [one for one in range(num) if one not in dropped]
    draws = list_first(design, left)
    pairs = np.array(left) // 2
    values = np.random.default_rng(num).normal(size=len(left)) + 3.0
    found = []
    for first in draws:
        if first.all() or not first.any():
            continue
        observed = compare_sequences(values, first)
        expected = np.mean([compare_sequences(values, one) >= observed - 1e-9 for one in draws])
        p = permutation_tests.compute_sequence_p(values, first, pairs)
        assert p == pytest.approx(expected)
        found.append(float(p))
    least = permutation_tests.get_smallest_sequence_p(len(set(pairs.tolist())))
    assert min(found) == pytest.approx(least)
    # Without an effect the values stay and the draw varies: no level is exceeded.
    for level in sorted(set(found)):
        assert sum(p <= level + 1e-12 for p in found) / len(draws) <= level + 1e-12


def test_many_studies_at_once_are_those_one_by_one() -> None:
    rows, first = np.random.default_rng(0).normal(size=(4, 8)), np.arange(8) % 2 == 0
    pairs = np.arange(8) // 2
    assert permutation_tests.compute_sequence_p(rows, first, pairs).tolist() == [
        float(permutation_tests.compute_sequence_p(row, first, pairs)) for row in rows
    ]
    with pytest.raises(ValueError, match="both sequences"):
        permutation_tests.compute_sequence_p(rows, np.ones(8, bool), pairs)


def test_more_ways_than_can_be_counted_are_drawn() -> None:
    difference = np.random.default_rng(1).normal(0.3, 1.0, 30)
    many = np.random.default_rng(2).normal(0.2, 1.0, 50)
    first = np.arange(50) % 2 == 0
    # Normal differences and many pairs: close to the paired t test over pairs.
    found = permutation_tests.compute_sequence_p(many, first, np.arange(50) // 2)
    assert found == pytest.approx(stats.ttest_rel(many[::2], many[1::2]).pvalue, abs=0.02)
    assert permutation_tests.compute_paired_p(difference) == pytest.approx(
        stats.ttest_1samp(difference, 0.0).pvalue, abs=0.02
    )


def test_holm_is_worked_by_hand() -> None:
    # sorted 0.005 0.01 0.03 0.04, times 4 3 2 1: 0.02 0.03 0.06 0.04, never falling: 0.06
    assert permutation_tests.adjust_by_holm(
        np.array([0.01, 0.04, np.nan, 0.03, 0.005])
    ).tolist() == pytest.approx([0.03, 0.06, math.nan, 0.06, 0.02], nan_ok=True)


def test_hodges_lehmann_is_that_of_hollander_and_wolfe() -> None:
    # Hamilton's depression scale, example 3.1 (R: wilcox.test(x, y, paired=TRUE, conf.int=TRUE)):
    # estimate 0.46, 96.1 % interval from 0.01 to 0.786; exact signed-rank p of 0.0391 (two-sided)
    x = np.array([1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30])
    y = np.array([0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29])
    middle, interval = estimate_hodges_lehmann(x - y)
    assert middle == pytest.approx(0.46)
    assert interval == pytest.approx((0.01, 0.786))
    assert permutation_tests.compute_wilcoxon_p(x - y) == pytest.approx(0.0390625)
    assert estimate_hodges_lehmann(np.arange(5.0))[1] is None


def test_the_interval_of_dz_turns_back_into_t() -> None:
    low, high = compute_dz_interval(0.8, 4.0, 15)
    assert stats.nct.cdf(3.2, 15, 4 * low) == pytest.approx(0.975)
    assert stats.nct.cdf(3.2, 15, 4 * high) == pytest.approx(0.025)
    # Two persons who agree: almost anything is possible.
    low, high = compute_dz_interval(-300.0, math.sqrt(2), 1)
    assert low < -600 and -40 < high < 0


def test_guidance_and_period_come_apart() -> None:
    # each person: 50 s, second period 8 s faster, guidance 5 s faster, and own deviations that
    # cancel within each sequence
    first = np.array([True, True, True, False, False, False])
    own = np.array([-1.0, 0.0, 1.0, 2.0, 0.0, -2.0])
    guided = 50.0 - 5.0 - 8.0 * ~first + own
    unguided = 50.0 - 8.0 * first
    found = estimate_effect(guided, unguided, first, np.array([0, 1, 2, 0, 1, 2]))
    assert found.adjusted == pytest.approx(-5.0) and found.period == pytest.approx(-8.0)
    # Sequences are equal, so practice cancels in the mean …
    assert found.difference == pytest.approx(-5.0)
    assert found.paired_dz is not None and found.dz is not None
    # … not in the spread.
    assert found.dz == pytest.approx(-5.0 / math.sqrt((2 + 8) / 4)) and abs(found.paired_dz) < abs(
        found.dz
    )
    assert found.p == pytest.approx(2 / 8) and found.adjusted_ci95 is not None
    half = stats.t.ppf(0.975, 4) * math.sqrt(2.5) / 2 * math.sqrt(2 / 3)
    assert found.adjusted_ci95 == pytest.approx((-5 - half, -5 + half))
    test = stats.ttest_ind((guided - unguided)[first], (unguided - guided)[~first])
    carried = stats.ttest_ind((guided + unguided)[first], (guided + unguided)[~first])
    assert found.carry_over_p == pytest.approx(carried.pvalue)
    assert 2 * stats.t.sf(5 / (half / stats.t.ppf(0.975, 4)), 4) == pytest.approx(test.pvalue)


def test_with_one_sequence_nothing_is_said_about_guidance_apart_from_order() -> None:
    found = estimate_effect(
        np.arange(6.0), np.arange(6.0) ** 2, np.ones(6, bool), np.arange(6) // 2
    )
    assert found.p is None and found.adjusted is None and found.paired_p is not None
    assert (
        estimate_effect(np.full(3, np.nan), np.ones(3), np.ones(3, bool), np.arange(3)).difference
        is None
    )


def test_without_effect_a_counterbalanced_study_errs_as_often_as_it_says_and_one_of_fixed_order_nearly_always() -> (
    None
):
    fair = share_significant(PEOPLE, 16, 5, 4, 150.0, 0.0, 0.05, 1000, seed=5)
    fixed = share_significant(PEOPLE, 12, 5, 4, 150.0, 0.0, 0.05, 300, seed=5, fixed=True)
    assert fair["share"] <= 0.065
    assert fixed["share"] > 0.8


def test_a_large_effect_is_found_by_sixteen() -> None:
    found = share_significant(PEOPLE, 16, 5, 4, 150.0, 0.8, 0.05, 500, seed=5)
    assert found["share"] >= 0.8
    # Of the t test over the eight pairs: their differences have mean 2 dz and variance 2.
    power = stats.nct.sf(stats.t.ppf(0.975, 7), 7, 2 * 0.8 / math.sqrt(2) * math.sqrt(8))
    assert sample_size.evaluate_size(16, 0.05).power[1] == pytest.approx(power, abs=0.04)
