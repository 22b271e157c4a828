"""What was weighed can be chosen from again, and prices are found that separate what is there from what chance earns."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from composed import option

from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.extensions import load_part
from brokk_rl.machine import Machine
from diagnosis import decision, effect_library, hypotheses
from diagnosis.detection import DetectionResult
from diagnosis.hypotheses import Hypothesis
from diagnosis.request import GAP_SIGNS, Penalties, ProbabilityModel
from diagnosis.residuals import Residuals
from diagnosis.responses import Response, fit_faults
from diagnosis.search import SubsetTable
from exam import dataset
from exam.calibration import (
    LEAST_NUMBERS,
    PenaltyFit,
    SizeError,
    WeighedCase,
    find_effect_forms,
    find_form_error,
    fit_choice,
    load_weighed_cases,
)

SIZES = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])


@pytest.fixture
def prices() -> Penalties:
    return load_part("prices")


@pytest.fixture
def weights() -> ProbabilityModel:
    return option("certainty", "default")


def found(
    machine: Machine, prices: Penalties, strength: float, seed: int, second: float = 0.0
) -> DetectionResult:
    """Returns findings on a machine whose first joint has a lag, and a dead band of strength `second`, in noise."""
    random, kinds = (
        np.random.default_rng(seed),
        effect_library.load_effects(machine, ["lag", "dead_band"]),
    )
    tables, block = [], np.arange(800) // 80
    for j in range(machine.num_joints):
        columns = random.standard_normal((2, 800))
        shown = strength * columns[0] + second * columns[1]
        z = random.standard_normal(800) + (shown if j == 0 else 0.0)
        shapes = {
            name: [Response(SIZES, SIZES[:, None] * c)]
            for name, c in zip(("lag", "dead_band"), columns, strict=True)
        }
        tables.append(SubsetTable(fit_faults(z, []), shapes, block))
        tables[-1].explore({"lag": 2.0, "dead_band": 2.0}, 2)

    def price(j: int, subset: frozenset[str]) -> float:
        return prices.joint * len(subset) + prices.reference * 1.5

    evidence = cast(Residuals, SimpleNamespace(z=np.zeros((len(tables), 800)), block=block))
    chosen, still = decision.choose_again(tables, price, prices, kinds), np.zeros(len(tables))
    return DetectionResult(
        evidence,
        tables,
        {"lag": [], "dead_band": []},
        price,
        chosen,
        None,
        [],
        still[None],
        still[None],
        still + 1.0,
        still + 1.0,
        1.0,
        tables,
    )


def told(result: DetectionResult, prices: Penalties, error: float) -> dict[str, Any]:
    """Returns what an answer records; `error`: of all joints over the floor."""
    gap = dict.fromkeys(GAP_SIGNS, 0.0) | {"constant": 1.0, "error": float(np.log(error))}
    gain = max((result.tables[0].score(frozenset({"lag"})).total, 1.0))
    signs = {"gain": float(np.arcsinh(gain / 10.0)), "reference": 0.0, "joints": 1.0, "size": 0.0}
    known = [
        Hypothesis("lag", (0,), signs | {"shared": 0.0}),
        Hypothesis("none", (), gap),
        Hypothesis("unknown", (), gap),
    ]
    rows = hypotheses.serialize_hypotheses(known)
    return decision.record_weights(result, prices) | {"hypotheses": rows}


def test_what_was_weighed_is_chosen_from_again_as_it_was(
    machine: Machine, prices: Penalties
) -> None:
    first, kinds = found(machine, prices, 0.5, 0), effect_library.load_effects(machine)
    told = json.loads(json.dumps(decision.record_weights(first, prices)))
    again = decision.restore_result(told, prices, kinds)
    assert first.chosen.names == {"lag"} and again.chosen.subsets == first.chosen.subsets
    assert again.chosen.net_gain == pytest.approx(first.chosen.net_gain, abs=0.1)
    assert not decision.restore_result(
        told, dataclasses.replace(prices, joint=500.0), kinds
    ).chosen.names


def label(kind: str, effects: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "case": "0000",
        "kind": kind,
        "effects": effects,
        "outside": None,
        "moved_rad": {"q1": 0.0},
    }


def test_prices_are_found_that_name_the_second_effect_too(
    machine: Machine, prices: Penalties, weights: ProbabilityModel
) -> None:
    dear = dataclasses.replace(prices, joint=12.0, name=25.0, reference=3.0)
    there = []
    for name in ("lag", "dead_band"):
        there.append(
            {"effect": name, "joints": ["q1"], "size": 1.0, "parameters": {}, "nothing": {}}
        )
    cases = []
    for seed in range(3):
        nothing, several = found(machine, dear, 0.0, seed), found(machine, dear, 0.4, seed, 0.25)
        cases.append(WeighedCase(label("none", []), told(nothing, dear, 1.0)))
        cases.append(WeighedCase(label("several", there), told(several, dear, 3.0)))
    fit = PenaltyFit(
        machine, effect_library.load_effects(machine), [], [], trials=8, seed=0, workers=1
    )
    assert fit.value(cases, dear, weights) < 0.8
    best = fit.fitted(cases, dear, weights, lambda: None)
    assert fit.value(cases, *best) == pytest.approx(1.0)


def test_the_choice_is_learned_from_which_hypotheses_were_right(weights: ProbabilityModel) -> None:
    random, true = np.random.default_rng(1), {"gain": 2.0, "error": -1.5}
    start = {verdict: dict.fromkeys(signs, 0.0) for verdict, signs in weights.choice.items()}
    cases = []
    for _ in range(3000):
        gain, error = random.normal(size=2).tolist()
        rows = [
            {"name": "lag", "joints": [0], "signs": {"gain": gain}},
            {"name": "none", "joints": [], "signs": {"constant": 1.0, "error": error}},
            {"name": "unknown", "joints": [], "signs": {"constant": 1.0}},
        ]
        odds = np.exp([true["gain"] * gain, 0.5 + true["error"] * error, 0.0])
        right = random.choice(3, p=odds / odds.sum())
        effects = [{"effect": "lag"}] if right == 0 else []
        outside = {"ailment": "x"} if right == 2 else None
        cases.append(
            WeighedCase(
                {"effects": effects, "outside": outside}, {"hypotheses": rows, "others": []}
            )
        )
    found = fit_choice(cases, start)
    assert found["effects"]["gain"] == pytest.approx(2.0, abs=0.15)
    assert found["none"]["error"] == pytest.approx(-1.5, abs=0.15)
    assert found["none"]["constant"] - found["unknown"]["constant"] == pytest.approx(0.5, abs=0.15)
    assert found["stakes"] == start["stakes"]


def test_an_effect_that_sensors_show_leaves_nothing_for_motion(weights: ProbabilityModel) -> None:
    """The right hypothesis is then `none`, whose constant rises with each such case."""
    rows = [
        {"name": "lag", "joints": [0], "signs": {}},
        {"name": "none", "joints": [], "signs": {"constant": 1.0}},
    ]
    seen = {"hypotheses": rows, "others": [{"effect": "quantisation"}]}
    case = WeighedCase({"effects": [{"effect": "quantisation"}], "outside": None}, seen)
    found = fit_choice([case] * 20, weights.choice)
    assert found["none"]["constant"] > weights.choice["none"]["constant"]


def test_nothing_is_tuned_to_a_sealed_exam(tmp_path: Path) -> None:
    (tmp_path / "answers").mkdir()
    (tmp_path / "exam.json").write_text('{"sealed": true}')
    (tmp_path / dataset.LABELS_FILE).write_text("{}")
    with pytest.raises(ConfigError, match="development exams only"):
        load_weighed_cases([tmp_path / "answers"])


def test_answers_that_do_not_say_what_was_weighed_are_named(tmp_path: Path) -> None:
    (tmp_path / "answers").mkdir()
    (tmp_path / "exam.json").write_text('{"sealed": false}')
    dataset.seal_labels(tmp_path, {"cases": []}, "salt")
    with pytest.raises(RecordingError, match=r"what was weighed"):
        load_weighed_cases([tmp_path / "answers"])


def test_a_model_form_error_is_the_smallest_that_covers_nine_of_ten() -> None:
    # ten sizes of 1 with errors of 0.01 to 0.10 and no error of their own: the ninth, 0.09, must lie
    # within 1.645 sigma, so that the form is 0.09 / 1.645 = 0.0547; the next of the trials is 0.055
    errors = [SizeError(0.01 * k, 0.0, 1.0) for k in range(1, 11)]
    assert find_form_error(errors) == 0.055
    # stated deviations cover them without any error of the form
    assert find_form_error([SizeError(one.error, 0.06, 1.0) for one in errors]) == 0.0
    assert find_form_error([SizeError(9.0, 0.0, 1.0)] * 10) is None


def test_an_effect_of_few_sizes_has_no_form_of_its_own() -> None:
    sizes = [SizeError(0.1, 0.0, 1.0)] * LEAST_NUMBERS
    assert find_effect_forms({"lag": sizes, "sag": sizes[1:]}) == {"lag": 0.065}  # 0.1 / 1.645


def test_the_form_of_an_effect_takes_the_place_of_that_of_its_stage(
    weights: ProbabilityModel,
) -> None:
    own = dataclasses.replace(weights, form_of_effect={"lag": 0.5})
    assert own.get_form_error("lag", "actuation") == 0.5
    assert own.get_form_error("dead_band", "actuation") == weights.form["actuation"]


def test_a_negative_form_is_refused_by_name(weights: ProbabilityModel) -> None:
    with pytest.raises(ConfigError, match=r"certainty.form_of_effect.lag: expected 0 or more"):
        dataclasses.replace(weights, form_of_effect={"lag": -0.1})
