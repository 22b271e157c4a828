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
    joints = tuple(replace(joint, body=None) for joint in machine.joints)
    return replace(machine, name="unseen", mjcf=None, tool_m=None, joints=joints)


@pytest.mark.parametrize(
    "use", [lambda m: Kinematics(m), lambda m: Gravity(m, CPU), lambda m: compile_model(m, 0.01)]
)
def test_what_needs_its_links_says_what_is_missing(unseen: Machine, use) -> None:
    with pytest.raises(ConfigError, match=r"'?unseen'? (is known by its joints|has no MJCF)"):
        use(unseen)


def test_bodies_stand_in_the_fingerprint(machine: Machine, unseen: Machine) -> None:
    assert machine.has_bodies
    known, other = machine.fingerprint(), unseen.fingerprint()
    assert {key for key in known if known[key] != other[key]} == {"name", "geometry"}
