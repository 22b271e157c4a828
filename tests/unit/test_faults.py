"""A world that is driven to divergence is told apart, and why it diverged is named."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
import training as runs
from composed import MACHINE, option

from brokk_rl.rl.loop import ControlLoop
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.sim.simulator import NativeSimulator, WarpSimulator
from tasks.term_task import RewardTerm
from tasks.terms import StepState

NATIVE = NativeSimulator(num_worlds=4, substeps=5, num_threads=1)
FUSED: WarpSimulator = replace(option("sim", "warp"), num_worlds=4, parity_worlds=0)
WILD = 2
"""The world that diverges."""


@pytest.mark.parametrize("sim", [NATIVE, FUSED], ids=["native", "warp"])
def test_why_a_world_diverged_is_named_after_it_has_begun_anew(
    sim: NativeSimulator | WarpSimulator,
) -> None:
    world = sim.build(MACHINE, "cpu")
    home = torch.tensor(MACHINE.home, dtype=torch.float32).repeat(4, 1)
    increment = torch.zeros(4, MACHINE.num_joints)
    world.step(increment)
    increment[WILD, 3] = float("nan")
    world.step(increment)
    assert world.faults.tolist() == [index == WILD for index in range(4)]
    world.reset(world.faults.clone(), home, make_nominal_scenes(4))
    assert "the motion of q4 was not finite" in world.explain_faults()
    world.step(torch.zeros_like(increment))
    assert not world.faults.any()
    assert "not finite" not in world.explain_faults()


def test_a_full_buffer_is_named() -> None:
    world = replace(FUSED, num_constraints=1).build(MACHINE, "cpu")
    low = torch.tensor(MACHINE.lower, dtype=torch.float32).repeat(4, 1) - 0.05  # every limit
    world.reset(torch.ones(4, dtype=torch.bool), low, make_nominal_scenes(4))
    world.step(torch.zeros_like(low))
    assert "sim.num_constraints" in world.explain_faults()


def make_loop(task: Any = None) -> ControlLoop:
    torch.manual_seed(0)
    return runs.plant(task, NATIVE).build(runs.CPU, 4, 64, 5)


def test_a_training_counts_and_names_faults(caplog: pytest.LogCaptureFixture) -> None:
    loop = make_loop()
    loop.step(torch.zeros(4, 5))
    assert loop.statistics()["fault_rate"] == 0.0
    loop.world._drive.reference[WILD, 0] = float("nan")  # type: ignore[attr-defined]
    loop.step(torch.zeros(4, 5))
    assert loop.statistics()["fault_rate"] == 0.25
    assert "the motion of q1 was not finite" in caplog.text


def divide_by_zero(state: StepState) -> torch.Tensor:
    return (state.u - state.u_before).abs().sum(1) / 0.0


def test_a_reward_term_that_is_not_finite_is_told_from_the_others() -> None:
    task = option("task", "borehole_insertion")
    broken = RewardTerm(function=f"{__name__}:divide_by_zero", weight=-0.01)
    loop = make_loop(replace(task, reward=task.reward | {"command_change": broken}))
    loop.step(torch.zeros(4, 5))  # 0 / 0
    found = loop.statistics()
    odd = [name for name, value in found.items() if not math.isfinite(value)]
    assert odd == ["return", "reward/command_change"]
    assert math.isfinite(loop.statistics()["return"]), "they count once"
