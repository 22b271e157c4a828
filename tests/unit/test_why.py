"""`mode=why`: the verdict over all stages, and inputs that are refused before the first stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from brokk_rl.machine import Machine
from diagnosis import why_report
from diagnosis.answer import Answer, Estimate, Selected, Where
from diagnosis.why_answer import (
    ALL_EFFECTS,
    BEFORE,
    WhyRequest,
    WhyResult,
    judge_suspects,
    list_changes,
    list_records,
    write_summary,
)

DOCTOR: dict[str, Any] = {
    "verdict": "nothing",
    "reason": "The code does what the contract says.",
    "named": False,
    "logs": [{
        "findings": [], "code": [{"stage": "policy", "rows": 300}], "cannot_tell": [],
        "task": {"blamed": False, "outside": [], "cannot_tell": None},
    }],
    "actuator": {"cannot_tell": None, "joints": {"q3": {"blamed": False}}},
}  # fmt: skip
RATES = {
    1.0: {"mean": 1.0, "ci95": [0.94, 1.0]},
    0.95: {"mean": 0.95, "ci95": [0.87, 0.98]},
    0.5: {"mean": 0.5, "ci95": [0.38, 0.62]},
}


def make_result(tmp_path: Path, after: float | None, verdict: str = "nothing") -> WhyResult:
    """A doctor's verdict, and an effect with which the policy succeeds in a share `after`."""
    lag = Selected(effect="lag", joints=("q3",), probability=0.9, parameters={}, gap_closed=None)
    found = Answer(
        verdict="effects", selected=(lag,), ranking=(), where=Where({}, (), None), gap=None,
        next_experiment=None,
    )  # fmt: skip
    success = {} if after is None else {BEFORE: RATES[1.0], ALL_EFFECTS: RATES[after]}
    request = WhyRequest("runs/policy", "mlp", False)
    return WhyResult(tmp_path, DOCTOR | {"verdict": verdict}, found, success, (), request)


def test_an_effect_that_costs_success_for_sure_is_the_cause(tmp_path: Path) -> None:
    result = make_result(tmp_path, 0.5)
    assert result.cause == "actuator"
    assert "lag on q3" in write_summary(result)
    assert "from 100 % to 50 %" in write_summary(result)
    assert "The deployed code and the task are not the cause." in write_summary(result)


def test_an_effect_within_chance_is_no_cause(tmp_path: Path) -> None:
    result = make_result(tmp_path, 0.95)  # 5 points; the interval of the loss goes below 0
    assert result.cause == "nothing"
    assert "costs no success for sure" in write_summary(result)
    assert result.tone == "warn"


def test_an_effect_whose_cost_is_unknown_is_a_possible_cause(tmp_path: Path) -> None:
    result = make_result(tmp_path, None)
    assert result.title == "No sure cause: the machine differs from the simulator"
    assert judge_suspects(result)[1][0] == "possible"


def test_code_comes_before_an_effect_that_costs_success(tmp_path: Path) -> None:
    result = make_result(tmp_path, 0.5, "code")
    assert result.cause == "code"
    assert "lag" not in write_summary(result)


def test_a_cost_that_was_not_measured_is_said(tmp_path: Path) -> None:
    result = make_result(tmp_path, None, "actuator")
    assert result.cause == "actuator"
    assert "cost in success was not measured" in write_summary(result)


def test_next_steps_are_commands_with_their_paths(tmp_path: Path) -> None:
    ((_, command),) = list_changes(make_result(tmp_path, 0.5))
    assert "policy=runs/policy" in command
    assert f"@{tmp_path}/diagnosis/effects.yaml" in command
    own = replace(make_result(tmp_path, 0.5), request=WhyRequest("p", "my.xml", True))
    ((_, command),) = list_changes(own)
    assert "mode=change_simulator" in command
    assert "simulator=my.xml" in command


def test_a_diagnosis_without_an_answer_asks_for_recordings(tmp_path: Path) -> None:
    result = replace(make_result(tmp_path, None), diagnosis=None)
    assert result.title == "No cause found, but not all could be judged"
    assert result.tone == "warn"
    ((text, command),) = list_records(result)
    assert "a minute or more in two files" in text
    assert "mode=collect" in command


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (["log=nowhere/*.parquet"], "no recording matches nowhere"),
        (["policy=nowhere/x"], "nowhere/x: expected a run folder"),
        (["simulator=mlpp"], "did you mean 'mlp'?"),
        (["simulator=nowhere.xml"], "there is no such file"),
        (["simulator=nowhere:step"], "simulator=nowhere:step"),
    ],
)
def test_inputs_are_refused_before_the_first_stage(
    brokk: Callable[..., Any], changed: list[str], expected: str
) -> None:
    command = {
        "log": "log=nowhere/*.parquet", "policy": "policy=tasks:policies/borehole_insertion"
    }  # fmt: skip
    command |= {word.partition("=")[0]: word for word in changed}
    done = brokk("mode=why", *command.values(), "session.out=out")
    assert done.code == 2
    assert expected in done.err
    assert not Path("out/doctor").exists()


def test_the_page_says_effect_cost_and_what_was_not_measured(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = replace(make_result(tmp_path, 0.5), unmeasured=("link_length",))
    assert result.diagnosis is not None
    number = {"time_constant_s": {"q3": Estimate(0.2, (0.1, 0.3))}}
    lag = replace(result.diagnosis.selected[0], parameters=number, same_as=("dead_time",))
    result = replace(result, diagnosis=replace(result.diagnosis, selected=(lag,)))
    monkeypatch.setattr(why_report, "read_result", lambda *_: result)
    titles = {BEFORE: "As trained", ALL_EFFECTS: "With lag"}
    why_report.write_why_page(tmp_path, titles, machine)
    text = (tmp_path / why_report.WHY_PAGE).read_text()
    for part in ("0.1 to 0.3", "that, or dead time", "-50", "the cost of link length", "cleared"):
        assert part in text, part
