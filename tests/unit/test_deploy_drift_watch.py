"""Drift watch: alarms keep their rate where nothing changes, and name what does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from composed import option

from deploy.guard import drift_watch
from deploy.guard.drift_watch import BlockMeter, ConformalMartingale, DriftWatch, Misfit

MACHINE = option("machine", "brokk170")
SPEED = np.array([joint.max_speed.value for joint in MACHINE.joints])
PERIOD_S = MACHINE.period_s


def test_the_martingale_is_fair_worked_by_hand() -> None:
    martingale = ConformalMartingale([0.1, 0.2, 0.3, 0.4], seed=1)
    assert martingale.log_wealth == 0.0
    # 0.35: one larger of five, itself among them. p lies between 1/5 and 2/5.
    p = martingale.update(0.35)
    assert 0.2 < p <= 0.4
    powers = [number / 10 for number in range(1, 10)]
    bets = [power * p ** (power - 1.0) for power in powers]
    assert martingale.log_wealth == pytest.approx(math.log(sum(bets) / len(bets)))
    # The score has joined the others: of six, itself among them, two are as large or larger.
    q = martingale.update(0.38)
    assert 1 / 6 < q <= 2 / 6
    both = [one * power * q ** (power - 1.0) for one, power in zip(bets, powers, strict=True)]
    assert martingale.log_wealth == pytest.approx(math.log(sum(both) / len(both)))
    # Beyond all: at most one of all of them, and never nothing.
    assert 0.0 < martingale.update(9.0) <= 1 / 7


def test_a_long_run_without_any_change_loses_the_bets() -> None:
    martingale = ConformalMartingale([1.0] * 50, seed=1)
    for number in range(1200):
        martingale.update(0.5 - 1e-4 * number)
    # Each p-value is nearly 1: the smallest loss is that of the largest power.
    assert martingale.log_wealth == pytest.approx(1200 * math.log(0.9) - math.log(9), rel=0.05)


def make_watch(false_alarms: float = 0.005) -> tuple[DriftWatch, np.random.Generator]:
    """A watch of the machine whose scores are those of a model with 2 % of error."""
    draw = np.random.default_rng(7)
    collector = DriftWatch([[]] * 5, false_alarms, MACHINE, 0)
    scores: list[float] = []
    for measured, predicted in play(draw, 5000):
        found = collector.update(measured, predicted, 0.06 * SPEED)
        scores += [score for score in found if score is not None]
    # All joints are alike here, so that each may have the scores of all.
    assert len(scores) >= 50 and collector.joint == -1
    return DriftWatch([scores] * 5, false_alarms, MACHINE, 1), draw


def play(draw: np.random.Generator, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Motions of work: some joints, for a second or two each, measured with 2 % of error."""
    motions, speed, errors = [], np.zeros(5), np.zeros(5)
    for number in range(count):
        if number % 30 == 0:
            speed = draw.uniform(-1, 1, 5) * (draw.random(5) < 0.6)
            errors = 0.02 * draw.normal(size=5)
        predicted = np.round(speed, 2) * SPEED * PERIOD_S
        motions.append((predicted * (1 + errors) + 2e-4 * draw.normal(size=5), predicted))
    return motions


def test_an_unchanged_machine_raises_no_alarm() -> None:
    watch, draw = make_watch()
    for measured, predicted in play(draw, 6000):
        watch.update(measured, predicted, 0.06 * SPEED)
    assert (watch.misfit, watch.joint) == (Misfit.NONE, -1)


