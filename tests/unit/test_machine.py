"""A machine known by its joints only."""

from dataclasses import replace

import pytest
import torch

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import Gravity, Kinematics
from brokk_rl.machine import Machine
from brokk_rl.sim.model import compile_model

CPU = torch.device("cpu")


@pytest.fixture
def unseen(machine: Machine) -> Machine:
    return replace(
        machine,
        name="unseen",
        mjcf=None,
        tool_m=None,
        joints=tuple(replace(j, body=None) for j in machine.joints),
    )


@pytest.mark.parametrize(
    "use", [lambda m: Kinematics(m), lambda m: Gravity(m, CPU), lambda m: compile_model(m, 0.01)]
)
def test_what_needs_its_links_says_what_is_missing(unseen: Machine, use) -> None:
    with pytest.raises(ConfigError, match=r"'?unseen'? (is known by its joints|has no MJCF)"):
        use(unseen)


def test_bodies_stand_in_the_fingerprint(machine: Machine, unseen: Machine) -> None:
    assert machine.has_bodies
    assert {
        key
        for key in machine.fingerprint()
        if machine.fingerprint()[key] != unseen.fingerprint()[key]
    } == {"name", "geometry"}
