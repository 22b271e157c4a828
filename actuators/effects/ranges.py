"""The numbers of an effect: a value or a range, for all joints or joint by joint, as tensors over environments."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from actuators import draw
from actuators.parameters import per_joint
from brokk_rl.errors import ConfigError, choices
from brokk_rl.machine import Machine

Value = float | tuple[float, float] | dict[str, float | tuple[float, float]]
"""A number, a range `[low, high]` drawn per environment and joint at each reset, or either by joint name (`other` for the rest)."""
Joints = Literal["all"] | tuple[str, ...]
"""Joints that an effect acts on."""

CHANCE = 128
"""First column of the draws that are not for parameters."""


@dataclass(frozen=True)
class Number:
    """What is known about one number of an effect.

    Attributes:
        unit: SI unit, `1` for none; `rad` and `rad/s` read m and m/s for a sliding joint.
        none: Value at which the effect changes nothing. `None` for a number that only shapes the effect (a time constant), which is
            off when the others are.
        typical: Size on a machine that has the effect.
        bounds: Smallest and largest value that make sense.
        per_joint: Whether each joint has its own; otherwise one number an environment, `(N, 1)`.
    """

    unit: str
    none: float | None
    typical: float
    bounds: tuple[float, float]
    per_joint: bool = True


class Ranges:
    """Parameters of an effect for all environments.

    Attributes:
        value: `(N, J)` or `(N, 1)` by name. An entry may be written in place or replaced, by one that wants gradients for example;
            what was replaced is not drawn again.
        state: Counter and drawn values; empty where nothing is random.

    Args:
        fields: The effect's numbers as configured.
        numbers: What is known about them.
        joints: Joints that the effect acts on; elsewhere each number is at its `none`.
        machine: The machine.
        num_envs: Number of environments, `N`.
        device: Where the tensors live.
        stochastic: Whether the effect draws in every step.
        salt: Keeps the draws of several effects apart.
        where: Config node named in messages.

    Raises:
        ConfigError: a number is out of bounds, a range upside down, or a joint unknown.
    """

    def __init__(
        self,
        fields: Mapping[str, Value],
        numbers: Mapping[str, Number],
        joints: Joints,
        machine: Machine,
        num_envs: int,
        device: torch.device,
        stochastic: bool,
        salt: int,
        where: str,
    ) -> None:
        chosen = _chosen(joints, machine, f"{where}.joints")
        self.value: dict[str, torch.Tensor] = {}
        self._drawn: dict[str, tuple[int, torch.Tensor, torch.Tensor, torch.Tensor]] = {}
        for column, (name, number) in enumerate(numbers.items()):
            low, high = (
                torch.as_tensor(side, dtype=torch.float32, device=device)
                for side in _sides(fields[name], number, chosen, machine, f"{where}.{name}")
            )
            self.value[name] = low.expand(num_envs, -1).clone()
            if bool((low < high).any()):
                self._drawn[name] = (column, self.value[name], low, high)
        self._draw = draw.counter(num_envs, salt, device) if stochastic or self._drawn else None
        drawn = {f"drawn.{name}": value for name, (_, value, _, _) in self._drawn.items()}
        self.state = drawn if self._draw is None else {"draw": self._draw, **drawn}

    def redraw(self, mask: torch.Tensor) -> None:
        """Draws the ranges anew in the environments of `mask`, shape `(N,)` bool."""
        if self._draw is None:
            return
        self._draw.add_(mask.to(torch.int64))
        for column, value, low, high in self._drawn.values():
            fresh = torch.minimum(low + (high - low) * draw.uniform(self._draw, column, value.shape[1]), high)
            value.copy_(torch.where(mask[:, None], fresh, value))

    def advance(self) -> torch.Tensor | None:
        """Moves on to the next draws of a stochastic effect and returns the counter, `(N,)`; `None` where nothing is random."""
        return None if self._draw is None else self._draw.add_(1)


def _chosen(joints: Joints, machine: Machine, where: str) -> np.ndarray:
    """Returns which joints an effect acts on, `(J,)` bool."""
    if joints == "all":
        return np.ones(machine.num_joints, dtype=bool)
    for name in joints:
        if name not in machine.joint_names:
            raise ConfigError(f"{where}: '{name}' is no joint of machine '{machine.name}'; {choices(name, machine.joint_names)}")
    return np.array([name in joints for name in machine.joint_names])


def _sides(value: Value, number: Number, chosen: np.ndarray, machine: Machine, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper ends of a number, each `(J,)`, or `(1,)` for one that joints do not have."""
    if not number.per_joint:
        if isinstance(value, Mapping):
            raise ConfigError(f"{where}: expected a number or a range [low, high], got {dict(value)}: joints do not differ in it")
        ends = tuple(np.array([side]) for side in _ends(value))
    else:
        tables = value if isinstance(value, Mapping) else {"other": value}
        ends = tuple(per_joint({name: _ends(v)[side] for name, v in tables.items()}, machine, where) for side in (0, 1))
        if number.none is not None:
            ends = tuple(np.where(chosen, side, number.none) for side in ends)
    low, high = ends
    least, most = number.bounds
    if (low > high).any():
        raise ConfigError(f"{where}: expected a range [low, high] with low <= high, got {value}")
    if (low < least).any() or (high > most).any():
        raise ConfigError(f"{where}: expected {least:g} to {most:g} {number.unit.replace('1', '')}".rstrip() + f", got {value}")
    return low, high


def _ends(value: float | tuple[float, float]) -> tuple[float, float]:
    return value if isinstance(value, tuple) else (value, value)
