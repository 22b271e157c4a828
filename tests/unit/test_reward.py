"""Reward terms on numbers worked by hand; `state` has 0.25 m and 0.25 rad left to the target."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option

from brokk_rl import observation
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import mask_exclusive_joints
from brokk_rl.observation import ObservationEncoder, TargetScaling, list_pose_parts
from tasks import terms
from tasks.settings import ActionMapping, CommandBase, PhaseSwitch
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
        ("distance", {}, {}, 1 / 1.25),
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


PLACE: dict[str, Any] = {"target_mean_m": (2.5, 0.0, 0.75), "target_std_m": (0.5, 1.0, 0.1)}
SCALING = TargetScaling(**PLACE, pitch_rad=None)
WITH_PITCH = TargetScaling(**PLACE, pitch_rad=(1.4, 0.35))


def make_values(count: int = 4) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    shape = (count, MACHINE.num_history, MACHINE.num_joints)
    values = {
        "target_in_base_m": generator.uniform((2, -1, 0.6), (3, 1, 0.9), (count, 3)),
        "q": generator.uniform(MACHINE.lower, MACHINE.upper, shape),
        "u": generator.uniform(-1, 1, shape),
        "pitch_rad": generator.uniform(0.6, 2, count),
    }
    return {name: value.astype(np.float32) for name, value in values.items()}


def make_encoder(scaling: TargetScaling) -> ObservationEncoder:
    return ObservationEncoder(list_pose_parts(MACHINE, scaling))


def test_target_then_positions_then_commands_each_oldest_first() -> None:
    q, u = np.zeros((1, 13, 5), np.float32), np.zeros((1, 13, 5), np.float32)
    # oldest sample of q2: travel -1.4 to 0.05, middle -0.675, quarter 0.3625, so
    # (0.05 + 0.675) / 0.3625 = 2; newest sample of q5, at its upper limit: 2 as well
    q[0, 0, 1], q[0, 12, 4] = 0.05, 2.2
    u[0, 0, 1], u[0, 12, 4] = 0.25, -0.5
    target_m = np.array([[3.0, -1.0, 0.85]], np.float32)
    encoder = make_encoder(SCALING)
    vector = encoder.encode({"target_in_base_m": target_m, "q": q, "u": u})[0]
    assert vector.shape == (133,) and encoder.size == 3 + 13 * 5 + 13 * 5 == 133
    assert vector[:3] == pytest.approx([1.0, -1.0, 1.0], abs=1e-5)
    assert vector[[3 + 1, 3 + 12 * 5 + 4]] == pytest.approx([2.0, 2.0], abs=1e-5)
    assert vector[3 + 65 + 1] == 0.25 and vector[132] == -0.5


@pytest.mark.parametrize("scaling", [SCALING, WITH_PITCH], ids=["paper", "with pitch"])
def test_numpy_and_torch_say_the_same_and_decoding_inverts_it(scaling: TargetScaling) -> None:
    values, encoder = make_values(), make_encoder(scaling)
    vector = encoder.encode(values)
    for name, found in encoder.decode(vector).items():
        np.testing.assert_allclose(found, values[name], atol=1e-6)
    in_torch = ObservationEncoder(list_pose_parts(MACHINE, scaling), torch.as_tensor, torch.cat)
    by_torch = in_torch.encode({name: torch.as_tensor(value) for name, value in values.items()})
    assert vector.dtype == np.float32 and by_torch.dtype == torch.float32
    np.testing.assert_allclose(vector, by_torch.numpy(), rtol=0, atol=1e-6)


def test_the_contract_tells_size_order_and_scale_and_gives_the_encoder_back() -> None:
    paper, pitch = (make_encoder(one).describe() for one in (SCALING, WITH_PITCH))
    assert paper["size"] == 133 and len(paper["order"]) == 3 and "pitch" not in paper
    assert pitch["size"] == 134 and pitch["order"][3] == "pitch_rad (1)"
    assert pitch["pitch"] == {"mean_rad": 1.4, "std_rad": 0.35}
    assert paper["q"]["mean"][1] == pytest.approx(-0.675)
    assert paper["q"]["std"][1] == pytest.approx(0.3625)
    assert observation.restore_encoder(MACHINE, pitch).describe() == pitch


def test_ranges_are_those_of_the_values_in_their_units() -> None:
    values, encoder = make_values(), make_encoder(SCALING)
    found = observation.measure_ranges(encoder, encoder.encode(values), MACHINE.joint_names)
    q1, x, y = values["q"][:, :, 0], *values["target_in_base_m"][:, :2].T
    assert found["q.q1"] == pytest.approx((q1.min(), q1.max()), abs=1e-6)
    assert found["target.x"] == pytest.approx((x.min(), x.max()), abs=1e-6)
    distance_m = np.hypot(x, y)
    expected = pytest.approx((distance_m.min(), distance_m.max()), abs=1e-6)
    assert found[observation.TARGET_DISTANCE] == expected


def switch(rule: str) -> PhaseSwitch:
    return PhaseSwitch(rule=rule, reach_m=(1.7, 2.4), height_m=0.2)  # type: ignore[arg-type]


def seen(reach_m: float, reach_3d_m: float, tip_z_m: float) -> Any:
    numbers = {"reach_m": reach_m, "reach_3d_m": reach_3d_m, "tip_z_m": tip_z_m}
    return SimpleNamespace(**{name: torch.tensor([value]) for name, value in numbers.items()})


@pytest.mark.parametrize(
    ("reach_m", "reach_3d_m", "tip_z_m", "planar", "text", "equation"),
    [
        # in range, tool high: the equation goes on positioning, the text does not
        (2.0, 2.0, 1.0, False, False, True),
        (2.0, 2.0, 0.1, False, False, False),  # in range, tool low
        (3.0, 3.0, 1.0, True, True, True),  # too far, tool high
        # too far, tool low: the text rests q2 to keep the tool off the ground
        (3.0, 3.0, 0.1, False, False, True),
        (1.0, 1.0, 1.0, True, True, True),  # too near
        # q1 points elsewhere: in the plane in range, in space not
        (2.0, 3.5, 1.0, False, True, True),
        (1.7, 1.7, 0.1, False, False, False),  # the edges belong to the range
        (2.4, 2.4, 0.1, False, False, False),
    ],
)
def test_each_rule_of_the_switch(
    reach_m: float, reach_3d_m: float, tip_z_m: float, planar: bool, text: bool, equation: bool
) -> None:
    for rule, expected in (("planar", planar), ("text", text), ("equation", equation)):
        assert switch(rule).positioning(seen(reach_m, reach_3d_m, tip_z_m)).item() is expected, rule


def test_at_the_height_itself_the_tool_is_not_low() -> None:
    assert switch("text").positioning(seen(3.0, 3.0, 0.2)).item() is True
    assert switch("equation").positioning(seen(2.0, 2.0, 0.2)).item() is True


FREE = torch.ones(5)
"""No joint is near its end."""


@pytest.mark.parametrize(
    ("limits", "step", "least", "largest"),
    [
        (True, None, [-1.0, 0.0, -0.3, -1.0], [0.0, 1.0, 1.0, 0.4]),
        (False, 0.1, [-0.1, 0.4, -1.0, 0.8], [0.1, 0.6, -0.8, 1.0]),
        # before its end a joint is let go at once
        (True, 0.1, [-0.1, 0.4, -0.3, 0.4], [0.0, 0.6, -0.3, 0.4]),
    ],
)
def test_commands_stay_before_ends_and_within_a_step(
    limits: bool, step: float | None, least: list[float], largest: list[float]
) -> None:
    action = ActionMapping(kind="residual", scale=1.0, mask=False, limits=limits, step=step)
    lowest, highest = torch.tensor([[-1.0, 0.0, -0.3, -1.0]]), torch.tensor([[0.0, 1.0, 1.0, 0.4]])
    last = torch.tensor([[0.0, 0.5, -0.9, 0.9]])
    bounds = action.bound(lowest, highest, last)
    base = CommandBase(torch.full((1, 4), 0.1), *bounds, torch.tensor([False]))
    for output, expected in ((-3.0, least), (3.0, largest)):
        u = action.command(torch.full((1, 4), output), base, torch.zeros(4, dtype=torch.bool))
        torch.testing.assert_close(u, torch.tensor([expected]))


@pytest.mark.parametrize("kind", ["direct", "residual"])
def test_the_masks_are_the_papers_and_those_of_the_machine(kind: str) -> None:
    action = ActionMapping(kind=kind, scale=0.5, mask=True, limits=False)  # type: ignore[arg-type]
    for positioning, paper in ((True, [0, 1, 0, 0, 0]), (False, [1, 0, 1, 1, 1])):
        flag = torch.tensor([positioning])
        base = CommandBase(torch.full((1, 5), 0.3), -FREE, FREE, flag)
        u = action.command(5 * torch.ones(1, 5), base, torch.as_tensor(MACHINE.is_exclusive))
        machines = mask_exclusive_joints(MACHINE.is_exclusive, positioning)
        assert u[0].tolist() == paper == machines.astype(int).tolist()


def test_direct_and_residual_actions_on_numbers() -> None:
    output = torch.tensor([[0.4, 0.4, -0.4, 4.0, 0.0]])
    command = torch.tensor([[0.5, 0.5, 0.5, 0.5, -0.25]])
    base = CommandBase(command, -FREE, FREE, torch.tensor([False]))
    exclusive = torch.as_tensor(MACHINE.is_exclusive)
    residual = ActionMapping(kind="residual", scale=0.5, mask=True, limits=False)
    direct = replace(residual, kind="direct").command(output, base, exclusive)
    unmasked = replace(residual, mask=False).command(output, base, exclusive)
    residual = residual.command(output, base, exclusive)
    np.testing.assert_allclose(direct[0], [0.2, 0.0, -0.2, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(residual[0], [0.7, 0.0, 0.3, 1.0, -0.25], atol=1e-6)
    np.testing.assert_allclose(unmasked[0], [0.7, 0.7, 0.3, 1.0, -0.25], atol=1e-6)
