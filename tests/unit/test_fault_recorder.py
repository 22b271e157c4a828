"""A world that is driven to divergence is recorded, played through MuJoCo C, and its cause is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import training as runs
from composed import option

from brokk_rl.errors import ConfigError, SimulationError
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.modes.train import FaultLog
from brokk_rl.rl.vec_env import ControlLoop
from brokk_rl.sim.fault_recorder import Fault, FaultRecorder, load_fault
from brokk_rl.sim.fault_replay import describe_cause, play_fault
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.sim.simulator import NativeSimulator, WarpSimulator
from tasks.reward import RewardTerm
from tasks.step_state import StepState

NATIVE = NativeSimulator(num_worlds=4, substeps=5, num_threads=1)
FUSED = WarpSimulator(
    num_worlds=4, substeps=5, num_contacts=16, num_constraints=40, iterations=12,
    linesearch_iterations=8, tolerance=1e-6, fused=True, parity_worlds=0,
)  # fmt: skip
WILD = 2
"""The world that diverges."""


def drive(machine: Machine, sim: NativeSimulator | WarpSimulator, steps: int = 30) -> list[Fault]:
    """Returns the faults of worlds of which one is thrown at 1,000 rad/s in the last step."""
    world = sim.build(machine, "cpu")
    recorder = FaultRecorder(world, machine, num_steps=10)
    everywhere = torch.ones(4, dtype=torch.bool)
    home = torch.tensor(machine.home, dtype=torch.float32).repeat(4, 1)
    scene = make_nominal_scenes(4)
    world.reset(everywhere, home, scene)
    recorder.begin(everywhere, scene)
    generator = torch.Generator().manual_seed(0)
    for step in range(steps + 5):
        increment = 0.01 * torch.randn(4, machine.num_joints, generator=generator)
        if step == steps - 1:
            world.trace["speed"][WILD, 2] = 1000.0
        recorder.record(increment)
        world.step(increment)
        recorder.close(torch.zeros(4))
        # the host comes later: the world has begun anew by then
        world.reset(world.faults.clone(), home, scene)
    assert recorder.is_held.tolist() == [index == WILD for index in range(4)]
    found = recorder.fetch(8)
    assert not recorder.is_held.any() and recorder.fetch(8) == []
    return found


@pytest.mark.parametrize("sim", [NATIVE, FUSED], ids=["native", "warp"])
def test_an_injected_divergence_is_recorded_and_played(
    machine: Machine, sim: NativeSimulator | WarpSimulator, tmp_path: Path
) -> None:
    (fault,) = drive(machine, sim)
    assert fault.world == WILD and fault.increment.shape == (10, machine.num_joints)
    # the increments are the ten that the generator drew before the fault
    generator = torch.Generator().manual_seed(0)
    drawn = [0.01 * torch.randn(4, machine.num_joints, generator=generator) for _ in range(30)]
    expected = torch.stack(drawn)[20:, WILD].numpy()
    np.testing.assert_allclose(fault.increment, expected, rtol=1e-6)
    assert fault.states["speed"][-2, 2] == 1000.0
    fault.save(tmp_path / "fault.npz")
    fault = load_fault(tmp_path / "fault.npz")
    played = play_fault(fault, machine)
    # the speed was thrown in between two steps, which no player can know: the nine before agree
    tolerance = 0.0 if sim is NATIVE else 1e-4
    assert max(step.difference for step in played[:8]) <= tolerance
    cause = describe_cause(fault, machine)
    assert f"speed of {machine.joint_names[2]} was 1,000 before the step" in cause


def test_a_nan_of_the_actuator_model_is_named_with_its_joint(machine: Machine) -> None:
    world = NATIVE.build(machine, "cpu")
    recorder = FaultRecorder(world, machine, num_steps=5)
    for step in range(3):
        increment = torch.zeros(4, machine.num_joints)
        if step == 2:
            increment[WILD, 3] = float("nan")
        recorder.record(increment)
        world.step(increment)
        recorder.close(torch.zeros(4))
    (fault,) = recorder.fetch(8)
    assert len(fault.increment) == 3
    assert describe_cause(fault, machine).startswith(
        f"the actuator model's increment of {machine.joint_names[3]} was not finite, 1 control"
    )


def test_a_full_buffer_is_named(machine: Machine) -> None:
    world = replace(FUSED, num_constraints=1).build(machine, "cpu")
    recorder = FaultRecorder(world, machine, num_steps=5)
    low = torch.tensor(machine.lower, dtype=torch.float32).repeat(4, 1) - 0.05  # every limit
    world.reset(torch.ones(4, dtype=torch.bool), low, make_nominal_scenes(4))
    increment = torch.zeros_like(low)
    recorder.record(increment)
    world.step(increment)
    recorder.close(torch.zeros(4))
    fault, *_ = recorder.fetch(8)
    assert "sim.num_constraints" in describe_cause(fault, machine)


def test_the_strongest_contact_of_the_last_step_is_named(machine: Machine) -> None:
    world = NATIVE.build(machine, "cpu")
    recorder = FaultRecorder(world, machine, num_steps=5)
    everywhere = torch.ones(4, dtype=torch.bool)
    home = torch.tensor(machine.home, dtype=torch.float32).repeat(4, 1)
    scene = make_nominal_scenes(4)
    tip_m = Kinematics(machine).pose(home).tip_in_base_m
    scene[:, :3] = tip_m + torch.tensor([0.2, 0.1, 0.1])  # the chisel 10 cm inside the block
    world.reset(everywhere, home, scene)
    recorder.begin(everywhere, scene)
    increment = torch.zeros(4, machine.num_joints)
    recorder.record(increment)
    world.step(increment)
    recorder.close(torch.where(torch.arange(4) == WILD, float("nan"), 0.0))
    (fault,) = recorder.fetch(8)
    cause = describe_cause(fault, machine)
    assert cause.startswith("the reward is not finite; MuJoCo C plays the last step soundly")
    assert "contact of" in cause and "chisel" in cause


def make_loop(machine: Machine, task: Any = None) -> ControlLoop:
    torch.manual_seed(0)
    loop = runs.plant(machine, task, NATIVE).build(runs.CPU, 4, 64, 5)
    loop.record_faults(20)
    return loop


def test_a_training_writes_the_fault_and_the_command(
    machine: Machine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loop = make_loop(machine)
    faults = FaultLog(loop, tmp_path / "faults", "rank0_")
    for _ in range(6):
        loop.step(torch.zeros(4, 5))
    assert faults.read_statistics()["fault_rate"] == 0.0 and not (tmp_path / "faults").exists()
    scene = loop.task.state["start.scene"][WILD].clone()
    loop.world.trace["speed"][WILD, 0] = float("nan")
    loop.step(torch.zeros(4, 5))
    assert faults.read_statistics()["fault_rate"] == 0.25
    path = tmp_path / "faults/rank0_0.npz"
    assert f"brokk mode=replay machine={machine.name} replay.fault={path}" in caplog.text
    fault = load_fault(path)
    assert len(fault.increment) == 7 and np.allclose(fault.scene, scene)
    assert fault.cause.startswith("the speed of q1 was not finite")
    assert faults.read_statistics()["fault_rate"] == 0.0  # released


def divide_by_zero(state: StepState) -> torch.Tensor:
    return (state.u - state.u_before).abs().sum(1) / 0.0


def test_a_reward_term_that_is_not_finite_stops_the_run_by_name(
    machine: Machine, tmp_path: Path
) -> None:
    task = option("task", "borehole_insertion")
    broken = RewardTerm(function=f"{__name__}:divide_by_zero", weight=-0.01)
    loop = make_loop(machine, replace(task, reward=task.reward | {"command_change": broken}))
    loop.step(torch.zeros(4, 5))  # 0 / 0
    with pytest.raises(SimulationError, match="reward term command_change was not finite"):
        FaultLog(loop, tmp_path / "faults", "rank0_").read_statistics()


def test_another_machine_and_another_file_are_refused(machine: Machine, tmp_path: Path) -> None:
    (fault,) = drive(machine, NATIVE, steps=12)
    with pytest.raises(ConfigError, match="recorded with machine=other"):
        play_fault(replace(fault, machine="other"), machine)
    (tmp_path / "x.npz").write_text("no archive")
    with pytest.raises(ConfigError, match="no recorded fault"):
        load_fault(tmp_path / "x.npz")


def test_a_simulator_that_shows_no_states_is_not_recorded(
    machine: Machine, caplog: pytest.LogCaptureFixture
) -> None:
    loop = runs.plant(machine).build(runs.CPU, 4, 64, 0)
    with caplog.at_level("INFO"):
        loop.record_faults(5)
    assert loop.recorder is None and "faults are not recorded" in caplog.text


def test_on_a_gpu_the_recorder_has_to_be_asked_for() -> None:
    training = option("rl", "ppo")
    assert (training.count_fault_steps("cpu"), training.count_fault_steps("cuda")) == (100, 0)
    assert replace(training, fault_steps=7).count_fault_steps("cuda") == 7
