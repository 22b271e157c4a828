"""Each part keeps the promises of its contract."""

import pytest

from brokk_rl.checks import check_actuator, check_effect, check_finder, check_task
from brokk_rl.extensions import load_option
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.sim.model import compile_model


@pytest.fixture(scope="module")
def machine():
    return load_option("machine", "my_arm")


def test_the_machine_can_be_simulated(machine):
    assert compile_model(machine, 0.005).nq == machine.num_joints


def test_the_stretched_arm_reaches_three_metres(machine):
    tip_m = compute_tool_kinematics(machine, [0.0, 0.0]).tip_in_base_m
    assert tip_m == pytest.approx([3.0, 0.0, 0.0])


def test_the_actuator_keeps_its_contract(machine):
    check_actuator(load_option("actuator", "my_rubber"), machine)


def test_the_effect_keeps_its_contract(machine):
    check_effect(load_option("effect", "my_sink"), machine)


def test_the_task_keeps_its_contract(machine):
    check_task(load_option("task", "my_trace"), machine)


def test_the_finder_keeps_its_contract():
    check_finder(load_option("perception", "my_darkest"))
