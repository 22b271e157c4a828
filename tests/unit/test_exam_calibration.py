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
from brokk_rl.machine import Machine
from diagnosis import decision, effect_library
from diagnosis.calibration import ProbabilityModel
from diagnosis.detection import DetectionResult, Penalties
from diagnosis.residuals import Residuals
from diagnosis.responses import Response, fit_faults
from diagnosis.search import SubsetTable
from exam import dataset
from exam.calibration import PenaltyFit, WeighedCase, load_weighed_cases

SIZES = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])


@pytest.fixture
def prices() -> Penalties:
    return option("prices", "default")


@pytest.fixture
def weights() -> ProbabilityModel:
    return option("certainty", "default")


def found(machine: Machine, prices: Penalties, strength: float, seed: int) -> DetectionResult:
    """Returns findings on a machine whose first joint has a lag of some strength, in noise."""
    random, kinds = (
        np.random.default_rng(seed),
        effect_library.load_effects(machine, ["lag", "dead_band"]),
    )
    tables, block = [], np.arange(800) // 80
    for j in range(machine.num_joints):
        columns = random.standard_normal((2, 800))
        z = random.standard_normal(800) + (strength * columns[0] if j == 0 else 0.0)
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
    )


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


def test_prices_are_found_that_name_what_is_there_and_nothing_else(
    machine: Machine, prices: Penalties, weights: ProbabilityModel
) -> None:
    cheap = dataclasses.replace(prices, joint=2.0, name=2.0, reference=0.5)
    lag = {"effect": "lag", "joints": ["q1"], "size": 1.0, "parameters": {}, "nothing": {}}
    cases = [
        *(
            WeighedCase(
                label("none", []), decision.record_weights(found(machine, cheap, 0.14, seed), cheap)
            )
            for seed in range(3)
        ),
        *(
            WeighedCase(
                label("one", [lag]),
                decision.record_weights(found(machine, cheap, 0.4, seed), cheap),
            )
            for seed in range(3)
        ),
    ]
    fit = PenaltyFit(
        machine, effect_library.load_effects(machine), [], [], trials=8, seed=0, workers=1
    )
    assert fit.value(cases, cheap, weights) < 0.8
    best = fit.fitted(cases, cheap, weights, lambda: None)
    assert fit.value(cases, *best) == pytest.approx(1.0)


def test_an_unknown_cause_is_told_before_it_is_more_probable_than_not_and_nothing_stands_above_it(
    machine: Machine, prices: Penalties, weights: ProbabilityModel
) -> None:
    outside = {
        **dict.fromkeys(weights.outside, 0.0),
        "constant": float(np.log(0.45 / 0.55)),
    }  # odds of 9 to 11, whatever is seen
    weights = dataclasses.replace(
        weights, outside=outside, none={"constant": 2.0, "nearest": 0.0, "outside": 0.0}
    )
    named, silent = found(machine, prices, 0.5, 0), found(machine, prices, 0.0, 1)
    assert decision.is_unknown(named, prices, weights), (
        "a fifth of causes lies outside, so few are missed only so"
    )
    assert not decision.is_unknown(silent, prices, weights)
    rows = decision.rank_hypotheses(named, [], prices, weights, machine, 0.45)
    assert max(rows, key=lambda row: row.probability).probability == pytest.approx(0.45)
    assert {row.effect for row in rows} >= {"lag", "unknown", "none"}


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
