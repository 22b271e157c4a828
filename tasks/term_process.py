"""Episodes of a task whose particulars are all terms, and its policy as it is deployed."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch

from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.sim import scene
from tasks.process import EpisodeProcess
from tasks.term_task import BLOCK_AWAY_M, JointAction, ObservedTerm, TermTask
from tasks.terms import StepState


class TermProcess(EpisodeProcess):
    """Episodes of a task whose particulars are all terms."""

    def __init__(
        self, task: TermTask, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        self.task = task
        super().__init__(task, machine, num_envs, device)
        self._is_good = task.success.resolve()
        self._after_steps = round(task.success.after_s / machine.period_s)
        self._needed_steps = task.success.share * (self.max_episode_steps - self._after_steps)

    def _list_drawn_shapes(self) -> dict[str, tuple[int, ...]]:
        return {name: (len(ranges.lowest),) for name, ranges in self.task.command.items()}

    def _list_groups(self) -> dict[str, dict[str, ObservedTerm | None]]:
        return {"policy": self.task.observation, "privileged": self.task.privileged}

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw arms and commands; see `TaskProcess.starts`."""
        task, machine = self.task, self._machine
        generator = torch.Generator().manual_seed(seed)

        def draw(low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
            return low + (high - low) * torch.rand(count, len(low), generator=generator)

        lower, upper, home = (
            torch.tensor(value, dtype=torch.float32)
            for value in (machine.lower, machine.upper, machine.home)
        )
        reach = task.start.spread * (upper - lower) / 2
        lowest, highest = lower + task.start.margin, upper - task.start.margin
        q = draw(home - reach, home + reach).maximum(lowest).minimum(highest)
        place = scene.make_nominal_scenes(count)
        place[:, scene.COLUMNS.index("hole_x_m")] = BLOCK_AWAY_M
        tip_m = Kinematics(machine, "cpu").pose(q).tip_in_base_m
        start = {"q": q, "scene": place, "tip_m": tip_m}
        for name, ranges in task.command.items():
            start[name] = draw(torch.tensor(ranges.lowest), torch.tensor(ranges.highest))
        return start

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Return masked commands; see `TaskProcess.command`."""
        return self._remember_command(self.task.action.command(action, self._exclusive))

    def _judge_success(self, seen: StepState, faults: torch.Tensor) -> None:
        state = self.state
        holds = self._is_good(seen) & ~faults
        state["held"] += holds & (state["age"] > self._after_steps)
        seen.success = state["held"] >= self._needed_steps
        seen.held_share = state["held"] / (state["age"] - self._after_steps).clamp(min=1.0)

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return the groups that have terms; see `TaskProcess.observe`.

        A wrong calibration (`shift_m`) moves nothing: a task made of terms has no seen target.
        """
        return self._observed.observe(self._make_state(history, self.state["contact_force_n"]))

    def describe(self) -> dict[str, Any]:
        """Return the contract of the `policy` group; see `TaskProcess.describe`."""
        description = self._observed.encoders["policy"].describe()
        for part in description["parts"]:
            term = self.task.observation[part["name"]]
            assert term is not None
            part |= {"function": term.function, "params": term.params}
        criterion = dataclasses.asdict(self.task.success)
        stop = {"success": {}, "criterion": criterion} | self._endings.describe()
        return description | {"masked": self.task.action.mask, "stop": stop}

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return the policy as one module; see `TaskProcess.deployable`."""
        return TermPolicy(network, self.task.action, self._exclusive)


class TermPolicy(torch.nn.Module):
    """The policy as it runs on the machine: `(B, O)` observations to `(B, J)` masked commands.

    Args:
        network: Takes a dictionary of observation groups, returns the action.
        action: Map from the action to commands.
        exclusive: Which joints are exclusive, `(J,)` bool.
    """

    def __init__(
        self, network: torch.nn.Module, action: JointAction, exclusive: torch.Tensor
    ) -> None:
        super().__init__()
        self.network = network
        self._action, self._exclusive = action, exclusive

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return valve commands, `(B, J)` in [-1, 1]."""
        return self._action.command(self.network({"policy": observation}), self._exclusive)
