"""Bases of actuator models: numbers and state of joints, and one body for a step and a planned run.

Axes: `N` environments, `J` joints, `K` steps of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch

from actuators.models.machine_tensors import MachineTensors
from actuators.models.parameters import (
    check_dead_time,
    check_interface,
    read_parameters,
    split_run_commands,
)
from brokk_rl.history import History
from brokk_rl.machine import Machine

JointMemory = dict[str, "torch.Tensor"]
"""State of the joints by name, `(N, J)` each."""


class MemorylessModel:
    """Base of models that know nothing beyond the history."""

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Do nothing."""


class ParametricModel:
    """Base of models with numbers and a state by joint.

    Args:
        config: The spec that holds the numbers; see `read_parameters`.
        machine: The machine.
        num_envs: Number of environments, `N`.
        device: Where the tensors live.
        absent: Values `(J,)` of fields that are `None`.

    Raises:
        ConfigError: a joint is missing or unknown, the history does not hold the dead time, or the machine is
            commanded by another quantity.

    Attributes:
        STATES: Names of the state of each joint, `(N, J)`.
        DELAY: Name of the number that is the dead time.
        INTERFACE: Quantity that its commands set, and what it is, for messages; see `check_interface`.
        parameters: Numbers by name, `(N, J)`. Write in place or replace an entry to simulate `N`
            candidates side by side.
        plant: Constants of the machine.
    """

    STATES: ClassVar[tuple[str, ...]]
    DELAY: ClassVar[str] = "dead_time_s"
    INTERFACE: ClassVar[tuple[str, str]]

    def __init__(
        self,
        config: Any,
        machine: Machine,
        num_envs: int,
        device: torch.device,
        absent: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> None:
        check_interface(machine, *self.INTERFACE)
        self.parameters: dict[str, torch.Tensor] = {}
        nominal = read_parameters(config, machine, absent)
        check_dead_time(float(nominal[self.DELAY].max()), machine, f"actuator.{self.DELAY}")
        for name, value in nominal.items():
            row = torch.as_tensor(value, dtype=torch.float32, device=device)
            self.parameters[name] = row.expand(num_envs, -1).clone()
        self.plant = MachineTensors(machine, device)
        shape = (num_envs, machine.num_joints)
        self._state = {name: torch.zeros(shape, device=device) for name in self.STATES}
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """State of the joints, and `fresh` `(N,)` where it is not begun yet."""
        return {**self._state, "fresh": self._fresh}

    @property
    def delay_s(self) -> torch.Tensor:
        """Dead time, `(N, J)`."""
        return self.parameters[self.DELAY]

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history."""
        for name in self.STATES:
            self._state[name].masked_fill_(mask[:, None], 0.0)
        self._fresh.logical_or_(mask)

    def recall(self, begun: JointMemory) -> JointMemory:
        """Return the state of the joints, `begun` in environments that start from their history."""
        fresh = self._fresh.clone()[:, None]
        found = {}
        for name, value in begun.items():
            found[name] = torch.where(fresh, value, self._state[name])
        return found

    def keep(self, memory: JointMemory) -> None:
        """Store the state of the joints after a step."""
        for name, value in memory.items():
            self._state[name].copy_(value)
        self._fresh.fill_(False)


@dataclass(frozen=True, eq=False)
class CommandParts:
    """Commands, or what they ask for, in the two parts of each step of a run.

    Attributes:
        earlier: In the first part of the period, `(K, N, J)`.
        later: In the rest, `(K, N, J)`.
        part: Length of the first part, in periods, `(N, J)`.
    """

    earlier: torch.Tensor
    later: torch.Tensor
    part: torch.Tensor


class PlannableModel(ParametricModel):
    """Base of models whose step is a planned run of one command.

    A model overrides `solve`, `begin` and `advance`.
    """

    def ask(self, commands: torch.Tensor) -> torch.Tensor:
        """Return what commands `(K, N, J)` ask for; the commands themselves unless a model says otherwise."""
        return commands

    def solve(self, drive: CommandParts) -> Any:
        """Return all that steps of a run have in common."""
        raise NotImplementedError

    def begin(self, drive: CommandParts, q: torch.Tensor, before: torch.Tensor) -> JointMemory:
        """Return the state of joints at `q`, one period after `before`."""
        raise NotImplementedError

    def advance(
        self, k: int, q: torch.Tensor, drive: CommandParts, solution: Any, memory: JointMemory
    ) -> tuple[torch.Tensor, JointMemory]:
        """Return positions and state after step `k` of a run from positions `q`."""
        raise NotImplementedError

    def drive(self, u: torch.Tensor, first: int) -> CommandParts:
        """Return what the commands of a run `(T, N, J)` ask for, whatever the positions are."""
        delay_periods = self.delay_s / self.plant.period_s
        earlier, later, part = split_run_commands(u, delay_periods, first)
        return CommandParts(self.ask(earlier), self.ask(later), part)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        q = history.q[:, -1]
        drive = self.drive(history.u.transpose(0, 1), history.u.shape[1])
        memory = self.recall(self.begin(drive, q, history.q[:, -2]))
        moved, memory = self.advance(0, q, drive, self.solve(drive), memory)
        self.keep(memory)
        return moved

    def plan_run(self, u: torch.Tensor, first: int, q: torch.Tensor | None = None) -> JointRun:
        """Return the run that begins after a `reset` of all environments; the state stays as it was.

        What depends on commands alone is computed at once. The positions are those of `step`. Another
        model may have this method, and `delay_s`, too; one that returns `None` is stepped.

        Args:
            u: Commands of the run, `(T, N, J)`; position `k` follows command `k - 1`.
            first: Number of the first position that is asked for: the length of the history.
            q: Positions up to there, `(first, N, J)` or more, for effects that begin where a joint is;
                `None`: a model with such an effect has to be stepped.
        """
        return JointRun(self, self.drive(u, first), first)


class JointRun:
    """A run of a `PlannableModel`; see `actuators.contracts.PlannedRun`."""

    def __init__(self, model: PlannableModel, drive: CommandParts, first: int) -> None:
        self._model, self._drive, self._first = model, drive, first
        self._solution = model.solve(drive)
        self._memory: JointMemory | None = None

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """Return positions `k`, `(N, J)`."""
        if self._memory is None:
            self._memory = self._model.begin(self._drive, q[k - 1], q[k - 2])
        moved, self._memory = self._model.advance(
            k - self._first, q[k - 1], self._drive, self._solution, self._memory
        )
        return moved
