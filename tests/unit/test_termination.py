"""Termination terms: when they hold, which of several counts, and which lists are refused."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch

from brokk_rl.errors import ConfigError
from tasks.step_state import StepState
from tasks.termination import (
    ContactForce,
    EpisodeTerms,
    JointLimit,
    StartInContact,
    Succeeded,
    TerminationTerm,
    TimeLimit,
    TipLeft,
    check_terminations,
)

NOWHERE = torch.zeros(3, dtype=torch.bool)


def state(**changes: Any) -> StepState:
    """Returns three environments in the middle of an episode in which nothing ends."""
    fields: dict[str, Any] = {
        name: torch.zeros(3) for name in ("pitch_rad", "contact_force_n", "peak_force_n", "steps")
    }
    fields |= {name: torch.zeros(3, 2) for name in ("q", "u", "u_before")}
    fields |= {"lower": -torch.ones(2), "upper": torch.ones(2), "tip_m": torch.zeros(3, 3)}
    fields |= {"max_steps": 10} | dict.fromkeys(("is_first", "success", "failed"), NOWHERE)
    return StepState(**fields | changes)


def drops(state: StepState) -> torch.Tensor:
    return state.tip_m[:, 2] < -1.0


@pytest.mark.parametrize(
    ("term", "changes"),
    [
        (JointLimit(margin=0.1), {"q": torch.tensor([[0.0, 0.0], [0.0, -0.91], [0.89, 0.0]])}),
        (ContactForce(largest_n=100.0), {"contact_force_n": torch.tensor([0.0, 101.0, 100.0])}),
        (
            TipLeft(x_m=(-1, 1), y_m=(-1, 1), z_m=(0, 2)),
            {"tip_m": torch.tensor([[1.0, -1.0, 0.0], [0.0, 1.1, 0.5], [-1.0, 0.5, 2.0]])},
        ),
        (TimeLimit(), {"steps": torch.tensor([0.0, 10.0, 9.0])}),
        (Succeeded(), {"success": torch.tensor([False, True, False])}),
        (
            StartInContact(),
            {
                "is_first": torch.tensor([True, True, False]),
                "contact_force_n": torch.tensor([0.0, 1.0, 1.0]),
            },
        ),
        (
            TerminationTerm(function=f"{__name__}:drops", outcome="failure"),
            {"tip_m": torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.1], [0.0, 0.0, 0.0]])},
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_term_holds_in_the_second_environment_only(term: Any, changes: dict[str, Any]) -> None:
    assert term(state(**changes)).tolist() == [False, True, False]


def test_the_first_term_counts_and_time_counts_last() -> None:
    terms = EpisodeTerms(
        {
            "time_limit": TimeLimit(),
            "blow": ContactForce(largest_n=100.0),
            "off": None,
            "limit": JointLimit(margin=0.0),
        }
    )
    assert terms.reasons == ("blow", "limit", "fault", "time_limit")
    here = state(
        steps=torch.tensor([10.0, 10.0, 1.0]),
        q=torch.tensor([[2.0, 0.0], [0.0, 0.0], [2.0, 0.0]]),
        contact_force_n=torch.tensor([200.0, 0.0, 0.0]),
    )
    endings = terms.judge(here, torch.tensor([False, False, True]))
    assert [terms.reasons[int(index)] for index in endings.reason] == [
        "blow",
        "time_limit",
        "limit",
    ]
    assert endings.terminated.tolist() == [True, False, True]
    assert endings.timed_out.tolist() == [False, True, False]
    assert here.failed.tolist() == [True, False, True]
    assert endings.is_sound.tolist() == [True, True, False]


def test_a_void_start_is_no_success_and_no_failure() -> None:
    terms = EpisodeTerms(
        {"success": Succeeded(), "start": StartInContact(), "time_limit": TimeLimit()}
    )
    here = state(is_first=~NOWHERE, success=~NOWHERE, contact_force_n=torch.tensor([1.0, 0.0, 0.0]))
    endings = terms.judge(here, NOWHERE)
    assert here.success.tolist() == [False, True, True] and not here.failed.any()
    assert endings.reason.tolist() == [1.0, 0.0, 0.0]
    assert endings.is_sound.tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("terms", "told"),
    [
        ({"success": Succeeded()}, "expected a time limit"),
        ({"time_limit": None}, "expected a time limit"),
        ({"odd": 3.0, "time_limit": TimeLimit()}, "termination.odd: float is no termination term"),
        ({"fault": TimeLimit()}, "termination.fault: the simulator's own faults"),
    ],
)
def test_a_list_that_cannot_end_an_episode_is_refused(terms: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        check_terminations(terms)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: ContactForce(largest_n=0.0), "largest_n"),
        (lambda: TipLeft(x_m=(1, 0), y_m=(0, 1), z_m=(0, 1)), "x_m of the termination TipLeft"),
        (lambda: TerminationTerm(function="tasks.reward:nothing", outcome="void"), "cannot be fou"),
        (lambda: TerminationTerm(function="tasks.reward:success", outcome=cast(Any, "end")), "out"),
        (lambda: TerminationTerm(function="tasks.noise:ROOT", outcome="void"), "is no function"),
    ],
)
def test_a_bad_value_of_a_term_is_refused(make: Any, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        make()
