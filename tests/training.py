"""A training run small enough for a test: few environments without physics, a small network."""

from __future__ import annotations

import copy
import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from composed import MACHINE, option
from kinematic import Kinematic

from brokk_rl.rl.loop import ControlLoop, SimulatedPlant
from brokk_rl.rl.runner import TrainingRunner
from brokk_rl.rl.settings import TrainingBudget, TrainingConfig

CPU = torch.device("cpu")
STEPS = 4
TIMES = ("seconds", "rate/env_steps_per_s", "rate/collect_s", "rate/learn_s")
"""Columns of `progress.csv` that differ from run to run."""
SILENT: dict[str, Any] = dict.fromkeys(
    ("target_sample_m", "target_bias_m", "target_relative", "q_scale", "u_scale"), 0.0
)
SILENT["filter"] = "none"
"""Errors of an observation that has none."""


def plant(task: Any = None, sim: Any = None, follower: Any = None) -> SimulatedPlant:
    """Returns what a small control loop is made of."""
    return SimulatedPlant(
        machine=MACHINE,
        sim=sim or Kinematic(),
        task=task or option("task", "borehole_insertion"),
        actuator=option("actuator", "lag"),
        effect={},
        event={},
        follower=follower or option("follower", "none"),
    )


def small(
    max_env_steps: int | None = None, max_seconds: float | None = None, **changes: Any
) -> TrainingConfig:
    """Returns the shipped training configuration, made small."""
    shipped = option("rl", "ppo")
    runner = copy.deepcopy(shipped.runner)
    runner["num_steps_per_env"] = STEPS
    runner["algorithm"] |= {"num_learning_epochs": 2, "num_mini_batches": 2}
    for network in ("actor", "critic"):
        runner[network]["hidden_dims"] = [16]
    budget = TrainingBudget(max_env_steps=max_env_steps, max_seconds=max_seconds)
    size: dict[str, Any] = {"num_envs": 16, "num_starts": 64, "save_interval": 1}
    return replace(shipped, **size | {"runner": runner, "budget": budget} | changes)


def make(
    folder: Path,
    training: TrainingConfig,
    loop: ControlLoop | None = None,
    device: torch.device = CPU,
) -> TrainingRunner:
    """Returns a runner on a control loop of its own; every run of a test starts from the same seed."""
    folder.mkdir(exist_ok=True)
    torch.manual_seed(0)
    loop = loop or plant().build(device, training.num_envs, training.num_starts, 0)
    return TrainingRunner(loop, training, folder)


def train(folder: Path, training: TrainingConfig, resume: Path | None = None) -> TrainingRunner:
    """Trains until the budget is spent, from the beginning or from a checkpoint."""
    runner = make(folder, training)
    if resume:
        # Whatever happened in this process before, the checkpoint knows better.
        torch.manual_seed(999)
        runner.load(str(resume))
    runner.run()
    return runner


def weights(runner: TrainingRunner) -> dict[str, torch.Tensor]:
    """Returns all learned numbers of actor and critic."""
    return {
        f"{part}.{name}": value
        for part in ("actor", "critic")
        for name, value in getattr(runner.alg, part).state_dict().items()
    }


def take_state(loop: ControlLoop) -> dict[str, torch.Tensor]:
    """Returns all tensors of a loop by name, with those of its world."""
    state = loop.state_dict()
    return state["tensors"] | {f"world.{name}": value for name, value in state["world"].items()}


def progress(folder: Path) -> list[dict[str, str]]:
    """Returns the rows of `progress.csv` without the columns that tell the time."""
    with (folder / "progress.csv").open(newline="") as file:
        return [
            {name: value for name, value in row.items() if name not in TIMES}
            for row in csv.DictReader(file)
        ]
