"""Inputs of an effect in one control period: its numbers and memory, the history, the machine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from actuators.effects.ranges import CHANCE
from actuators.models.machine_tensors import MachineTensors
from actuators.models.parameters import draw_uniform
from brokk_rl.history import History

Memory = dict[str, "torch.Tensor"]


@dataclass(frozen=True)
class StepInputs:
    """Everything that an effect may use in one control period.

    Attributes:
        value: Parameters by name, `(N, J)` or `(N, 1)`.
        memory: The memory that the effect returned one period ago.
        history: Positions and commands; the newest command has just come into force.
        plant: Constants of the machine.
        moved: Increment of the inner model, `(N, J)`; speed side only.
        counter: Counter of random draws, `(N,)`; stochastic effects only.
    """

    value: dict[str, torch.Tensor]
    memory: Memory
    history: History
    plant: MachineTensors
    moved: torch.Tensor
    counter: torch.Tensor | None

    @property
    def chance(self) -> torch.Tensor:
        """A uniform number in [0, 1) per environment, `(N, 1)`; all joints share one frame."""
        assert self.counter is not None, "only a stochastic effect has chances"
        return draw_uniform(self.counter, CHANCE, 1)


@dataclass(frozen=True)
class StepMemory:
    """Memory of effects between steps: tensors in place, begun anew where an environment is fresh.

    Attributes:
        kept: Memory by name of effect and value.
        fresh: Environments that begin, `(N,)`.
    """

    kept: Memory
    fresh: torch.Tensor

    def recall(self, name: str, effect: Any, now: StepInputs) -> StepInputs:
        """Return the inputs of an effect with its memory."""
        memory = {}
        for key, begun in effect.begin(now).items():
            fresh = self.fresh.reshape(-1, *[1] * (begun.dim() - 1))
            memory[key] = torch.where(fresh, begun, self.kept[join_name(name, key)])
        return replace(now, memory=memory)

    def keep(self, name: str, memory: Memory) -> None:
        """Store the memory of an effect."""
        for key, value in memory.items():
            self.kept[join_name(name, key)].copy_(value)


class RunMemory:
    """Memory of effects within a planned run, which all environments begin together."""

    def __init__(self) -> None:
        self._kept: dict[str, Memory] = {}

    def recall(self, name: str, effect: Any, now: StepInputs) -> StepInputs:
        """Return the inputs of an effect with its memory."""
        memory = self._kept[name] if name in self._kept else effect.begin(now)
        return replace(now, memory=memory)

    def keep(self, name: str, memory: Memory) -> None:
        """Store the memory of an effect."""
        self._kept[name] = memory


def join_name(name: str, key: str) -> str:
    """Return the name of a number or memory within a chain of effects."""
    return f"{name}.{key}" if name else key
