"""The person at the levers, on numbers worked by hand; a control period is 50 ms. And what the control loop makes of it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
import training as runs
from composed import MACHINE, option
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from promises import check_follower

from actuators.person import HumanFollower
from brokk_rl.build import describe_spec
from brokk_rl.errors import ConfigError
from brokk_rl.machine import mask_exclusive_joints
from brokk_rl.policy_choice import CLASSICAL, _insert_behaviour
from brokk_rl.policy_folder import find_policy
from brokk_rl.rl.loop import ControlLoop
from deploy.policy.bundle import PolicyBundle

CPU = torch.device("cpu")
NEUTRAL: dict[str, Any] = {
    "delay_s": 0.0, "lag_s": 0.0, "attention_s": 0.0, "gain": 1.0, "tremor": 0.0, "dead_zone": 0.0, "joints_at_once": None,
    "grip_s": 0.0,
}  # fmt: skip


def person(**numbers: Any) -> HumanFollower:
    return HumanFollower(**(NEUTRAL | numbers))


def follow(proposed: torch.Tensor, **numbers: Any) -> torch.Tensor:
    """Returns what one person gives, `(T, J)`, where `proposed`, `(T, J)`, is shown."""
    model = person(**numbers).build(MACHINE, 1, CPU)
    return torch.stack([model.step(row[None])[0].clone() for row in proposed])


def q1(values: list[float], **numbers: Any) -> list[float]:
    """Returns what is given on q1 where only q1 is asked for."""
    proposed = torch.zeros(len(values), 5)
    proposed[:, 0] = torch.tensor(values)
    found = follow(proposed, **numbers)
    assert not found[:, 1:].any()
    return found[:, 0].tolist()


def exclusive_proposals(num_steps: int, num: int = 1) -> torch.Tensor:
    """Returns random proposals under the masks, `(T, N, J)`."""
    generator = torch.Generator().manual_seed(0)
    proposed = torch.rand((num_steps, num, 5), generator=generator) * 2 - 1
    positioning = torch.rand((num_steps, num, 1), generator=generator) < 0.3
    return torch.where(torch.as_tensor(MACHINE.is_exclusive) == positioning, proposed, 0.0)


def test_a_perfect_person_changes_no_bit() -> None:
    proposed = exclusive_proposals(100)[:, 0]
    assert torch.equal(follow(proposed), proposed)


def test_delay_and_lag_together_are_those_of_continuous_time() -> None:
    """Against a simulation of hand and display in steps of 0.1 ms."""
    generator = torch.Generator().manual_seed(3)
    shown = (torch.rand(30, generator=generator) * 2 - 1).tolist()
    fine_s, hand, means = 1e-4, 0.0, []
    for k in range(30):
        mean = 0.0
        for i in range(500):
            seen_s = 0.05 * k + (i + 0.5) * fine_s - 0.27
            target = shown[int(seen_s // 0.05)] if seen_s >= 0 else 0.0
            before, hand = hand, target + (hand - target) * math.exp(-fine_s / 0.12)
            mean += (before + hand) / 2 / 500
        means.append(mean)
    assert q1(shown, delay_s=0.27, lag_s=0.12) == pytest.approx(means, abs=1e-4)


RISING = [0.1 * k for k in range(1, 9)]
BOTH_WAYS = [0.05, 0.5, -0.5, 1.0]


@pytest.mark.parametrize(
    ("numbers", "shown", "expected"),
    [
        # a person looks every so often and goes on with what was seen
        ({"attention_s": 0.15}, RISING, [0.1, 0.1, 0.1, 0.4, 0.4, 0.4, 0.7, 0.7]),
        # every 2.5 periods: two and three in turn
        ({"attention_s": 0.125}, RISING, [0.1, 0.1, 0.1, 0.4, 0.4, 0.6, 0.6, 0.6]),
        ({"gain": 0.8}, BOTH_WAYS, [0.04, 0.4, -0.4, 0.8]),
        ({"gain": 1.5}, BOTH_WAYS, [0.075, 0.75, -0.75, 1.0]),  # a lever has a stop
        ({"dead_zone": 0.1}, BOTH_WAYS, [0.0, 0.4 / 0.9, -0.4 / 0.9, 1.0]),
        ({"dead_zone": {"q1": 0.2, "other": 0.0}}, BOTH_WAYS, [0.0, 0.375, -0.375, 1.0]),
    ],
)
def test_a_lever_follows(numbers: Any, shown: Any, expected: Any) -> None:
    assert q1(shown, **numbers) == pytest.approx(expected)


def test_tremor_is_in_proportion_to_the_deflection_and_has_no_mean() -> None:
    model = person(tremor=0.1).build(MACHINE, 4000, CPU)
    proposed = torch.tensor([0.2, 0.0, 0.4, 0.0, 0.6]).expand(4000, 5)
    found = model.step(proposed).clone()
    again = model.step(proposed)
    assert found.std(0).tolist() == pytest.approx([0.02, 0.0, 0.04, 0.0, 0.06], rel=0.05)
    assert found.mean(0).tolist() == pytest.approx([0.2, 0.0, 0.4, 0.0, 0.6], abs=0.005)
    assert not torch.equal(found, again)
    assert torch.corrcoef(torch.stack((found[:, 0], again[:, 0])))[0, 1].abs() < 0.1
    # each hand trembles by itself
    assert torch.corrcoef(found[:, [0, 2, 4]].T).fill_diagonal_(0).abs().max() < 0.1


def test_few_levers_are_moved_at_once_the_largest_first() -> None:
    proposed = torch.tensor(
        [[0.3, 0.0, -0.5, 0.4, 0.2], [0.5, 0.0, 0.5, 0.5, 0.5], [0.1, 0.0, 0.0, 0.0, 0.0]]
    )
    # of equals the one in hand
    one = torch.tensor([[0, 0, -0.5, 0, 0], [0, 0, 0.5, 0, 0], [0.1, 0, 0, 0, 0]])
    two = torch.tensor([[0, 0, -0.5, 0.4, 0], [0, 0, 0.5, 0.5, 0], [0.1, 0, 0, 0, 0]])
    for count, expected in ((1, one), (2, two), (9, proposed)):
        assert torch.equal(follow(proposed, joints_at_once=count), expected)


def test_a_lever_once_taken_is_kept_while_it_is_asked_for() -> None:
    proposed = torch.zeros(8, 5)
    proposed[:, 0], proposed[1:, 2] = 0.4, 0.8
    moved = follow(proposed, joints_at_once=1, grip_s=0.2) != 0
    assert moved[:, 0].tolist() == [True] * 4 + [False] * 4
    assert moved[:, 2].tolist() == [False] * 4 + [True] * 4
    proposed[2, 0] = 0.0
    moved = follow(proposed, joints_at_once=1, grip_s=0.2) != 0
    assert moved[:, 0].tolist() == [True] * 2 + [False] * 6, "what is no longer asked for is let go"
    proposed[3:] = torch.tensor([0.0, 0.2, 0.0, 0.0, 0.0])
    moved = follow(proposed, joints_at_once=1, grip_s=0.2) != 0
    # nor is an exclusive joint kept waiting
    assert moved[3:, 1].all() and not moved[3:, [0, 2, 3, 4]].any()


def test_how_many_levers_is_drawn_evenly() -> None:
    model = person(joints_at_once=(1, 4)).build(MACHINE, 4000, CPU)
    moved = (model.step(torch.tensor([0.5, 0.0, 0.4, 0.3, 0.2]).expand(4000, 5)) != 0).sum(1)
    assert moved.bincount()[1:].tolist() == pytest.approx([1000] * 4, rel=0.1)


def test_the_hand_changes_over_when_the_person_sees_it() -> None:
    """From q2 to q1 and q3 after three periods: until the reaction has passed q2 goes on, then it is let go at once."""
    proposed = torch.zeros(9, 5)
    proposed[:3, 1], proposed[3:6, 0], proposed[3:6, 2] = 0.6, 0.4, 0.8
    found = follow(proposed, delay_s=0.1, lag_s=0.1)
    assert (found[2:5, 1] > 0).all() and not found[5:, 1].any() and not found[:5, [0, 2]].any()
    assert (found[5:, [0, 2]] > 0).all(), "the hand comes back as it went, with its lag"


def test_before_the_valves_of_a_machine_stands_the_same_filter() -> None:
    assert PolicyBundle("tasks:policies/borehole_insertion", MACHINE).hand is None
    hand = PolicyBundle("tasks:policies/unidentified_machine", MACHINE).hand
    model = option("follower", "filter").build(MACHINE, 1, CPU)
    proposed = exclusive_proposals(60)[:, 0]
    proposed[20:25] = 0.0
    for row in proposed:
        expected = model.step(row[None])[0].tolist()
        assert hand.give(row.numpy().astype(float), True) == pytest.approx(expected, abs=1e-6)
    # let go, and not taken again
    assert not any(hand.give(0.0 * row.numpy(), guiding).any() for guiding in (False, True))


@settings(max_examples=30, deadline=None)
@given(
    delay_s=st.floats(0.0, 0.5), lag_s=st.floats(0.0, 0.3), attention_s=st.floats(0.0, 0.5), gain=st.floats(0.5, 1.5),
    dead_zone=st.floats(0.0, 0.2), tremor=st.floats(0.0, 0.2), joints_at_once=st.integers(1, 5) | st.none(),
    grip_s=st.floats(0.0, 1.0), seed=st.integers(0, 99),
)  # fmt: skip
def test_no_joint_moves_beside_an_exclusive_one(seed: int, **numbers: Any) -> None:
    # Not even the proposals are exclusive.
    proposed = torch.rand((60, 5), generator=torch.Generator().manual_seed(seed)) * 2 - 1
    moving = follow(proposed, **numbers) != 0
    assert not (moving[:, 1] & moving[:, [0, 2, 3, 4]].any(1)).any()
    assert (moving.sum(1) <= (numbers["joints_at_once"] or 5)).all()


@pytest.mark.parametrize("name", NEUTRAL)
def test_each_part_is_off_at_its_neutral_value(name: str) -> None:
    shipped = option("follower", "person")
    check_follower(replace(shipped, **{name: NEUTRAL[name]}), MACHINE)
    check_follower(person(**{name: getattr(shipped, name)}), MACHINE)


def test_each_episode_has_another_person_within_the_ranges() -> None:
    model = option("follower", "person").build(MACHINE, 2000, CPU)
    delay_s = model.state["drawn.delay_s"].clone()
    assert 0.2 <= delay_s.min() < 0.21
    assert 0.39 < delay_s.max() <= 0.4
    assert float(delay_s.mean()) == pytest.approx(0.3, abs=0.01)
    model.reset(torch.arange(2000) < 1000)
    assert (model.state["drawn.delay_s"][:1000] != delay_s[:1000]).float().mean() > 0.99
    assert torch.equal(model.state["drawn.delay_s"][1000:], delay_s[1000:])


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"delay_s": -0.1}, "follower.delay_s: expected 0 to 2 s"),
        ({"delay_s": (0.4, 0.2)}, "low <= high"),
        ({"dead_zone": {"q9": 0.1}}, "no joint of machine"),
        ({"joints_at_once": 0}, "1 or more"),
        ({"joints_at_once": (3, 2)}, "1 or more"),
    ],
)
def test_an_impossible_person_is_refused(numbers: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        person(**numbers).build(MACHINE, 1, CPU)


def test_a_step_asks_the_host_nothing_and_has_fixed_shapes() -> None:
    """Both would break the trace; a CUDA graph can hold what is left."""
    proposed = exclusive_proposals(20, num=4)
    torch.manual_seed(0)
    plain, traced = (option("follower", "person").build(MACHINE, 4, CPU) for _ in range(2))
    step = torch.compile(traced.step, backend="eager", fullgraph=True, dynamic=False)
    reset = torch.compile(traced.reset, backend="eager", fullgraph=True, dynamic=False)
    for index, shown in enumerate(proposed):
        assert torch.equal(plain.step(shown), step(shown))
        mask = torch.arange(4) == index % 8
        plain.reset(mask)
        reset(mask)


def loop_with(follower: Any) -> ControlLoop:
    torch.manual_seed(0)
    task = option("task", "borehole_insertion")
    task = replace(task, action=replace(task.action, kind="direct", scale=1.0))
    return runs.plant(task, follower=follower).build(CPU, 8, 64, 5)


def test_histories_and_recordings_hold_what_was_given() -> None:
    loop = loop_with(person(delay_s=0.1, gain=0.5))
    proposed = []
    for _ in range(6):
        action = torch.rand(8, 5)
        positioning = loop.task.state["positioning"].bool()
        is_allowed = mask_exclusive_joints(torch.as_tensor(MACHINE.is_exclusive), positioning)
        proposed.append(action.where(is_allowed, 0.0))
        loop.step(action)
    torch.testing.assert_close(loop.history.u[:, -4:], 0.5 * torch.stack(proposed[:4], 1))
    assert torch.equal(loop.end_u, loop.history.u[:, -1])
    assert torch.equal(loop.truth.u, loop.history.u)
    # the reward is about what the policy asks of the person
    assert torch.equal(loop.task.state["u"], proposed[-1])
    given = torch.cat((torch.zeros(8, 2, 5), 0.5 * torch.stack(proposed[:4], 1)), 1)
    travel = given.diff(dim=1).abs().sum((1, 2)) / 0.05 / 6
    torch.testing.assert_close(loop.task.episode["valve_travel"], travel)


def test_the_controller_beside_an_unadvised_policy_keeps_its_advice(caplog: Any) -> None:
    task = describe_spec(option("task", "borehole_insertion"))
    advice = {"delay_s": 0.3, "lag_s": 0.1, "dead_zone": 0.0, "joints_at_once": 2}
    advice |= {"hold_s": 0.65, "settle_s": 0.5}
    classical = {"_target_": CLASSICAL, "task": None}
    cfg = OmegaConf.create({"task": task | {"advice": advice}, "rivals": {"classical": classical}})
    stored = find_policy("tasks:policies/borehole_insertion")
    _insert_behaviour(cfg, stored.task, set(), stored)
    assert cfg.task.advice is None
    assert cfg.rivals.classical.task.advice == advice
    assert "without a person" in caplog.text