@pytest.mark.parametrize("effect", [one for one in Misfit if one is not Misfit.NONE])
def test_a_changed_joint_is_named_with_its_probable_effect(effect: Misfit) -> None:
    watch, draw = make_watch()
    before, count = 0.0, 0
    for measured, predicted in play(draw, 8000):
        count += 1
        own, error = float(predicted[3]), float(measured[3] - predicted[3])
        slow = 0.0 < abs(own) < SPEED[3] * PERIOD_S / 2
        change = {
            Misfit.FLOW_GAIN: -0.2 * own,
            Misfit.ASYMMETRY: -0.3 * max(own, 0.0),
            Misfit.DEAD_TIME: 3.0 * (before - own),
            Misfit.CREEP: 0.1 * SPEED[3] * PERIOD_S * (own == 0.0),
            Misfit.DEAD_BAND: -0.1 * math.copysign(SPEED[3] * PERIOD_S, own) * slow,
        }[effect]
        before = own
        measured = measured.copy()
        measured[3] = own + error + change
        watch.update(measured, predicted, 0.06 * SPEED)
        if watch.joint >= 0:
            break
    assert (watch.misfit, watch.joint) == (effect, 3)
    assert count < 8000


@pytest.mark.parametrize("first", [2, 0])
def test_the_first_alarm_stays(first: int) -> None:
    watch, _ = make_watch(0.5)
    for _ in range(5):
        watch._bet(first, 9.0)
    assert watch.joint == first
    for _ in range(9):
        watch._bet(4, 99.0)
    assert watch.joint == first


def test_a_joint_without_scores_is_not_watched() -> None:
    watch = DriftWatch([[], [0.01] * 50, [], [], []], 0.5, MACHINE, 0)
    moving = SPEED * PERIOD_S
    for block in range(1, 10):
        for _ in range(200):
            # Worse and worse, each score larger than all before.
            watch.update((1.0 + block * np.array([0.1, 0, 0, 0, 0])) * moving, moving, 0.06 * SPEED)
    assert watch.joint == -1


def test_a_tenth_of_full_speed_is_not_yet_motion() -> None:
    watch = DriftWatch([[]] * 5, 0.5, MACHINE, 0)
    slow, slack = drift_watch.MOVES * SPEED * PERIOD_S, 0.06 * SPEED
    found = [one for _ in range(300) for one in watch.update(slow, slow, slack)]
    assert found == [None] * 1500


def test_a_gap_begins_a_block_anew() -> None:
    watch = DriftWatch([[]] * 5, 0.5, MACHINE, 0)
    moving = SPEED * PERIOD_S

    def count_scores(periods: int) -> int:
        found = 0
        for _ in range(periods):
            found += sum(one is not None for one in watch.update(moving, moving, 0.06 * SPEED))
        return found

    assert count_scores(199) == 0 and count_scores(1) == 5
    assert count_scores(150) == 0
    watch.interrupt()
    assert count_scores(199) == 0 and count_scores(1) == 5


