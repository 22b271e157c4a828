"""Termination terms: when they hold, which of several counts, and which lists are refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from tasks.process import TerminationManager
from tasks.term_task import TerminationTerm
from tasks.terms import StepState

NOWHERE = torch.zeros(3, dtype=torch.bool)


def state(q: torch.Tensor | None = None, **changes: Any) -> StepState:
    """Returns three environments in the middle of an episode in which nothing ends."""
    names = ("pitch_rad", "contact_force_n", "peak_force_n", "steps", "age", "held_share")
    fields: dict[str, Any] = {name: torch.zeros(3) for name in names}
    fields |= {name: torch.zeros(3, 2) for name in ("u", "u_before")}
    still = (torch.zeros(3, 2) if q is None else q)[:, None]
    fields |= {"history": History(q=still, u=still), "start": {}}
    fields |= {"lower": -torch.ones(2), "upper": torch.ones(2), "tip_m": torch.zeros(3, 3)}
    fields |= {"max_steps": 10, "period_s": 0.05, "success": NOWHERE, "failed": NOWHERE}
    return StepState(**fields | changes)


def ends(name: str, outcome: Any = "failure", **params: Any) -> TerminationTerm:
    return TerminationTerm(function=f"tasks.terms:{name}", params=params, outcome=outcome)


SUCCESS, START = ends("success", "success"), ends("start_in_contact", "void")
TIME = ends("time_limit", "time")


@pytest.mark.parametrize(
    ("term", "changes"),
    [
        (ends("joint_limit", margin=0.1), {"q": [[0.0, 0.0], [0.0, -0.91], [0.89, 0.0]]}),
        (ends("force_limit", largest_n=100.0), {"contact_force_n": [0.0, 101.0, 100.0]}),
        (TIME, {"steps": [0.0, 10.0, 9.0]}),
        (SUCCESS, {"success": [False, True, False]}),
        (START, {"age": [1.0, 1.0, 2.0], "contact_force_n": [0.0, 1.0, 1.0]}),
    ],
    ids=lambda value: getattr(value, "function", ""),
)
def test_a_term_holds_in_the_second_environment_only(term: Any, changes: dict[str, Any]) -> None:
    here = state(**{name: torch.tensor(value) for name, value in changes.items()})
    assert term.resolve()(here).tolist() == [False, True, False]


def test_the_first_term_counts_and_time_counts_last() -> None:
    blow, limit = ends("force_limit", largest_n=100.0), ends("joint_limit", margin=0.0)
    terms = TerminationManager({"time_limit": TIME, "blow": blow, "off": None, "limit": limit})
    assert terms.reasons == ("blow", "limit", "fault", "time_limit")
    q, force_n = torch.tensor([[2.0, 0.0], [0.0, 0.0], [2.0, 0.0]]), torch.tensor([200.0, 0.0, 0.0])
    here = state(q, steps=torch.tensor([10.0, 10.0, 1.0]), contact_force_n=force_n)
    endings = terms.judge(here, torch.tensor([False, False, True]))
    counted = [terms.reasons[int(index)] for index in endings.reason]
    assert counted == ["blow", "time_limit", "limit"]
    assert endings.terminated.tolist() == [True, False, True]
    assert endings.timed_out.tolist() == [False, True, False]
    assert here.failed.tolist() == [True, False, True]
    assert endings.is_sound.tolist() == [True, True, False]


def test_a_void_start_is_no_success_and_no_failure() -> None:
    terms = TerminationManager({"success": SUCCESS, "start": START, "time_limit": TIME})
    here = state(age=torch.ones(3), success=~NOWHERE, contact_force_n=torch.tensor([1.0, 0.0, 0.0]))
    endings = terms.judge(here, NOWHERE)
    assert here.success.tolist() == [False, True, True] and not here.failed.any()
    assert endings.reason.tolist() == [1.0, 0.0, 0.0]
    assert endings.is_sound.tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("terms", "told"),
    [
        ({"success": SUCCESS}, "expected a time limit"),
        ({"time_limit": None}, "expected a time limit"),
        ({"fault": TIME}, "termination.fault: the simulator's own faults"),
    ],
)
def test_a_list_that_cannot_end_an_episode_is_refused(terms: dict[str, Any], told: str) -> None:
    task = option("task", "goal_pose")
    with pytest.raises(ConfigError, match=told):
        dataclasses.replace(task, termination=terms)
