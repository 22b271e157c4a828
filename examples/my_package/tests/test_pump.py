"""The pump's flow goes to light joints first, on numbers worked by hand."""

from dataclasses import replace

import pytest
import torch

from brokk_rl.checks import ProportionalModel, check_effect
from brokk_rl.extensions import load_option
from brokk_rl.history import History

CPU = torch.device("cpu")
SETTLED = {"bearing": 0.0, "margin": 0.1, "surplus": 4.0, "stroke": 0.0}


@pytest.fixture(scope="module")
def machine():
    return load_option("machine", "my_arm")


def measure_speed(machine, command, **numbers):
    """Return the speeds of shoulder and elbow over their full speeds."""
    effect = replace(load_option("effect", "my_pump"), **(SETTLED | numbers))
    model = effect.wrap(ProportionalModel(machine, CPU), machine, 1, CPU)
    model.reset(torch.ones(1, dtype=torch.bool))
    q = torch.zeros(1, machine.num_history, 2)
    u = q.clone()
    u[:, -1] = torch.tensor(command)
    moved = model.step(History(q=q, u=u))[0]
    return (moved / torch.as_tensor(machine.max_speed * machine.period_s)).tolist()


def test_the_effect_keeps_its_contract(machine):
    check_effect(load_option("effect", "my_pump"), machine)


def test_a_light_joint_takes_the_flow_and_a_loaded_one_stands_still(machine):
    numbers = {"demand": 0.6, "handicap": {"shoulder": 0.3, "elbow": 0.0}}
    # the elbow takes the whole flow at 0.1 / 0.6**2 = 0.28 of relief pressure; the shoulder needs 0.3
    both = measure_speed(machine, [1.0, -1.0], **numbers)
    assert both == pytest.approx([0.0, -1.0 / 0.6], rel=0.01)
    alone = measure_speed(machine, [1.0, 0.0], **numbers)
    assert alone == pytest.approx([1.0 / 0.6, 0.0], rel=0.01)


def test_equal_joints_share_the_flow_in_proportion(machine):
    both = measure_speed(machine, [1.0, 0.5], demand=0.8, handicap=0.2)
    assert both == pytest.approx([1.0 / 1.2, 0.5 / 1.2], rel=0.01)


def test_relief_pressure_moves_no_heavier_load(machine):
    assert measure_speed(machine, [1.0, 0.0], demand=0.8, handicap=1.1) == [0.0, 0.0]


def test_an_open_centre_starves_a_loaded_joint_at_a_small_opening(machine):
    small = measure_speed(machine, [0.1, 0.0], demand=0.8, handicap=0.2, stroke=0.5)
    assert small == [0.0, 0.0]
    closed = measure_speed(machine, [0.5, 0.0], demand=0.8, handicap=0.2, stroke=0.5)
    # a closed centre leaves 1 / 0.4 of the nominal flow, and the valve passes sqrt(4)
    assert closed == pytest.approx([1.0, 0.0], rel=0.01)


def test_a_joint_without_demand_moves_as_commanded(machine):
    moved = measure_speed(machine, [1.0, 1.0], demand={"shoulder": 0.0, "elbow": 1.6}, handicap=0.2)
    assert moved == pytest.approx([1.0, 1.0 / 1.6], rel=0.01)
