"""Every option of a config group keeps the promises of its contract."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from composed import MACHINE, every, names, option
from promises import check_excitation, check_follower, check_link, check_world

from brokk_rl.checks import NUM_ENVS, check_actuator, check_effect, check_finder, check_task
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.sim.link import SimulatedMachines
from brokk_rl.sim.scene import make_nominal_scenes


def find_machine(spec: object) -> Machine:
    """Returns the default machine, or one that is commanded as the spec asks for."""
    interfaces = getattr(spec, "interfaces", {"speed"})
    known = (MACHINE, option("machine", "so101"), option("machine", "emps"))
    return next(one for one in known if one.interface in interfaces)


@every("actuator")
def test_it_is_an_actuator(name: str) -> None:
    spec = option("actuator", name)
    check_actuator(spec, find_machine(spec))


@every("effect")
def test_it_is_an_effect(name: str) -> None:
    spec = option("effect", name)
    check_effect(spec, find_machine(spec))


@every("follower")
def test_it_is_a_follower(name: str) -> None:
    check_follower(option("follower", name), MACHINE)


@every("excitation")
def test_it_is_an_excitation(name: str) -> None:
    check_excitation(option("excitation", name), MACHINE)


@pytest.mark.parametrize("num_runs", [1, 3])
@pytest.mark.parametrize("actuator", names("actuator"))
def test_the_simulated_machine_is_a_link(actuator: str, num_runs: int, tmp_path: Path) -> None:
    connection = SimulatedMachines(
        actuator=option("actuator", actuator), noise=0.001, one_machine=True
    )
    machine = find_machine(connection.actuator)
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    check_link(connection.build(machine, num_runs, session), machine, num_runs)


@every("task")
def test_it_is_a_task(name: str) -> None:
    check_task(option("task", name), MACHINE)


@every("perception")
def test_it_is_a_finder(name: str) -> None:
    check_finder(option("perception", name))


@every("sim")
@pytest.mark.slow
def test_it_is_a_world(name: str) -> None:
    device = "cuda" if torch.cuda.is_available() and name != "native" else "cpu"
    check_world(option("sim", name), MACHINE, make_nominal_scenes(NUM_ENVS), device)
