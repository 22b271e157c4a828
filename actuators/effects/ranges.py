"""Numbers of effects: values or ranges, per joint, as tensors over environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch

from actuators.models.parameters import OTHER, expand_per_joint, hash_uniform, start_counter
from actuators.scales import Scale, measure_scale
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine

TypicalRange = tuple[float, float, Literal["typical"]]
"""A range `[low, high, typical]` over the typical size of each joint; see `EffectNumber.scale_to`."""
Range = float | tuple[float, float] | TypicalRange
Value = Range | dict[str, Range]
"""A number, a range `[low, high]` drawn per environment and joint at each reset, the same over the
typical size, or any of them by joint name (`other` for the rest)."""
Joints = Literal["all"] | tuple[str, ...]
"""Joints that an effect acts on."""

CHANCE = 128
"""First column of the draws that are not for parameters."""
PRESENT = 192
"""First column of the draws that decide which effects there are."""


@dataclass(frozen=True)
class EffectNumber:
    """Unit, neutral value, typical size and bounds of one number of an effect.

    Attributes:
        unit: SI unit, `1` for none; `rad` and `rad/s` read m and m/s for a sliding joint.
        none: Value at which the effect changes nothing. `None` for a number that only shapes the
            effect (a time constant), which is off when the others are.
        typical: Size on a machine that has the effect, on the reference of `actuators.scales`.
        bounds: Smallest and largest value that make sense there.
        per_joint: Whether each joint has its own; otherwise one number an environment, `(N, 1)`.
        trials: Values of a number that only shapes the effect which a diagnosis tries; empty for
            multiples of the typical one.
        scale: Property of the joint with which typical size and bounds grow; empty for none.
        masses: Machines that have the number: `True` for those with known masses, `False` for those
            without, `None` for all. On others it stays neutral.
    """

    unit: str
    none: float | None
    typical: float
    bounds: tuple[float, float]
    per_joint: bool = True
    trials: tuple[float, ...] = ()
    scale: Scale = ""
    masses: bool | None = None

    def is_on(self, machine: Machine) -> bool:
        """Return whether the machine has this number."""
        return self.masses is None or self.masses == machine.has_bodies

    def scale_to(self, machine: Machine, value: float) -> np.ndarray:
        """Return a value of the reference on each joint of `machine`, `(J,)` or `(1,)`.

        The distance from the neutral value grows with `scale`.
        """
        neutral = self.none or 0.0
        scaled = neutral + (value - neutral) * measure_scale(machine, self.scale)
        return np.broadcast_to(scaled, (machine.num_joints if self.per_joint else 1,)).copy()

    def limit_on(self, machine: Machine) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest value on each joint of `machine`, `(J,)` or `(1,)`."""
        low, high = (self.scale_to(machine, bound) for bound in self.bounds)
        return low, high


