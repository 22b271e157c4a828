"""Exact tests, effects and intervals of a study, against scipy, statsmodels and numbers worked by hand."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pandas as pd
import pytest
from composed import MACHINE
from scipy import stats
from sitting import recorded
from statsmodels.regression.mixed_linear_model import MixedLM

from brokk_rl.kinematics import compute_tool_kinematics
from study import guidance_effect, measures, tlx
from study.design import Hole, Success, draw_sequences
from study.guidance_effect import GuidanceEffect, compute_sequence_p, estimate_effect
from study.measures import measure_trial


def test_five_pairs_cannot_reach_five_percent_and_six_can() -> None:
    assert guidance_effect.get_smallest_p(5) == 0.0625
    assert guidance_effect.get_smallest_p(6) == 0.03125
    first = np.arange(8) % 2 == 0
    extreme = np.where(first, 1.0, -1.0) + 0.01 * np.arange(8)
    assert compute_sequence_p(extreme, first, np.arange(8) // 2) == 0.125
    assert guidance_effect.find_smallest_size(0.05) == 11
    assert guidance_effect.find_smallest_size(0.0625) == 9


class Coins:
    """Gives the coins of a draw, one after the other."""

    def __init__(self, coins: tuple[int, ...]) -> None:
        self._left = list(coins)

    def integers(self, end: int) -> int:
        return self._left.pop(0)


def list_first(num: int, left: list[int]) -> list[np.ndarray]:
    """Who begins guided in each draw that the plan could have made, of those who are left."""
    found = []
    for coins in product((0, 1), repeat=(num + 1) // 2):
        drawn = draw_sequences(num, Coins(coins))  # type: ignore[arg-type]
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
    left = [one for one in range(num) if one not in dropped]
    draws, pairs = list_first(num, left), np.array(left) // 2
    values = np.random.default_rng(num).normal(size=len(left)) + 3.0
    found = []
    for first in draws:
        if first.all() or not first.any():
            continue
        observed = compare_sequences(values, first)
        expected = np.mean([compare_sequences(values, one) >= observed - 1e-9 for one in draws])
        found.append(compute_sequence_p(values, first, pairs))
        assert found[-1] == pytest.approx(expected)
    assert min(found) == pytest.approx(guidance_effect.get_smallest_p(len(set(pairs.tolist()))))
    # Without an effect the values stay and the draw varies: no level is exceeded.
    for level in sorted(set(found)):
        assert sum(p <= level + 1e-12 for p in found) / len(draws) <= level + 1e-12


def test_times_that_tie_by_the_recordings_rate_count_as_equal() -> None:
    # Counted in whole samples of 0.05 s, which floating-point numbers cannot hold exactly.
    samples = np.array([859, 806, 750, 862, 804, 899, 756, 770, 860, 734, 764, 778])
    first, pairs = np.arange(12) % 2 == 0, np.arange(12) // 2
    apart = samples[::2] - samples[1::2]
    signs = np.array(list(product((1, -1), repeat=6)))
    expected = (np.abs(signs @ apart) >= abs(apart.sum())).mean()
    assert compute_sequence_p(samples * 0.05, first, pairs) == expected


def test_more_draws_than_can_be_counted_are_drawn() -> None:
    first, pairs = np.arange(40) % 2 == 0, np.arange(40) // 2
    values = np.random.default_rng(2).normal(size=40) + np.where(first, 0.4, -0.4)
    # The t test over the pairs is close to the exact one at this size.
    apart = values[first] - values[~first]
    expected = stats.ttest_1samp(apart, 0.0).pvalue
    assert compute_sequence_p(values, first, pairs) == pytest.approx(expected, abs=0.01)


def test_holm_is_worked_by_hand() -> None:
    # sorted 0.005 0.01 0.03 0.04, times 4 3 2 1: 0.02 0.03 0.06 0.04, never falling: 0.06
    found = dict(zip("abcde", (0.01, 0.04, None, 0.03, 0.005), strict=True))
    effects = {name: GuidanceEffect(8, 4, p=p) for name, p in found.items()}
    adjusted = guidance_effect.adjust_by_holm(effects, found)
    assert adjusted == pytest.approx({"a": 0.03, "b": 0.06, "d": 0.06, "e": 0.02})


def tabulate(guided: np.ndarray, unguided: np.ndarray, first: np.ndarray) -> pd.DataFrame:
    """Returns the means of persons in each condition as an analysis has them."""
    parts = []
    for condition, values, period in (
        ("guided", guided, np.where(first, 1, 2)),
        ("unguided", unguided, np.where(first, 2, 1)),
    ):
        part = {"participant": np.arange(len(first)), "pair": np.arange(len(first)) // 2}
        part |= {"condition": condition, "period": period, "value": values}
        parts.append(pd.DataFrame(part))
    return pd.concat(parts)


def test_guidance_and_period_come_apart() -> None:
    # each person: 50 s, second period 8 s faster, guidance 5 s faster, and own deviations that
    # cancel within each sequence
    first = np.array([True, False, True, False, True, False])
    own = np.array([-1.0, 2.0, 0.0, 0.0, 1.0, -2.0])
    guided = 50.0 - 5.0 - 8.0 * ~first + own
    unguided = 50.0 - 8.0 * first
    found = estimate_effect(tabulate(guided, unguided, first), "value")
    assert found.difference == pytest.approx(-5.0) and found.period == pytest.approx(-8.0)
    assert found.dz == pytest.approx(-5.0 / math.sqrt((2 + 8) / 4))
    assert found.p == pytest.approx(2 / 8) and found.ci95 is not None
    half = stats.t.ppf(0.975, 4) * math.sqrt(2.5) / 2 * math.sqrt(2 / 3)
    assert found.ci95 == pytest.approx((-5 - half, -5 + half))
    test = stats.ttest_ind((guided - unguided)[first], (guided - unguided)[~first])
    assert found.period_p == pytest.approx(test.pvalue)


def test_effect_and_error_are_those_of_the_mixed_model_where_nothing_is_missing() -> None:
    generator, first = np.random.default_rng(4), np.arange(24) % 2 == 0
    level = generator.normal(40.0, 5.0, 24)
    guided = level - 4.0 - 2.0 * ~first + generator.normal(0.0, 2.0, 24)
    unguided = level - 2.0 * first + generator.normal(0.0, 2.0, 24)
    means = tabulate(guided, unguided, first)
    found = estimate_effect(means, "value")
    terms = {"level": 1.0, "guided": means.condition == "guided", "second": means.period == 2}
    mixed = MixedLM(means.value, pd.DataFrame(terms).astype(float), means.participant).fit()
    assert found.difference == pytest.approx(mixed.params["guided"], abs=1e-4)
    assert found.period == pytest.approx(mixed.params["second"], abs=1e-4)
    error = (found.ci95[1] - found.ci95[0]) / 2 / stats.t.ppf(0.975, 22)
    assert error == pytest.approx(mixed.bse["guided"], rel=1e-3)


def test_with_one_sequence_nothing_is_said_about_guidance_apart_from_order() -> None:
    guided, unguided, first = np.arange(6.0), np.arange(6.0) ** 2, np.ones(6, bool)
    found = estimate_effect(tabulate(guided, unguided, first), "value")
    assert found.p is None and found.period is None
    test = stats.ttest_1samp(guided - unguided, 0.0)
    assert found.ci95 == pytest.approx(tuple(test.confidence_interval()))


def test_who_has_one_condition_only_does_not_count() -> None:
    first, nothing = np.arange(4) % 2 == 0, np.full(4, np.nan)
    assert estimate_effect(tabulate(nothing, np.ones(4), first), "value") == GuidanceEffect(0, 0)
    # Equal differences have no scale.
    same = estimate_effect(tabulate(np.ones(4), np.zeros(4), first), "value")
    assert (same.dz, same.period_p) == (None, None)
    assert same.difference == pytest.approx(1.0)


def test_power_is_that_of_the_t_test_over_pairs() -> None:
    # Differences of the eight pairs have mean 2 dz and variance 2.
    power = stats.nct.sf(stats.t.ppf(0.975, 7), 7, 2 * 0.8 / math.sqrt(2) * math.sqrt(8))
    assert guidance_effect.estimate_power(16, 0.8, 0.05) == pytest.approx(power, abs=0.04)
    assert guidance_effect.estimate_power(16, 0.0, 0.05) <= 0.065
    for num_persons in (2, 8):
        assert guidance_effect.estimate_power(num_persons, 3.0, 0.05) == 0.0, "p stays above 0.1"


SUCCESS = Success(depth_m=0.1, clearance_m=0.013)


def test_a_straight_path_has_its_length_and_noise_hardly_adds_to_it() -> None:
    line = np.linspace([0.0, 0.0, 0.0], [3.0, 4.0, 0.0], 401)
    assert measures.measure_path_length(line, 0.05) == pytest.approx(5.0)
    noisy = line + 0.002 * np.random.default_rng(0).standard_normal(line.shape)
    assert measures.measure_path_length(noisy, 0.05) == pytest.approx(5.0, abs=0.01)
    assert np.linalg.norm(np.diff(noisy, axis=0), axis=1).sum() > 5.2


def test_lever_movements_are_counted_with_a_margin_for_tremor() -> None:
    u = np.zeros((12, 2))
    u[1:5, 0] = [0.3, 0.08, 0.12, 0.3]  # one movement: 0.08 is not yet let go
    u[6:8, 0] = [0.2, 0.2]
    u[9:, 1] = 0.5
    assert measures.detect_lever_movements(u).tolist() == [[1, 0], [6, 0], [9, 1]]
    assert not len(measures.detect_lever_movements(np.full((5, 2), 0.07)))


def test_a_trial_of_known_motion_gives_known_numbers() -> None:
    q = np.repeat(MACHINE.home[None], 201, 0)
    q[:, 0] += np.clip(np.arange(201) - 40, 0, 80) * 0.05 * 0.2  # q1 at half speed from 2 s to 6 s
    q[:, 2] += np.clip(np.arange(201) - 80, 0, 80) * 0.05 * 0.13  # q3 from 4 s to 8 s
    u = np.zeros((201, 5))
    u[40:120, 0], u[80:160, 2] = 0.5, 0.5
    hole = Hole(center_in_base_m=(9.0, 0.0, 0.75), radius_m=0.05)
    found = measure_trial(recorded(q, u, force_n=np.zeros(201)), MACHINE, hole, SUCCESS, 60.0)
    assert found["success"] == 0 and found["time_s"] == 60.0
    assert found["several_joints"] == pytest.approx(40 / 201, abs=6 / 201)
    assert found["lever_movements"] == 2 and found["joint_switches"] == 1
    assert found["control_effort"] == pytest.approx(2.0 / 10.0)
    assert found["peak_force_n"] == 0 and math.isnan(found["advice_error"])
    tip_m = compute_tool_kinematics(MACHINE, MACHINE.home).tip_in_base_m
    alone = measure_trial(recorded(q[:81], u[:81]), MACHINE, hole, SUCCESS, 60.0)
    way_m = math.hypot(*tip_m[:2]) * 80 * 0.05 * 0.2 / 2
    assert alone["path_m"] == pytest.approx(way_m, rel=0.01) and math.isnan(alone["peak_force_n"])


@pytest.mark.parametrize(
    ("aside_m", "limit_s", "success", "time_s"),
    [(0.012, 60.0, 1, 2.5), (0.012, 2.0, 0, 2.0), (0.014, 60.0, 0, 60.0)],
)
def test_insertion_within_the_limit_ends_the_trial(
    aside_m: float, limit_s: float, success: int, time_s: float
) -> None:
    tip = compute_tool_kinematics(MACHINE, MACHINE.home).tip_in_base_m
    q = np.repeat(MACHINE.home[None], 100, 0)
    q[:50, 0] += 0.3  # far off until 2.5 s
    hole = Hole(center_in_base_m=(tip[0] + aside_m, tip[1], tip[2] + 0.101), radius_m=0.05)
    found = measure_trial(recorded(q), MACHINE, hole, SUCCESS, limit_s)
    assert found["success"] == success and found["time_s"] == pytest.approx(time_s)


def test_distance_from_the_advice_counts_where_it_was_shown() -> None:
    hole = Hole(center_in_base_m=(9.0, 0.0, 0.75), radius_m=0.05)
    u, advice = np.zeros((40, 5)), np.full(40, 0.1)
    advice[20:] = np.nan
    columns = {f"advice_{name}": advice for name in MACHINE.joint_names}
    q = np.repeat(MACHINE.home[None], 40, 0)
    found = measure_trial(recorded(q, u, **columns), MACHINE, hole, SUCCESS, 60.0)
    assert found["advice_error"] == pytest.approx(0.1)


RATINGS = dict(zip(tlx.SCALES, (70, 20, 40, 30, 60, 50), strict=True))


def test_tlx_by_hand() -> None:
    scores, faults = tlx.compute_scores({"ratings": RATINGS})
    assert scores["raw"] == pytest.approx(45.0) and faults == []


def test_a_half_filled_questionnaire_has_no_mean_and_says_why() -> None:
    half = {"ratings": {**RATINGS, "effort": None, "temporal": 170}}
    scores, faults = tlx.compute_scores(half)
    assert math.isnan(scores["raw"]) and scores["mental"] == 70
    assert faults == ["temporal is 170, expected 0 to 100: no mean", "effort not answered: no mean"]
