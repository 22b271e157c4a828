"""A task written from `brokk_rl.contracts.task` alone: it trains, and export names its limits."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import training as runs
from composed import MACHINE, option
from kinematic import Kinematic

from brokk_rl.checks import check_task
from brokk_rl.contracts.task import OPTIONAL, TaskProcess, Transition
from brokk_rl.errors import ConfigError
from brokk_rl.extensions import load_part
from brokk_rl.machine import Machine
from brokk_rl.modes.export import Export
from brokk_rl.modes.train import Train, describe_gain
from brokk_rl.rl.logger import NoTracking
from brokk_rl.rl.policy import ClassicalPolicy, TrainedPolicy
from brokk_rl.session import Session
from brokk_rl.sim.scene import make_nominal_scenes

CPU = torch.device("cpu")


class HoldStillProcess(TaskProcess):
    """Keep the arm where it is; only the required part of the contract."""

    reasons = ("fault", "time_limit")
    max_episode_steps = 10

    def __init__(self, machine: Machine, num_envs: int, device: torch.device) -> None:
        self._machine = machine
        self.num_actions = machine.num_joints
        self.state = {"steps": torch.zeros(num_envs, device=device)}
        self.state["q"] = torch.zeros(num_envs, machine.num_joints, device=device)
        self.episode = {"success_strict": torch.zeros(num_envs, device=device)}
        self.episode |= {"moved": torch.zeros(num_envs, device=device)}
        self._policy = torch.zeros(num_envs, machine.num_joints, device=device)

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(seed)
        share = 0.4 + 0.2 * torch.rand(count, self.num_actions, generator=generator)
        lower = torch.as_tensor(self._machine.lower, dtype=torch.float32)
        upper = torch.as_tensor(self._machine.upper, dtype=torch.float32)
        return {"q": lower + share * (upper - lower), "scene": make_nominal_scenes(count)}

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        self.state["steps"].masked_fill_(mask, 0.0)
        self.state["q"].copy_(torch.where(mask[:, None], start["q"], self.state["q"]))
        for value in self.episode.values():
            value.masked_fill_(mask, 0.0)

    def command(self, action: torch.Tensor) -> torch.Tensor:
        return action.clamp(-1.0, 1.0)

    def step(self, history: Any, world: Any) -> Transition:
        self.state["steps"] += 1
        moved = (history.q[:, -1] - self.state["q"]).abs().sum(1)
        timed_out = (self.state["steps"] >= self.max_episode_steps) & ~world.faults
        self.episode["moved"].copy_(moved)
        self.episode["success_strict"].copy_((timed_out & (moved < 0.1)).float())
        reason = torch.where(world.faults, 0.0, torch.where(timed_out, 1.0, -1.0))
        ends = {"terminated": world.faults.clone(), "timed_out": timed_out, "reason": reason}
        return Transition(reward=-moved, **ends)

    def observe(self, history: Any, shift_m: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        self._policy.copy_(history.q[:, -1] - self.state["q"])
        return {"policy": self._policy}


class HoldStill:
    """The spec of that task."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> HoldStillProcess:
        return HoldStillProcess(machine, num_envs, device)


def test_the_required_contract_is_enough_for_the_checker() -> None:
    check_task(HoldStill(), MACHINE)
    process = HoldStill().build(MACHINE, 1, CPU)
    assert not process.offers


@pytest.mark.parametrize("name", ["borehole_insertion", "goal_pose"])
def test_the_shipped_tasks_offer_all_that_is_optional(name: str) -> None:
    assert option("task", name).build(MACHINE, 1, CPU).offers == OPTIONAL.keys()


def test_a_task_without_optional_contracts_trains_and_is_not_exported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    training = runs.small(max_env_steps=16 * runs.STEPS * 2)
    training.runner["obs_groups"] = {"actor": ["policy"], "critic": ["policy"]}
    parts: dict[str, Any] = {
        "session": Session(out=str(tmp_path), seed=0, device="cpu"),
        "machine": MACHINE,
        "sim": Kinematic(),
        "task": HoldStill(),
        "actuator": option("actuator", "lag"),
        "follower": option("follower", "none"),
        "rl": training,
    }
    evaluation = replace(load_part("evaluation"), episodes=4, num_recorded=1, video=False)
    parts |= {"effect": {}, "event": {}, "tracking": NoTracking(), "evaluation": evaluation}
    train = Train(**parts, policy=None)
    with caplog.at_level(logging.INFO):
        assert train.run() is not None
    assert "HoldStill) has no classical controller" in caplog.text
    assert "HoldStill) cannot be deployed, so there is no policy.onnx" in caplog.text
    assert not (tmp_path / "policy.onnx").exists() and (tmp_path / "learning_curves.png").exists()
    assert json.loads((tmp_path / "policy.json").read_text())["observation"] is None
    report = json.loads((tmp_path / "evaluation.json").read_text())
    assert report["policies"].keys() == {"trained"} and "moved" in report
    assert "success_paper" not in report

    policy = TrainedPolicy(path=str(tmp_path), task=None)
    with pytest.raises(ConfigError, match="has no policy that can leave the trainer"):
        Export(session=parts["session"], machine=MACHINE, task=HoldStill(), policy=policy).run()


def test_the_classical_policy_of_a_task_without_one_is_refused() -> None:
    loop = runs.plant(HoldStill()).build(CPU, 4, 8, 0)
    with pytest.raises(ConfigError, match=r"HoldStillProcess. has no classical controller"):
        ClassicalPolicy(task=None).build(loop, 0)


def test_a_gain_is_said_only_where_the_intervals_lie_apart() -> None:
    low, high = {"mean": 0.95, "ci95": (0.93, 0.97)}, {"mean": 0.99, "ci95": (0.98, 1.0)}
    near = {"mean": 0.98, "ci95": (0.96, 0.99)}
    assert describe_gain(high, low) == "better than the controller by 0.040"
    assert {describe_gain(near, low), describe_gain(low, high)} == {describe_gain(low, low)}
