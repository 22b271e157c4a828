"""A simulator of one axis held against recordings of a plant with other numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from axis import PLANT, driven, make_axis

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import Answer
from diagnosis.case import GapCase
from diagnosis.effect_library import load_effects
from diagnosis.simulator_diagnosis import SimulatorDiagnosis

Diagnosis = Callable[..., Answer]


@pytest.fixture(scope="module")
def diagnose(machine: Machine) -> Diagnosis:
    axis = make_axis(machine)
    field = driven(axis, 3, 60.0, 3)
    every = ("dead_time", "flow_gain", "asymmetry", "lag", "backlash", "dead_band")

    def run(names: Sequence[str] = every, turn: bool = False, **numbers: float) -> Answer:
        seen: list[Recording] = [replace(one, u=-one.u) if turn else one for one in field]
        base = replace(PLANT, **numbers)
        kinds = load_effects(axis, names, base)
        case = GapCase(axis, [], seen)
        draw = np.random.default_rng(0)
        work = SimulatorDiagnosis(case, kinds, draw, base, 0)
        return work.run(lambda doing, done: None).answer

    return run


@pytest.mark.parametrize(
    ("numbers", "effect", "name", "size"),
    [
        # The plant has 0.31 s and 0.9 of full speed.
        ({"dead_time_s": 0.2}, "dead_time", "dead_time_s", 0.11),
        ({"gain": 0.7}, "flow_gain", "gain", 0.9 / 0.7),
    ],
)
def test_what_the_simulator_lacks_is_named_with_its_size(
    diagnose: Diagnosis, numbers: dict[str, float], effect: str, name: str, size: float
) -> None:
    answer = diagnose(**numbers)
    (one,) = answer.selected
    estimate = one.parameters[name]["q3"]
    gap = answer.gap
    assert (answer.verdict, one.effect, one.joints) == ("effects", effect, ("q3",))
    assert estimate.mean == pytest.approx(size, rel=0.05)
    assert estimate.ci95[0] <= size <= estimate.ci95[1] and one.identified
    assert gap and gap.closed and gap.closed.mean > 0.9 and gap.floor_of == "field"
    assert answer.reason == f"{effect} on q3"


def test_two_effects_are_named_together(diagnose: Diagnosis) -> None:
    answer = diagnose(dead_time_s=0.2, gain=0.7)
    assert {one.effect for one in answer.selected} == {"dead_time", "flow_gain"}


def test_nothing_is_named_where_nothing_is_lacking(diagnose: Diagnosis) -> None:
    answer = diagnose()
    assert answer.verdict == "none" and not answer.selected


def test_a_turned_axis_is_explained_by_no_effect(diagnose: Diagnosis) -> None:
    assert diagnose(turn=True).verdict == "unknown"


def test_nothing_named_is_no_health_where_an_arx_errs_far_less(diagnose: Diagnosis) -> None:
    answer = diagnose(("saturation",), gain=0.7)
    failed = [one.name for one in answer.gates if not one.passed]
    assert (answer.verdict, failed) == ("unknown", ["near_arx"])
