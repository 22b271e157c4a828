"""`mode=why`: the verdict over all stages, and inputs that are refused before the first stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from brokk_rl.statistics import compute_wilson_interval
from diagnosis import why_answer
from diagnosis.answer import Answer, Selected
from diagnosis.why_answer import ALL_EFFECTS, BEFORE, WhyResult, subtract_rates

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
    found = Answer(verdict="effects", selected=(lag,), ranking=(), gap=None)
    success = {} if after is None else {BEFORE: RATES[1.0], ALL_EFFECTS: RATES[after]}
    return WhyResult(tmp_path, DOCTOR | {"verdict": verdict}, found, success, "runs/policy", "mlp")


@pytest.mark.parametrize(
    ("after", "verdict", "cause", "title", "said"),
    [
        (0.5, "nothing", "actuator", "The machine is the cause", "from 100 % (94 to 100) to 50 %"),
        # 5 points; the interval of the loss goes below 0
        (0.95, "nothing", "nothing", "what differs costs no success", "costs no success for sure"),
        (None, "nothing", "nothing", "the machine differs", "was not measured"),
        (None, "actuator", "actuator", "The machine is the cause", "was not measured"),
        (0.5, "code", "code", "The deployed code is the cause", "Mend this first"),
    ],
)
def test_the_cause_weighs_all_stages(
    tmp_path: Path, after: float | None, verdict: str, cause: str, title: str, said: str
) -> None:
    result = make_result(tmp_path, after, verdict)
    assert result.cause == cause
    assert title in result.title[0]
    summary = why_answer.write_summary(result)
    assert said in summary
    assert ("lag on q3" in summary) == (cause != "code")


def test_the_interval_of_a_difference_is_newcombe_s() -> None:
    # his table II, case (a), 56/70 and 48/80: 0.0524 to 0.3339
    rates = []
    for k, n in ((56, 70), (48, 80)):
        rates.append({"mean": k / n, "ci95": list(compute_wilson_interval(k, n))})
    assert subtract_rates(*rates)["ci95"] == pytest.approx([0.0524, 0.3339], abs=5e-5)
