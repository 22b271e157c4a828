"""Exact tests, effects and intervals of a study, against scipy, published tables and numbers worked by hand."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from scipy import stats

from study import crossover
from study.crossover import estimate_effect
from study.design import Design, Hole, Success, draw_sequences


def test_five_pairs_cannot_reach_five_percent_and_six_can() -> None:
    assert crossover.get_smallest_p(5) == 0.0625
    assert crossover.get_smallest_p(6) == 0.03125
    first, pairs = np.arange(8) % 2 == 0, np.arange(8) // 2
    extreme = np.where(first, 1.0, -1.0) + 0.01 * np.arange(8)
    assert crossover.compute_sequence_p(extreme[None], first, pairs)[0] == 0.125
    assert crossover.find_smallest_size(0.05) == 11
    assert crossover.find_smallest_size(0.0625) == 9


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
        p = crossover.compute_sequence_p(values[None], first, pairs)[0]
        assert p == pytest.approx(expected)
        found.append(float(p))
    least = crossover.get_smallest_p(len(set(pairs.tolist())))
    assert min(found) == pytest.approx(least)
    # Without an effect the values stay and the draw varies: no level is exceeded.
    for level in sorted(set(found)):
        assert sum(p <= level + 1e-12 for p in found) / len(draws) <= level + 1e-12


def test_more_draws_than_can_be_counted_are_drawn() -> None:
    first, pairs = np.arange(40) % 2 == 0, np.arange(40) // 2
    values = np.random.default_rng(2).normal(size=40) + np.where(first, 0.4, -0.4)
    p = crossover.compute_sequence_p(values[None], first, pairs)[0]
    # The t test over the pairs is close to the exact one at this size.
    apart = values[first] - values[~first]
    assert p == pytest.approx(stats.ttest_1samp(apart, 0.0).pvalue, abs=0.01)


def test_holm_is_worked_by_hand() -> None:
    # sorted 0.005 0.01 0.03 0.04, times 4 3 2 1: 0.02 0.03 0.06 0.04, never falling: 0.06
    assert crossover.adjust_by_holm(
        np.array([0.01, 0.04, np.nan, 0.03, 0.005])
    ).tolist() == pytest.approx([0.03, 0.06, math.nan, 0.06, 0.02], nan_ok=True)


def test_guidance_and_period_come_apart() -> None:
    # each person: 50 s, second period 8 s faster, guidance 5 s faster, and own deviations that
    # cancel within each sequence
    first = np.array([True, True, True, False, False, False])
    own = np.array([-1.0, 0.0, 1.0, 2.0, 0.0, -2.0])
    guided = 50.0 - 5.0 - 8.0 * ~first + own
    unguided = 50.0 - 8.0 * first
    found = estimate_effect(guided, unguided, first, np.array([0, 1, 2, 0, 1, 2]))
    assert found.difference == pytest.approx(-5.0) and found.period == pytest.approx(-8.0)
    assert found.dz == pytest.approx(-5.0 / math.sqrt((2 + 8) / 4))
    assert found.p == pytest.approx(2 / 8) and found.ci95 is not None
    half = stats.t.ppf(0.975, 4) * math.sqrt(2.5) / 2 * math.sqrt(2 / 3)
    assert found.ci95 == pytest.approx((-5 - half, -5 + half))
    test = stats.ttest_ind((guided - unguided)[first], (guided - unguided)[~first])
    assert found.period_p == pytest.approx(test.pvalue)


def test_with_one_sequence_nothing_is_said_about_guidance_apart_from_order() -> None:
    guided, unguided = np.arange(6.0), np.arange(6.0) ** 2
    found = estimate_effect(guided, unguided, np.ones(6, bool), np.arange(6) // 2)
    assert found.p is None and found.period is None
    test = stats.ttest_1samp(guided - unguided, 0.0)
    assert found.ci95 == pytest.approx(tuple(test.confidence_interval()))
    none = estimate_effect(np.full(3, np.nan), np.ones(3), np.ones(3, bool), np.arange(3))
    assert none == crossover.GuidanceEffect(0, 0)
    same = estimate_effect(np.ones(4), np.zeros(4), np.arange(4) % 2 == 0, np.arange(4) // 2)
    assert (same.difference, same.dz, same.period_p) == (1.0, None, None)


def test_power_is_that_of_the_t_test_over_pairs() -> None:
    # Differences of the eight pairs have mean 2 dz and variance 2.
    power = stats.nct.sf(stats.t.ppf(0.975, 7), 7, 2 * 0.8 / math.sqrt(2) * math.sqrt(8))
    assert crossover.estimate_power(16, 0.8, 0.05) == pytest.approx(power, abs=0.04)
    assert crossover.estimate_power(16, 0.0, 0.05) <= 0.065
    assert crossover.estimate_power(8, 3.0, 0.05) == 0.0, "the smallest p is 0.125"
