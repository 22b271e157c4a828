"""Every option of a config group keeps the promises of its contract."""

from __future__ import annotations

import pytest
import torch
from composed import every, option

from brokk_rl.checks import NUM_ENVS, check_actuator, check_effect, check_finder, check_task, check_world
from brokk_rl.machine import Machine
from brokk_rl.sim.scene import nominal


@every("actuator")
def test_it_is_an_actuator(name: str, machine: Machine) -> None:
    check_actuator(option("actuator", name), machine)


@every("effect")
def test_it_is_an_effect(name: str, machine: Machine) -> None:
    check_effect(option("effect", name), machine)


@every("task")
def test_it_is_a_task(name: str, machine: Machine) -> None:
    check_task(option("task", name), machine)


@every("perception")
def test_it_is_a_finder(name: str) -> None:
    check_finder(option("perception", name))


@every("sim")
@pytest.mark.slow
def test_it_is_a_world(name: str, machine: Machine) -> None:
    device = "cuda" if torch.cuda.is_available() and name != "native" else "cpu"
    check_world(option("sim", name), machine, nominal(NUM_ENVS), device)
