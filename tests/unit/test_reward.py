"""Reward terms on numbers worked by hand; `state` has 0.25 m and 0.25 rad left to the target."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from tasks import terms
from tasks.term_task import RewardCurriculum, RewardTerm
from tasks.terms import ToolState

YES, NO = torch.tensor([True]), torch.tensor([False])


@pytest.fixture
def state() -> ToolState:
    still = torch.zeros(1, 2, 5)
    return ToolState(
        history=History(q=still, u=still),
        lower=-torch.ones(5),
        upper=torch.ones(5),
        steps=torch.tensor([4.0]),
        max_steps=100,
        age=torch.tensor([4.0]),
        period_s=0.05,
        start={},
        kinematics=None,  # type: ignore[arg-type]
        held_share=torch.zeros(1),
        tip_m=torch.tensor([[2.5, 0.0, 0.9]]),
        pitch_rad=torch.tensor([1.25]),
        target_m=torch.tensor([[2.5, 0.2, 0.75]]),  # 0.2 and 0.15 make 0.25
        target_pitch_rad=torch.tensor([1.5]),
        reach_m=torch.tensor([2.0]),
        reach_range_m=(1.7, 2.4),
        positioning=NO,
        contact_force_n=torch.tensor([0.0]),
        peak_force_n=torch.tensor([0.0]),
        u=torch.tensor([[0.5, 0.0, -0.25, 0.0, 1.0]]),
        u_before=torch.tensor([[0.25, 0.0, 0.25, 0.0, 1.0]]),
        success=NO,
        reached=NO,
        paper_success=NO,
        failed=NO,
        closeness=torch.tensor([0.5]),
        closeness_before=torch.tensor([0.375]),
    )


@pytest.mark.parametrize(
    ("reach_m", "expected"),
    [(2.9, 0.25 / 1.5), (2.4, 0.25), (1.7, 0.25), (1.2, 0.25 / 1.5), (3.4, 0.25 / 2)],
)
def test_working_distance_falls_off_outside_the_good_range(
    state: ToolState, reach_m: float, expected: float
) -> None:
    positioning = replace(state, positioning=YES, reach_m=torch.tensor([reach_m]))
    assert terms.working_distance(positioning, edge=0.25).item() == pytest.approx(
        expected, rel=1e-5
    )


def test_while_positioning_only_the_working_distance_counts(state: ToolState) -> None:
    positioning = replace(
        state, positioning=YES, contact_force_n=torch.tensor([900.0]), paper_success=YES
    )
    for term in (terms.distance, terms.pitch, terms.insertion, terms.approach_command_change):
        assert term(positioning).item() == 0.0, term.__name__
    assert terms.far_contact(positioning, largest=0.7).item() == 0.0
    assert terms.working_distance(state, edge=0.25).item() == 0.0, (
        "and once it is done, all the others"
    )


def test_distance_is_one_over_one_plus_metres(state: ToolState) -> None:
    assert terms.distance(state).item() == pytest.approx(1 / 1.25)


def test_pitch_is_one_over_one_plus_radians_both_ways(state: ToolState) -> None:
    assert terms.pitch(state).item() == pytest.approx(1 / 1.25)
    assert terms.pitch(replace(state, pitch_rad=torch.tensor([1.75]))).item() == pytest.approx(
        1 / 1.25
    )


def test_insertion_pays_both_alignments_while_the_papers_criterion_holds(state: ToolState) -> None:
    assert terms.insertion(state).item() == 0.0
    assert terms.insertion(replace(state, paper_success=YES)).item() == pytest.approx(0.8 + 0.8)


@pytest.mark.parametrize(
    ("distance_m", "expected"), [(0.5, 120.0), (0.43, 120.0), (0.42, 0.0), (0.25, 0.0)]
)  # r^d = 0.7 at 3/7 m = 0.4286 m
def test_contact_costs_its_force_only_far_from_the_hole(
    state: ToolState, distance_m: float, expected: float
) -> None:
    touching = replace(
        state,
        contact_force_n=torch.tensor([120.0]),
        target_m=state.tip_m + torch.tensor([[0.0, 0.0, distance_m]]),
    )
    assert terms.far_contact(touching, largest=0.7).item() == pytest.approx(expected)


def test_travel_of_the_valves_and_speed_of_the_tip_are_those_of_the_last_period(
    state: ToolState, machine: Machine
) -> None:
    q, u = torch.zeros(1, 3, 5), torch.zeros(1, 3, 5)
    u[0, :, 0] = torch.tensor([0.9, 0.5, 0.25])
    q[0, 1:, 0] = torch.tensor([0.1, 0.1001])
    moved = replace(state, history=History(q=q, u=u), kinematics=Kinematics(machine))
    assert terms.valve_travel(moved).item() == pytest.approx(0.25 / 0.05)
    moved = replace(moved, tip_m=Kinematics(machine).pose(q[:, -1]).tip_in_base_m)
    # the arm is stretched to 5.2 m and slews by 1e-4 rad
    speed_m_s = moved.tip_velocity_m_s.norm().item()
    assert speed_m_s == pytest.approx(5.2 * 1e-4 / 0.05, rel=1e-2)
    assert not moved.is_first and replace(state, age=torch.tensor([1.0])).is_first


def test_command_change_sums_over_joints(state: ToolState) -> None:
    assert terms.approach_command_change(state).item() == pytest.approx(0.25 + 0.5)
    assert terms.command_change(replace(state, positioning=YES)).item() == pytest.approx(0.75), (
        "this one counts everywhere"
    )


def test_the_papers_total_on_one_state(state: ToolState) -> None:
    """r^d + r^o + r^i - r^c - r^a, 0.8 + 0.8 + 5 (0.8 + 0.8) - 0 - 0.0075."""
    done = replace(state, paper_success=YES)
    weights = {
        "distance": 1,
        "pitch": 1,
        "insertion": 5,
        "far_contact": -0.01,
        "approach_command_change": -0.01,
        "working_distance": 1,
    }
    params = {"far_contact": {"largest": 0.7}, "working_distance": {"edge": 0.25}}
    total = 0.0
    for name, weight in weights.items():
        term = RewardTerm(function=f"tasks.terms:{name}", params=params.get(name, {}), weight=1.0)
        total = total + weight * term.resolve()(done)
    assert float(total) == pytest.approx(1.6 + 8.0 - 0.0075, rel=1e-5)


def test_progress_is_the_gain_of_closeness(state: ToolState) -> None:
    assert terms.progress(state).item() == 0.125


def test_success_and_duration_are_one(state: ToolState) -> None:
    assert (
        terms.success(state).item() == 0.0
        and terms.success(replace(state, success=YES)).item() == 1.0
    )
    assert terms.duration(state).item() == 1.0


def test_failing_costs_one_and_what_was_gained(state: ToolState) -> None:
    assert terms.failure(state).item() == 0.0
    assert terms.failure(replace(state, failed=YES)).item() == 1.5


def test_contact_counts_kilonewtons_up_to_ten(state: ToolState) -> None:
    forces = torch.tensor([0.0, 2500.0, 80000.0])
    assert terms.contact(replace(state, contact_force_n=forces), most_n=1e4).tolist() == [
        0.0,
        2.5,
        10.0,
    ]


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


@pytest.mark.parametrize(
    ("before_n", "now_n", "expected"),
    [(0, 2500, 2.5), (2500, 1000, 0), (9000, 14000, 1.0), (12000, 15000, 0)],
)
def test_an_episode_pays_for_its_hardest_blow_once(
    state: ToolState, before_n: float, now_n: float, expected: float
) -> None:
    blow = replace(
        state,
        peak_force_n=torch.tensor([float(before_n)]),
        contact_force_n=torch.tensor([float(now_n)]),
    )
    assert terms.peak_contact(blow, above_n=0.0, most_n=1e4).item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("before_n", "now_n", "expected"),
    [(0, 9_000, 0.0), (0, 12_500, 2.5), (12_000, 12_500, 0.5), (20_000, 12_500, 0.0), (0, 3e5, 90)],
)
def test_a_heavy_blow_pays_for_what_the_peak_grows_beyond_ten_kilonewtons(
    state: ToolState, before_n: float, now_n: float, expected: float
) -> None:
    blow = replace(
        state, peak_force_n=torch.tensor([before_n]), contact_force_n=torch.tensor([now_n])
    )
    assert terms.peak_contact(blow, above_n=1e4, most_n=1e5).item() == pytest.approx(expected)


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
