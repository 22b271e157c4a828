"""Proposing to a person: what their hands will yet do, proposals they can follow, and a policy that knows what it proposed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
import training as runs
from composed import MACHINE, option

from actuators.person import HumanFollower
from brokk_rl.checks import check_task
from brokk_rl.extensions import load_mode
from brokk_rl.machine import mask_exclusive_joints
from brokk_rl.observation import ObservationEncoder, list_pose_parts
from brokk_rl.rl.loop import ControlLoop
from tasks.advice import LeverAdviser
from tasks.settings import AdviceConfig

CPU = torch.device("cpu")


def advice(**changes: Any) -> AdviceConfig:
    numbers: dict[str, Any] = {"delay_s": 0.3, "lag_s": 0.15, "dead_zone": 0.0}
    numbers |= {"joints_at_once": None, "hold_s": 0.3, "settle_s": 1.5}
    return AdviceConfig(**(numbers | changes))


def person(**changes: Any) -> HumanFollower:
    numbers: dict[str, Any] = {
        "delay_s": 0.3, "lag_s": 0.15, "attention_s": 0.0, "gain": 1.0, "tremor": 0.0, "dead_zone": 0.0, "joints_at_once": None,
        "grip_s": 0.0,
    }  # fmt: skip
    return HumanFollower(**(numbers | changes))


def task(name: str = "borehole_insertion", **changes: Any) -> Any:
    """Returns the task as `follower=person` makes it."""
    words = ("mode=evaluate", f"task={name}", "follower=person", "session.out=unused")
    return replace(load_mode(*words).task, **changes)


@pytest.mark.parametrize(
    ("numbers", "off", "off_in_all"),
    [
        ({}, 0.12, 0.45),
        ({"delay_s": 0.22}, 0.12, 0.45),
        ({"lag_s": 0.0}, 1e-5, 1e-5),
        ({"dead_zone": 0.05}, 0.12, 0.45),
        ({"delay_s": 0.47, "dead_zone": 0.1}, 0.12, 0.45),
    ],
)
def test_what_is_coming_is_what_a_person_gives_when_nothing_more_is_proposed(
    numbers: dict[str, float], off: float, off_in_all: float
) -> None:
    """Held against the simulated person, who moves q1, q3, q4 and q5."""
    adviser = LeverAdviser(advice(**numbers), MACHINE, CPU)
    model = person(**numbers).build(MACHINE, 1, CPU)
    given = torch.zeros(1, 5)
    drawn = torch.rand(13, 1, 5, generator=torch.Generator().manual_seed(2))
    proposed = (2 * drawn - 1) * torch.tensor([1.0, 0.0, 1.0, 1.0, 1.0])
    for row in proposed:
        given = model.step(row).clone()
    coming = adviser.coming(proposed.transpose(0, 1), given)
    later = torch.stack([model.step(torch.zeros(1, 5)).clone() for _ in range(coming.shape[1])], 1)
    # the hand is known as the mean of its last period, not as where it ended
    assert later.abs().max() > 0.3
    torch.testing.assert_close(coming, later, rtol=0, atol=off)
    torch.testing.assert_close(coming.sum(1), later.sum(1), rtol=0, atol=off_in_all)


def test_a_proposal_makes_up_for_the_lever_s_dead_zone() -> None:
    wanted = torch.tensor([[0.5, 0.0, -0.1, 1.0, 0.02]])
    adviser = LeverAdviser(advice(dead_zone=0.05), MACHINE, CPU)
    shown = adviser.proposal(wanted, torch.zeros(1, 13, 5))
    given = person(dead_zone=0.05, delay_s=0.0, lag_s=0.0).build(MACHINE, 1, CPU).step(shown)
    torch.testing.assert_close(given, wanted)


def test_no_more_levers_are_proposed_than_a_person_has_hands_for_and_each_for_a_while() -> None:
    adviser = LeverAdviser(advice(joints_at_once=(2, 4), hold_s=0.15), MACHINE, CPU)
    proposed = torch.zeros(1, 13, 5)
    moved = []
    for step in range(8):
        # from the second period on q4 and q5 are asked for more
        wanted = [0.3, 0.0, 0.2, 0.9, 0.8] if step else [0.5, 0.0, 0.4, 0.1, 0.0]
        shown = adviser.proposal(torch.tensor([wanted]), proposed)
        proposed = torch.cat((proposed[:, 1:], shown[:, None]), 1)
        moved.append(tuple((shown[0] != 0).nonzero()[:, 0].tolist()))
    assert moved == [(0, 2)] * 3 + [(3, 4)] * 5
    nothing = adviser.proposal(torch.zeros(1, 5), proposed)
    assert not nothing.any(), "what is no longer wanted is not proposed"


def test_proposals_keep_the_masks() -> None:
    adviser = LeverAdviser(advice(joints_at_once=1), MACHINE, CPU)
    generator = torch.Generator().manual_seed(0)
    proposed, exclusive = torch.zeros(8, 13, 5), torch.as_tensor(MACHINE.is_exclusive)
    for _ in range(40):
        wanted = torch.rand(8, 5, generator=generator) * 2 - 1
        positioning = torch.rand(8, generator=generator) < 0.5
        wanted = wanted.where(mask_exclusive_joints(exclusive, positioning), 0.0)
        shown = adviser.proposal(wanted, proposed)
        proposed = torch.cat((proposed[:, 1:], shown[:, None]), 1)
        assert ((shown != 0) <= (wanted != 0)).all() and ((shown != 0).sum(1) == 1).all()


@pytest.mark.parametrize("name", ["borehole_insertion", "goal_pose"])
def test_a_task_that_proposes_to_a_person_keeps_the_promises_of_a_task(name: str) -> None:
    check_task(task(name), MACHINE)
    assert option("task", name).advice is None, "nobody stands between by default"


@pytest.mark.parametrize("with_pitch", [False, True])
def test_the_vector_holds_the_proposals_at_its_end(with_pitch: bool) -> None:
    scaling = option("task", "goal_pose" if with_pitch else "borehole_insertion").scaling
    parts = list_pose_parts(MACHINE, scaling, with_proposals=True)
    encoder = ObservationEncoder(parts, torch.tensor, torch.cat)
    values = {part.name: torch.rand(2, *part.shape) for part in parts}
    vector = encoder.encode(values)
    assert vector.shape == (2, encoder.size) and encoder.size == 198 + with_pitch
    assert torch.equal(vector[:, -65:], values["proposals"].flatten(1))
    for name, found in encoder.decode(vector).items():
        torch.testing.assert_close(found, values[name])
    assert encoder.describe()["order"][-1] == "proposals oldest first (H x J)"


def loop_of() -> ControlLoop:
    torch.manual_seed(0)
    quiet = replace(task().noise, q_scale=0.0, u_scale=0.0)
    plant = runs.plant(task(noise=quiet), follower=option("follower", "person"))
    return plant.build(CPU, 6, 64, 5)


def test_the_policy_sees_what_it_proposed_and_what_was_given() -> None:
    loop, proposals = loop_of(), []
    for action in torch.randn(5, 6, 5):
        loop.step(action)
        proposals.append(loop.task.state["u"].clone())
    vector = loop.get_observations()["policy"]
    assert torch.equal(vector[:, -25:], torch.stack(proposals, 1).flatten(1))
    assert not torch.equal(loop.end_u, proposals[-1])
    most = torch.stack(proposals).ne(0).sum(2).max()
    assert most <= 2, "as many as the person with the fewest hands can move"
    loop.episode_length_buf = torch.zeros(6) + loop.max_episode_length - 1
    loop.step(torch.zeros(6, 5))
    seen = loop.get_observations()["policy"]
    assert not seen[:, -65:].any(), "a new episode has proposed nothing"


def test_what_is_deployed_proposes_what_training_proposed() -> None:
    loop = loop_of()
    deployed = loop.task.deployable(lambda groups: groups["policy"][:, 3:8])  # type: ignore[arg-type]
    for _ in range(30):
        vector = loop.get_observations()["policy"]
        expected = deployed(vector)
        loop.step(vector[:, 3:8])
        torch.testing.assert_close(loop.task.state["u"], expected, rtol=0, atol=1e-4)


def test_a_contract_says_what_the_policy_knows_of_the_person() -> None:
    told = task().build(MACHINE, 1, CPU).describe()
    assert told["size"] == 198 and told["advice"]["delay_s"] == (0.2, 0.4)
    assert told["advice"]["joints_at_once"] == (2, 4)
    assert "advice" not in option("task", "borehole_insertion").build(MACHINE, 1, CPU).describe()