class ParameterRanges:
    """Parameters of one or several effects for all environments; all draws are one draw.

    Attributes:
        value: `(N, J)` or `(N, 1)` by name. An entry may be written in place or replaced; a replaced
            entry is not drawn again.
        state: Counter and drawn values; empty where nothing is random.

    Args:
        fields: Numbers as configured, by name; those of several effects as `effect.number`.
        numbers: Unit, neutral value and bounds of each.
        joints: Joints that are acted on; elsewhere each number is at its `none`.
        machine: The machine.
        num_envs: Number of environments, `N`.
        device: Where the tensors live.
        stochastic: Whether there are draws in every step.
        salt: Keeps the draws of several effects apart.
        where: Config node named in messages.
        shares: Part of the environments that have an effect, by effect; all have those not named.
            The others have its numbers at their `none`. Each reset draws anew who has the effect.

    Raises:
        ConfigError: a number is out of bounds, a range upside down, or a joint unknown.
    """

    def __init__(
        self,
        fields: Mapping[str, Value],
        numbers: Mapping[str, EffectNumber],
        joints: Joints | Mapping[str, Joints],
        machine: Machine,
        num_envs: int,
        device: torch.device,
        stochastic: bool,
        salt: int,
        where: str,
        shares: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        def tensor(values: np.ndarray, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.as_tensor(values, dtype=dtype, device=device)

        self.value: dict[str, torch.Tensor] = {}
        drawn: dict[str, tuple[np.ndarray, ...]] = {}
        drawn_effects: list[str] = []
        idle: dict[str, list[str]] = {}
        active: set[str] = set()
        for column, (name, number) in enumerate(numbers.items()):
            effect, _, _ = name.rpartition(".")
            acted_on = joints[effect] if isinstance(joints, Mapping) else joints
            place = ".".join(filter(None, (where, effect, "joints")))
            chosen = _select_joints(acted_on, machine, place)
            low, high = _resolve_range(fields[name], number, chosen, machine, f"{where}.{name}")
            neutral = low if number.none is None else np.full_like(low, number.none)
            does_something = bool((low != neutral).any() or (high != neutral).any())
            if number.none is not None and not number.is_on(machine):
                if does_something:
                    idle.setdefault(effect, []).append(name)
                low, high = neutral, neutral
            elif does_something:
                active.add(effect)
            share = shares.get(effect, 1.0)
            if not (low < high).any() and (share == 1 or not (low != neutral).any()):
                self.value[name] = tensor(low).expand(num_envs, -1).clone()
                continue
            if effect not in drawn_effects:
                drawn_effects.append(effect)
            own, present = column * 256, 256 * PRESENT + drawn_effects.index(effect)
            keys = own + np.arange(len(low)), np.full(len(low), present)
            drawn[name] = (low, high, neutral, np.full(len(low), share), *keys)
        for effect, names in idle.items():
            if effect not in active:
                known = "has known masses"
                if not machine.has_bodies:
                    known = "is known by its joints only (add joints[].body to its file)"
                raise ConfigError(
                    f"{where}.{', '.join(names)}: machine '{machine.name}' {known}, so that they do nothing; give the other numbers"
                )
        self._draw = start_counter(num_envs, salt, device) if stochastic or drawn else None
        self.state = {} if self._draw is None else {"draw": self._draw}
        self._drawn: torch.Tensor | None = None
        if not drawn:
            return
        # One tensor, of which each number has its columns: one draw costs as many launches as ten.
        low, high, neutral, share, key, present = map(
            np.concatenate, zip(*drawn.values(), strict=True)
        )
        self._low, self._high, self._none = tensor(low), tensor(high), tensor(neutral)
        self._share = tensor(share) if any(one < 1 for one in shares.values()) else None
        self._key, self._present = tensor(key, torch.int64), tensor(present, torch.int64)
        self._drawn = self._low.expand(num_envs, -1).clone()
        widths = [len(columns[0]) for columns in drawn.values()]
        for name, columns in zip(drawn, self._drawn.split(widths, 1), strict=True):
            self.value[name] = self.state[f"drawn.{name}"] = columns

    def redraw(self, mask: torch.Tensor) -> None:
        """Draw the ranges anew in the environments of `mask`, shape `(N,)` bool."""
        if self._draw is None:
            return
        self._draw.add_(mask.to(torch.int64))
        if self._drawn is None:
            return
        counter = self._draw[:, None] * 65_536
        value = self._low + (self._high - self._low) * hash_uniform(counter + self._key)
        value = torch.minimum(value, self._high)
        if self._share is not None:
            is_there = hash_uniform(counter + self._present) < self._share
            value = torch.where(is_there, value, self._none)
        self._drawn.copy_(torch.where(mask[:, None], value, self._drawn))

    def advance(self) -> torch.Tensor | None:
        """Advance to the next draws and return the counter, `(N,)`; `None` without draws."""
        return None if self._draw is None else self._draw.add_(1)


def check_numbers(
    values: Mapping[str, Any], numbers: Mapping[str, EffectNumber], machine: Machine, where: str
) -> None:
    """Refuse numbers and joints that a machine cannot have; see `ParameterRanges`."""
    chosen = _select_joints(values.get("joints", "all"), machine, f"{where}.joints")
    for name, number in numbers.items():
        _resolve_range(values[name], number, chosen, machine, f"{where}.{name}")


def _select_joints(joints: Joints, machine: Machine, where: str) -> np.ndarray:
    """Return which joints an effect acts on, `(J,)` bool."""
    if joints == "all":
        return np.ones(machine.num_joints, dtype=bool)
    for name in joints:
        if name not in machine.joint_names:
            raise ConfigError(
                f"{where}: '{name}' is no joint of machine '{machine.name}'; {list_choices(name, machine.joint_names)}"
            )
    return np.array([name in joints for name in machine.joint_names])


def _resolve_range(
    value: Value, number: EffectNumber, chosen: np.ndarray, machine: Machine, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper end of a number, each `(J,)`, or `(1,)` without joints."""
    if not number.per_joint:
        if isinstance(value, Mapping):
            raise ConfigError(
                f"{where}: expected a number or a range [low, high], got {dict(value)}: joints do not differ in it"
            )
        low, high = _resolve_ends(value, number, machine)
    else:
        table = value if isinstance(value, Mapping) else {OTHER: value}
        expand_per_joint(dict.fromkeys(table, 0.0), machine, where)  # refuses unknown names
        ends = {key: _resolve_ends(entry, number, machine) for key, entry in table.items()}
        rows = [ends[name if name in ends else OTHER] for name in machine.joint_names]
        low = np.array([row[0][j] for j, row in enumerate(rows)], float)
        high = np.array([row[1][j] for j, row in enumerate(rows)], float)
        if number.none is not None:
            low, high = (np.where(chosen, side, number.none) for side in (low, high))
    # Files from before sizes grew with the joints keep their meaning: the reference's bounds count too.
    least, most = number.limit_on(machine)
    least, most = np.minimum(least, number.bounds[0]), np.maximum(most, number.bounds[1])
    if (low > high).any():
        raise ConfigError(f"{where}: expected a range [low, high] with low <= high, got {value}")
    if (low < least).any() or (high > most).any():
        span = f"{least.min():.3g} to {most.max():.3g} {number.unit.replace('1', '')}".rstrip()
        raise ConfigError(f"{where}: expected {span}, got {value}")
    return low, high


def _resolve_ends(
    value: Range, number: EffectNumber, machine: Machine
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of a number or range on all joints, each `(J,)` or `(1,)`."""
    count = machine.num_joints if number.per_joint else 1
    if not isinstance(value, tuple):
        return np.full(count, value), np.full(count, value)
    if len(value) == 2:
        return np.full(count, value[0]), np.full(count, value[1])
    low, high, _ = value
    if low > high:
        return np.full(count, low), np.full(count, high)
    neutral = number.none or 0.0
    size = number.scale_to(machine, number.typical) - neutral
    ends = neutral + low * size, neutral + high * size
    return np.minimum(*ends), np.maximum(*ends)
