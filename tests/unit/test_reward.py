"""Reward terms on numbers worked by hand; `state` has 0.25 m and 0.25 rad left to the target."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from tasks import terms
from tasks.term_task import RewardCurriculum, RewardTerm
from tasks.terms import ToolState

YES, NO = torch.tensor([True]), torch.tensor([False])


def put(**changes: float | bool) -> dict[str, torch.Tensor]:
    """Returns changes of a state of one environment."""
    return {name: torch.tensor([value]) for name, value in changes.items()}


@pytest.fixture
def state() -> ToolState:
    still = torch.zeros(1, 2, 5)
    outcomes = ("positioning", "success", "reached", "inserted", "paper_success", "failed")
    numbers = put(
        steps=4.0, age=4.0, held_share=0.0, pitch_rad=1.25, target_pitch_rad=1.5, reach_m=2.0, contact_force_n=0.0,
        peak_force_n=0.0, closeness=0.5, closeness_before=0.375, lateral_m=0.2,
    )  # fmt: skip
    return ToolState(
        **dict.fromkeys(outcomes, NO), **numbers,
        history=History(q=still, u=still), lower=-torch.ones(5), upper=torch.ones(5), max_steps=100, period_s=0.05, start={},
        tip_m=torch.tensor([[2.5, 0.0, 0.9]]),
        target_m=torch.tensor([[2.5, 0.2, 0.75]]),  # 0.2 and 0.15 make 0.25
        reach_range_m=(1.7, 2.4),
        u=torch.tensor([[0.5, 0.0, -0.25, 0.0, 1.0]]),
        u_before=torch.tensor([[0.25, 0.0, 0.25, 0.0, 1.0]]),
    )  # fmt: skip


AWAY, BEYOND = {"edge": 0.25}, {"largest": 0.7}
LIGHT, HEAVY = {"above_n": 0.0, "most_n": 1e4}, {"above_n": 1e4, "most_n": 1e5}


@pytest.mark.parametrize(
    ("name", "params", "changes", "expected"),
    [
        *(
            ("working_distance", AWAY, put(positioning=True, reach_m=reach_m), expected)
            for reach_m, expected in ((2.9, 0.25 / 1.5), (2.4, 0.25), (1.7, 0.25), (1.2, 0.25 / 1.5))
        ),
        ("working_distance", AWAY, {}, 0.0),  # once positioning is done
        ("pitch", {}, put(pitch_rad=1.75), 1 / 1.25),  # both ways alike
        ("insertion", {}, {}, 0.0),
        ("insertion", {}, put(paper_success=True), 1.6),
        *((name, {}, put(positioning=True, paper_success=True), 0.0)
          for name in ("distance", "pitch", "insertion", "approach_command_change")),
        ("far_contact", BEYOND, put(positioning=True, contact_force_n=900.0), 0.0),
        ("approach_command_change", {}, {}, 0.75),
        ("command_change", {}, put(positioning=True), 0.75),  # this one counts everywhere
        ("progress", {}, {}, 0.125),
        ("failure", {}, {}, 0.0),
        ("failure", {}, put(failed=True), 1.5),  # one and what was gained
        ("contact", {"most_n": 1e4}, put(contact_force_n=2500.0), 2.5),
        ("contact", {"most_n": 1e4}, put(contact_force_n=8e4), 10.0),
        *(
            ("peak_contact", params, put(peak_force_n=before_n, contact_force_n=now_n), expected)
            for params, before_n, now_n, expected in (
                (LIGHT, 0.0, 2500.0, 2.5),
                (LIGHT, 2500.0, 1000.0, 0.0),  # an episode pays for its hardest blow once
                (LIGHT, 9000.0, 14000.0, 1.0),
                (LIGHT, 12000.0, 15000.0, 0.0),
                (HEAVY, 0.0, 9000.0, 0.0),
                (HEAVY, 0.0, 12500.0, 2.5),
                (HEAVY, 12000.0, 12500.0, 0.5),
                (HEAVY, 20000.0, 12500.0, 0.0),
                (HEAVY, 0.0, 3e5, 90.0),
            )
        ),
    ],
)  # fmt: skip
def test_a_term_has_the_value_worked_by_hand(
    name: str, params: dict, changes: dict, expected: float, state: ToolState
) -> None:
    term = RewardTerm(function=f"tasks.terms:{name}", params=params, weight=1.0).resolve()
    assert float(term(replace(state, **changes))) == pytest.approx(expected, rel=1e-5)


# r^d = 0.7 at 3/7 m = 0.4286 m
@pytest.mark.parametrize(("distance_m", "expected"), [(0.43, 120.0), (0.42, 0.0)])
def test_contact_costs_its_force_only_far_from_the_hole(
    state: ToolState, distance_m: float, expected: float
) -> None:
    target_m = state.tip_m + torch.tensor([[0.0, 0.0, distance_m]])
    touching = replace(state, contact_force_n=torch.tensor([120.0]), target_m=target_m)
    assert terms.far_contact(touching, largest=0.7).item() == pytest.approx(expected)


def test_travel_of_the_valves_is_that_of_the_last_period(state: ToolState) -> None:
    u = torch.zeros(1, 3, 5)
    u[0, :, 0] = torch.tensor([0.9, 0.5, 0.25])
    moved = replace(state, history=History(q=u, u=u))
    assert terms.valve_travel(moved).item() == pytest.approx(0.25 / 0.05)
    assert not moved.is_first and replace(state, age=torch.tensor([1.0])).is_first


def test_the_papers_total_on_one_state(state: ToolState) -> None:
    """r^d + r^o + r^i - r^c - r^a, 0.8 + 0.8 + 5 (0.8 + 0.8) - 0 - 0.0075."""
    done = replace(state, paper_success=YES)
    terms = {
        ("distance", 1.0): {}, ("pitch", 1.0): {}, ("insertion", 5.0): {}, ("far_contact", -0.01): BEYOND,
        ("approach_command_change", -0.01): {}, ("working_distance", 1.0): AWAY,
    }  # fmt: skip
    total = 0.0
    for (name, weight), params in terms.items():
        term = RewardTerm(function=f"tasks.terms:{name}", params=params, weight=1.0)
        total += weight * float(term.resolve()(done))
    assert total == pytest.approx(1.6 + 8.0 - 0.0075, rel=1e-5)


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({}, "missing a required argument: 'most_n'; expected most_n, got none"),
        ({"most": 1.0}, "expected most_n, got most"),
        ({"most_n": "much"}, "params.most_n of the reward term .* expected a finite number"),
        ({"most_n": float("inf")}, "expected a finite number, got inf"),
    ],
)
def test_params_that_the_function_does_not_take_are_refused(params: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        RewardTerm(function="tasks.terms:contact", params=params, weight=1.0)


@pytest.mark.parametrize("function", ["tasks.terms:nonsense", "no.such.module:f", "tasks.terms"])
def test_a_term_that_is_no_function_is_refused(function: str) -> None:
    with pytest.raises(ConfigError, match=r"expected package\.module:function"):
        RewardTerm(function=function, weight=1.0)


def curriculum(**changes: object) -> RewardCurriculum:
    parts = {"begin": {"command_change": 0.2, "failure": 0.0}, "success": (0.5, 0.9)}
    parts |= {"figure": "success_reached"} | changes
    return RewardCurriculum(**parts)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("succeeded", "command_change", "failure"),
    [(0, 0.2, 0.0), (5, 0.2, 0.0), (6, 0.4, 0.25), (7, 0.6, 0.5), (9, 1.0, 1.0), (10, 1.0, 1.0)],
)
def test_a_curriculum_raises_its_terms_between_two_shares_of_successes(
    succeeded: int, command_change: float, failure: float
) -> None:
    outcomes = (torch.arange(10) < succeeded).float()
    scale = {name: part.item() for name, part in curriculum().scale(outcomes).items()}
    assert scale == pytest.approx({"command_change": command_change, "failure": failure})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"success": (0.9, 0.5)}, "success: expected low < high"),
        ({"success": (0.5, 0.5)}, "success: expected low < high"),
        ({"success": (0.5, 1.1)}, r"success\[1\]: expected"),
        ({"begin": {"failure": -0.1}}, "begin.failure: expected"),
    ],
)
def test_a_curriculum_that_makes_no_sense_is_refused(changes: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        curriculum(**changes)


@pytest.mark.parametrize("name", ["borehole_insertion", "goal_pose"])
def test_a_curriculum_of_a_term_that_the_task_lacks_is_refused(name: str) -> None:
    task = option("task", name)
    with pytest.raises(ConfigError, match=r"there is no reward term speed; choices: "):
        replace(task, curriculum=curriculum(begin={"speed": 0.5}))
    with pytest.raises(ConfigError, match=r"there is no figure touched; choices: "):
        replace(task, curriculum=curriculum(figure="touched"))
    replace(task, curriculum=curriculum(begin={"failure": 0.5}))
