"""Hypotheses are weighed against each other: probabilities by hand, the verdict by its stakes, the set that follows."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.extensions import load_part
from diagnosis import hypotheses
from diagnosis.detection import DetectionResult
from diagnosis.gap import GapClosure
from diagnosis.hypotheses import Choice, Hypothesis, choose_hypothesis
from diagnosis.request import OUTSIDE_SIGNS, Penalties, ProbabilityModel
from diagnosis.responses import Response, fit_faults
from diagnosis.search import EffectSet, SubsetTable

SIZES = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])


@pytest.fixture
def weights() -> ProbabilityModel:
    """Log odds that are one sign each: the gain of an effect, the error of an unknown cause."""
    plain = option("certainty", "default")
    choice = {verdict: dict.fromkeys(signs, 0.0) for verdict, signs in plain.choice.items()} | {
        "stakes": {"effects": 1.0, "none": 1.0, "unknown": 1.0}
    }
    choice["effects"]["gain"] = choice["unknown"]["error"] = 1.0
    return dataclasses.replace(plain, choice=choice)


def known(lag: float, play: float, error: float) -> list[Hypothesis]:
    gap = dict.fromkeys((*OUTSIDE_SIGNS, "worst", "gain"), 0.0) | {"error": error}
    return [
        Hypothesis("lag", (0,), {"gain": lag}),
        Hypothesis("backlash", (1,), {"gain": play}),
        Hypothesis("none", (), gap),
        Hypothesis("unknown", (), gap),
    ]


def test_probabilities_are_those_of_a_conditional_logit(weights: ProbabilityModel) -> None:
    choice = choose_hypothesis(known(np.log(4.0), np.log(2.0), np.log(3.0)), weights)
    # odds of 4, 2, 1 and 3
    assert choice.odds == pytest.approx([0.4, 0.2, 0.1, 0.3])
    assert choice.verdict == "effects" and choice.best is not None and choice.best.name == "lag"
    assert choice.probability("lag", "backlash") == pytest.approx(0.6)
    assert choice.list_equivalents() == ("backlash",), "odds of 1 to 2"
    (first, *_, last) = choice.rank([], ("q1", "q2"))
    assert (first.effect, first.joints) == ("lag", ("q1",)) and last.effect == "none"


def test_a_much_less_likely_effect_is_no_equivalent(weights: ProbabilityModel) -> None:
    choice = choose_hypothesis(known(np.log(6.0), np.log(2.0), 0.0), weights)
    assert choice.list_equivalents() == ()


@pytest.mark.parametrize(("stake", "verdict"), [(1.9, "effects"), (2.1, "unknown")])
def test_a_verdict_with_a_stake_is_told_before_it_is_the_most_probable(
    weights: ProbabilityModel, stake: float, verdict: str
) -> None:
    cautious = {**weights.choice, "stakes": {"effects": 1.0, "none": 1.0, "unknown": stake}}
    weights = dataclasses.replace(weights, choice=cautious)
    choice = choose_hypothesis(known(np.log(4.0), np.log(2.0), np.log(3.0)), weights)
    assert choice.verdict == verdict and choice.odds[3] == pytest.approx(0.3)


def test_a_sign_without_a_weight_is_named(weights: ProbabilityModel) -> None:
    less = {name: value for name, value in weights.choice["none"].items() if name != "worst"}
    with pytest.raises(ConfigError, match=r"choice.none: expected a number for worst"):
        dataclasses.replace(weights, choice={**weights.choice, "none": less})


def findings(strength: float, chosen: tuple[str, ...] = ()) -> DetectionResult:
    """Returns findings on two joints, of which the first has a lag of some strength, in noise."""
    random, tables = np.random.default_rng(3), []
    for j in range(2):
        columns = random.standard_normal((2, 800))
        z = random.standard_normal(800) + (strength * columns[0] if j == 0 else 0.0)
        shapes = {
            name: [Response(SIZES, SIZES[:, None] * column)]
            for name, column in zip(("lag", "dead_band"), columns, strict=True)
        }
        tables.append(SubsetTable(fit_faults(z, []), shapes, np.arange(800) // 80))
    still = np.zeros(2)
    subsets = (frozenset(chosen), frozenset[str]())
    return DetectionResult(
        cast(Any, None), tables, {}, lambda j, subset: 4.0 + 6.0, EffectSet(subsets, 50.0), None, [],
        np.zeros((8, 2)), np.zeros((8, 2)), still + 1.0, still + 1.0, 1.0, tables, {},
    )  # fmt: skip


def closure(ratio: float) -> GapClosure:
    """Returns errors that are `ratio` times the floor on the first joint, and at it on the second."""
    squares = np.array([[ratio**2, 1.0]])
    return cast(
        GapClosure,
        SimpleNamespace(
            base=SimpleNamespace(field=SimpleNamespace(residuals=SimpleNamespace(base=None))),
            joint_squares=lambda paths: squares,
            joint_floor=np.ones((1, 2)),
        ),
    )


def test_an_effect_is_a_hypothesis_on_the_joints_that_show_it() -> None:
    prices = load_part("prices")
    result = findings(0.5)
    (lag, none, unknown) = hypotheses.list_hypotheses(
        result, closure(3.0), prices, frozenset[str]()
    )
    assert (lag.name, lag.joints) == ("lag", (0,))
    total = result.alone[0].score(frozenset({"lag"})).total
    assert total > 50.0 and lag.signs["gain"] == pytest.approx(np.arcsinh(total / 10.0))
    # the price of 10 nats holds 4 of the joint and twice the gain on the reference
    assert lag.signs["reference"] == pytest.approx(np.arcsinh(0.3))
    assert none.signs == unknown.signs and none.signs["worst"] == pytest.approx(np.log(3.0))
    assert none.signs["error"] == pytest.approx(np.log(np.sqrt(5.0)))


def test_noise_makes_no_hypothesis_but_a_shared_effect_stays_on_all_joints_that_feel_it() -> None:
    prices = load_part("prices")
    names = [
        one.name
        for one in hypotheses.list_hypotheses(findings(0.0), closure(1.0), prices, frozenset())
    ]
    assert names == ["none", "unknown"]
    shared = hypotheses.list_hypotheses(findings(0.5), closure(1.0), prices, frozenset({"lag"}))
    assert shared[0].joints == (0, 1) and shared[0].signs["shared"] == 1.0


def choice_of(verdict: str, name: str) -> Choice:
    best = Hypothesis(name, (0,), {})
    return Choice([best], np.ones(1), cast(Any, verdict), best)


@pytest.mark.parametrize("verdict", ["none", "unknown"])
def test_no_effect_is_kept_beside_another_verdict(weights: ProbabilityModel, verdict: str) -> None:
    prices: Penalties = load_part("prices")
    kept = hypotheses.apply_choice(
        findings(0.5, ("lag",)), choice_of(verdict, "lag"), prices, weights
    )
    assert not kept.chosen.names and kept.fitted is None


@pytest.mark.parametrize(("shown", "unknown"), [(0.95, False), (0.6, True)])
def test_what_tool_points_show_for_sure_is_told_beside_an_unknown_cause(
    weights: ProbabilityModel, monkeypatch: pytest.MonkeyPatch, shown: float, unknown: bool
) -> None:
    prices: Penalties = load_part("prices")
    one = SimpleNamespace(kind=SimpleNamespace(name="link_length", stage="kinematics"))
    result = dataclasses.replace(findings(0.5, ("lag",)), detected=cast(Any, [one]))
    monkeypatch.setattr(hypotheses.decision, "read_detected_signs", lambda *_: {})
    monkeypatch.setattr(hypotheses.calibration, "compute_probability", lambda *_: shown)
    monkeypatch.setattr(hypotheses.decision, "drop_unlikely_effects", lambda found, *_: found)
    choice = choice_of("unknown", "lag")
    kept = hypotheses.apply_choice(result, choice, prices, weights)
    assert hypotheses.is_unknown(choice, kept) is unknown and not kept.chosen.names


def test_the_searched_set_stays_where_it_holds_the_likeliest_effect(
    weights: ProbabilityModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    prices: Penalties = load_part("prices")
    searched = dataclasses.replace(findings(0.5, ("lag",)), fitted=cast(Any, "searched"))
    monkeypatch.setattr(hypotheses.decision, "drop_unlikely_effects", lambda found, *_: found)
    kept = hypotheses.apply_choice(searched, choice_of("effects", "lag"), prices, weights)
    assert kept.fitted == "searched"
    fits: list[Any] = []
    monkeypatch.setattr(hypotheses, "fit_set", lambda *given: fits.append(given) or "anew")
    other = hypotheses.apply_choice(searched, choice_of("effects", "dead_band"), prices, weights)
    assert other.fitted == "anew" and other.chosen.subsets == (
        frozenset({"dead_band"}),
        frozenset(),
    )
    ((_, subsets, _, start),) = fits
    assert subsets == [{"dead_band"}, set()] and set(start[0]) == {"dead_band"}


@pytest.mark.parametrize(("left", "kept"), [(0.0, True), (1.0, False)])
def test_a_set_that_explains_half_as_much_again_is_told(
    weights: ProbabilityModel, monkeypatch: pytest.MonkeyPatch, left: float, kept: bool
) -> None:
    """No effect alone explains a large gap, so that the likeliest one need not be part of the cause."""
    prices: Penalties = load_part("prices")
    result = findings(0.5, ("lag", "play"))
    z = np.full((2, 800), 3.0)
    result = dataclasses.replace(
        result,
        residuals=cast(Any, SimpleNamespace(z=z)),
        fitted=cast(Any, SimpleNamespace(z=left * z)),
    )
    monkeypatch.setattr(hypotheses.decision, "drop_unlikely_effects", lambda found, *_: found)
    monkeypatch.setattr(hypotheses, "fit_set", lambda *_: "anew")
    found = hypotheses.apply_choice(result, choice_of("effects", "dead_band"), prices, weights)
    assert (found.fitted is result.fitted) is kept


@pytest.mark.parametrize(("play", "kept"), [(0.5, True), (0.3, False)])
def test_of_effects_that_cannot_be_told_apart_the_searched_one_is_named(
    weights: ProbabilityModel, monkeypatch: pytest.MonkeyPatch, play: float, kept: bool
) -> None:
    prices: Penalties = load_part("prices")
    searched = dataclasses.replace(findings(0.5, ("dead_band",)), fitted=cast(Any, "searched"))
    monkeypatch.setattr(hypotheses.decision, "drop_unlikely_effects", lambda found, *_: found)
    monkeypatch.setattr(hypotheses, "fit_set", lambda *_: "anew")
    likely, other = Hypothesis("lag", (0,), {}), Hypothesis("dead_band", (0,), {})
    choice = Choice([likely, other], np.array([1.0, play]), "effects", likely)
    assert choice.list_class() == (("lag", "dead_band") if kept else ("lag",))
    found = hypotheses.apply_choice(searched, choice, prices, weights)
    assert found.fitted == ("searched" if kept else "anew")
