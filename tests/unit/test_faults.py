"""A world that is driven to divergence is recorded, and what was wrong first is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import training as runs
from composed import option

from brokk_rl.errors import SimulationError
from brokk_rl.machine import Machine
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.sim.faults import Fault, FaultRecorder
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.sim.simulator import NativeSimulator, WarpSimulator
from tasks.term_task import RewardTerm
from tasks.terms import StepState

NATIVE = NativeSimulator(num_worlds=4, substeps=5, num_threads=1)
FUSED = WarpSimulator(
    num_worlds=4, substeps=5, num_contacts=16, num_constraints=40, iterations=12,
    linesearch_iterations=8, tolerance=1e-6, parity_worlds=0,
)  # fmt: skip
WILD = 2
"""The world that diverges."""


@pytest.mark.parametrize("sim", [NATIVE, FUSED], ids=["native", "warp"])
def test_the_last_steps_of_a_world_that_diverges_are_kept(
    machine: Machine, sim: NativeSimulator | WarpSimulator
) -> None:
    world = sim.build(machine, "cpu")
    recorder = FaultRecorder(world, machine, num_steps=10)
    everywhere = torch.ones(4, dtype=torch.bool)
    home = torch.tensor(machine.home, dtype=torch.float32).repeat(4, 1)
    world.reset(everywhere, home, make_nominal_scenes(4))
    recorder.begin(everywhere, make_nominal_scenes(4))
    generator = torch.Generator().manual_seed(0)
    drawn, seen = [], []
    for step in range(35):
        increment = 0.01 * torch.randn(4, machine.num_joints, generator=generator)
        if step == 29:
            world.trace["speed"][WILD, 2] = 1000.0
        world.step(increment)
        drawn.append(increment[WILD])
        seen.append(world.trace["q"][WILD].clone())
        recorder.record(increment, torch.zeros(4))
        # the host comes later: the world has begun anew by then
        world.reset(world.faults.clone(), home, make_nominal_scenes(4))
    assert recorder.is_held.tolist() == [index == WILD for index in range(4)]
    (fault,) = recorder.fetch(8)
    np.testing.assert_array_equal(fault.states["increment"], torch.stack(drawn[20:30]).numpy())
    np.testing.assert_array_equal(fault.states["q"], torch.stack(seen[20:30]).numpy())
    assert not recorder.is_held.any() and recorder.fetch(8) == []


def record_step(world: Any, machine: Machine, increment: torch.Tensor) -> Fault:
    recorder = FaultRecorder(world, machine, num_steps=5)
    world.step(increment)
    recorder.record(increment, torch.zeros(4))
    fault, *_ = recorder.fetch(8)
    assert len(fault.states["q"]) == 1
    return fault


def test_a_nan_of_the_actuator_model_is_named_with_its_joint(machine: Machine) -> None:
    increment = torch.zeros(4, machine.num_joints)
    increment[WILD, 3] = float("nan")
    fault = record_step(NATIVE.build(machine, "cpu"), machine, increment)
    assert fault.cause == "the actuator model's increment of q4 was not finite"


def test_a_full_buffer_is_named(machine: Machine) -> None:
    world = replace(FUSED, num_constraints=1).build(machine, "cpu")
    low = torch.tensor(machine.lower, dtype=torch.float32).repeat(4, 1) - 0.05  # every limit
    world.reset(torch.ones(4, dtype=torch.bool), low, make_nominal_scenes(4))
    assert "sim.num_constraints" in record_step(world, machine, torch.zeros_like(low)).cause


def make_loop(machine: Machine, folder: Path, task: Any = None) -> ControlLoop:
    torch.manual_seed(0)
    loop = runs.plant(machine, task, NATIVE).build(runs.CPU, 4, 64, 5)
    loop.record_faults(20, folder)
    return loop


def test_a_training_writes_the_states(
    machine: Machine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loop = make_loop(machine, tmp_path / "faults")
    for _ in range(6):
        loop.step(torch.zeros(4, 5))
    assert loop.statistics()["fault_rate"] == 0.0 and not (tmp_path / "faults").exists()
    scene = loop.task.state["start.scene"][WILD].clone()
    loop.world.trace["reference"][WILD, 0] = float("nan")
    loop.step(torch.zeros(4, 5))
    assert loop.statistics()["fault_rate"] == 0.25
    path = tmp_path / "faults/rank0_0.npz"
    assert f"the drive's reference of q1 was not finite; its last states: {path}" in caplog.text
    with np.load(path, allow_pickle=False) as dump:
        assert dump["q"].shape == dump["increment"].shape == (7, 5)
        assert np.allclose(dump["scene"], scene)
    assert loop.statistics()["fault_rate"] == 0.0  # released


def divide_by_zero(state: StepState) -> torch.Tensor:
    return (state.u - state.u_before).abs().sum(1) / 0.0


def test_a_reward_term_that_is_not_finite_stops_the_run_by_name(
    machine: Machine, tmp_path: Path
) -> None:
    task = option("task", "borehole_insertion")
    broken = RewardTerm(function=f"{__name__}:divide_by_zero", weight=-0.01)
    loop = make_loop(
        machine, tmp_path, replace(task, reward=task.reward | {"command_change": broken})
    )
    loop.step(torch.zeros(4, 5))  # 0 / 0
    with pytest.raises(SimulationError, match="reward term command_change was not finite"):
        loop.statistics()


def test_a_simulator_that_shows_no_states_is_not_recorded(
    machine: Machine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loop = runs.plant(machine).build(runs.CPU, 4, 64, 0)
    with caplog.at_level("INFO"):
        loop.record_faults(5, tmp_path)
    assert loop.recorder is None and "faults are not recorded" in caplog.text


def test_on_a_gpu_the_recorder_has_to_be_asked_for() -> None:
    training = option("rl", "ppo")
    assert (training.count_fault_steps("cpu"), training.count_fault_steps("cuda")) == (100, 0)
    assert replace(training, fault_steps=7).count_fault_steps("cuda") == 7