def test_a_score_is_residual_over_way() -> None:
    watch = DriftWatch([[]] * 5, 0.5, MACHINE, 0)
    moving, slack = SPEED * PERIOD_S, 0.06 * SPEED
    score: float | None = None
    for number in range(200):
        # The second joint is too fast by a tenth, to and fro by turns of half a second.
        sign = 1.0 if (number // 10) % 2 == 0 else -1.0
        score = watch.update(1.1 * sign * moving, sign * moving, slack)[1]
    assert score == pytest.approx(0.1 * 10.0 / (10.0 + 0.06))


def collect_score(period_s: float, errors: list[float]) -> float | None:
    """The score of the first joint at full speed whose residuals repeat, in parts of full steps."""
    machine = replace(MACHINE, period_s=period_s, dead_time_s=0.0)
    meter, step = BlockMeter(machine, 0), float(SPEED[0]) * period_s
    score, number = None, 0
    while score is None:
        residual = errors[number % len(errors)] * step
        score = meter.add(step + residual, step, 0.0, True)
        number += 1
    assert number == round(drift_watch.BLOCK_S / period_s)
    return score


def test_noise_cancels_within_half_a_second_and_no_longer() -> None:
    assert collect_score(0.05, [0.1, -0.1]) == pytest.approx(0.0, abs=1e-12)
    assert collect_score(0.05, [0.1] * 10 + [-0.1] * 10) == pytest.approx(0.1)
    assert collect_score(0.05, [0.1] * 5 + [-0.1] * 5) == pytest.approx(0.0, abs=1e-12)
    # A period longer than that counts alone.
    assert collect_score(2.0, [0.1, -0.1]) == pytest.approx(0.1)


def explain(pairs: list[tuple[float, float]]) -> dict[Misfit, float]:
    """Squared residuals that each form explains, of pairs of prediction and residual."""
    meter = BlockMeter(MACHINE, 0)
    step = float(SPEED[0]) * PERIOD_S
    for predicted, residual in pairs:
        meter.add((predicted + residual) * step, predicted * step, 0.0, True)
    return {effect: value / step**2 for effect, value in meter.explain().items()}


def test_what_each_form_explains_worked_by_hand() -> None:
    # Forms of the two periods: gain 1, -0.5; dead time -1, 1.5; one way 1, 0; the other 0, -0.5.
    assert explain([(1.0, 0.2), (-0.5, 0.1)]) == pytest.approx(
        {
            Misfit.FLOW_GAIN: 0.15**2 / 1.25,
            Misfit.ASYMMETRY: 0.2**2,
            Misfit.DEAD_TIME: 0.05**2 / 3.25,
            Misfit.CREEP: 0.0,
            Misfit.DEAD_BAND: 0.0,
        }
    )
    # A motion of less than half speed, one of more the other way, rest.
    assert explain([(0.4, -0.1), (-0.6, 0.3), (0.0, 0.2)]) == pytest.approx(
        {
            Misfit.FLOW_GAIN: 0.22**2 / 0.52,
            Misfit.ASYMMETRY: 0.3**2,
            Misfit.DEAD_TIME: (0.04 + 0.3 - 0.12) ** 2 / (0.16 + 1.0 + 0.36),
            Misfit.CREEP: 0.2**2,
            Misfit.DEAD_BAND: 0.1**2,
        }
    )
    assert explain([(0.4, 0.1), (-0.2, 0.1)])[Misfit.DEAD_BAND] == pytest.approx(0.0)
    assert explain([(0.5, 0.1)])[Misfit.DEAD_BAND] == 0.0
    assert set(explain([(0.0, 0.0)]).values()) == {0.0}


def test_p_values_are_uniform_with_ties_too() -> None:
    draw = np.random.default_rng(0)
    for scale in (1000, 3):
        found = []
        for seed in range(1500):
            scores = np.round(draw.random(9) * scale).tolist()
            found.append(ConformalMartingale(scores[:8], seed).update(scores[8]))
        # Kolmogorov: 1.95 over the root of 1500 is passed with a chance of 0.1 %.
        steps = np.arange(1, 1501) / 1500
        assert np.abs(np.sort(found) - steps).max() < 1.95 / math.sqrt(1500)


@pytest.mark.parametrize("alpha", [0.05, 0.3])
def test_on_exchangeable_scores_alarms_keep_their_rate(alpha: float) -> None:
    """2000 shifts of 40 scores on each of two joints: alarms stay within the stated rate."""
    draw, alarms, shifts = np.random.default_rng(4), 0, 2000
    two = replace(
        MACHINE, joints=MACHINE.joints[:2], exclusive=(), levers=(), tool_m=None, mjcf=None
    )
    for seed in range(shifts):
        # Heavy tails and ties; scores of a shift come from where those of the file come from.
        scores = np.round(np.exp(draw.normal(size=(2, 100))), 1)
        watch = DriftWatch(scores[:, :60].tolist(), alpha, two, seed)
        for row in scores[:, 60:].T:
            for joint, score in enumerate(row):
                watch._bet(joint, float(score))
        alarms += watch.joint >= 0
    # Three standard deviations of a binomial.
    assert alarms / shifts <= alpha + 3 * math.sqrt(alpha * (1 - alpha) / shifts)
    # And it does bet: without any alarm the property would hold of itself.
    assert alarms > 0
