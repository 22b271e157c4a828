"""Numbers of effects: values or ranges, per joint, as tensors over environments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

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
        value: `(N, J)` or `(N, 1)` by name. An entry may be written in place or replaced, by one
            that wants gradients for example; a replaced entry is not drawn again.
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
        self.value: dict[str, torch.Tensor] = {}
        drawn: dict[str, _Column] = {}
        idle: dict[str, list[str]] = {}
        active: set[str] = set()
        for column, (name, number) in enumerate(numbers.items()):
            effect, _, _ = name.rpartition(".")
            acted_on = joints[effect] if isinstance(joints, Mapping) else joints
            chosen = _select_joints(
                acted_on, machine, ".".join(filter(None, (where, effect, "joints")))
            )
            low, high = _resolve_range(fields[name], number, chosen, machine, f"{where}.{name}")
            neutral = low if number.none is None else np.full_like(low, number.none)
            if number.none is not None and not number.is_on(machine):
                if (low != neutral).any() or (high != neutral).any():
                    idle.setdefault(effect, []).append(name)
                low, high = neutral, neutral
            elif (low != neutral).any() or (high != neutral).any():
                active.add(effect)
            if (low < high).any() or (shares.get(effect, 1.0) < 1 and (low != neutral).any()):
                drawn[name] = _Column(
                    low, high, neutral, column * 256 + np.arange(len(low)), effect
                )
            else:
                self.value[name] = (
                    torch.as_tensor(low, dtype=torch.float32, device=device)
                    .expand(num_envs, -1)
                    .clone()
                )
        for effect, names in idle.items():
            if effect not in active:
                raise ConfigError(_explain_idle(machine, names, where, numbers, effect))
        self._draw = start_counter(num_envs, salt, device) if stochastic or drawn else None
        self.state = {} if self._draw is None else {"draw": self._draw}
        self._drawn = _Drawn(list(drawn.values()), shares, device) if drawn else None
        if self._drawn is not None:
            # one tensor, of which each number has its columns
            self._all = self._drawn.low.expand(num_envs, -1).clone()
            widths = [len(column.low) for column in drawn.values()]
            for name, columns in zip(drawn, self._all.split(widths, 1), strict=True):
                self.value[name] = self.state[f"drawn.{name}"] = columns

    def redraw(self, mask: torch.Tensor) -> None:
        """Draw the ranges anew in the environments of `mask`, shape `(N,)` bool."""
        if self._draw is None:
            return
        self._draw.add_(mask.to(torch.int64))
        if self._drawn is not None:
            self._all.copy_(torch.where(mask[:, None], self._drawn.fresh(self._draw), self._all))

    def advance(self) -> torch.Tensor | None:
        """Advance to the next draws and return the counter, `(N,)`; `None` without draws."""
        return None if self._draw is None else self._draw.add_(1)


@dataclass(frozen=True)
class _Column:
    """One drawn number: range, neutral value, keys of its draws, each `(J,)` or `(1,)`; its effect."""

    low: np.ndarray
    high: np.ndarray
    none: np.ndarray
    key: np.ndarray
    effect: str


class _Drawn:
    """All drawn numbers side by side in `W` columns: one draw costs as many launches as ten."""

    def __init__(
        self, columns: Sequence[_Column], shares: Mapping[str, float], device: torch.device
    ) -> None:
        def tensor(parts: Sequence[np.ndarray], dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.as_tensor(np.concatenate(parts), dtype=dtype, device=device)

        self.low = tensor([column.low for column in columns])
        self.high = tensor([column.high for column in columns])
        self._key = tensor([column.key for column in columns], torch.int64)
        self._some = any(share < 1 for share in shares.values())
        if self._some:
            effects = list(dict.fromkeys(column.effect for column in columns))
            self._none = tensor([column.none for column in columns])
            self._share = torch.tensor(
                [shares.get(effect, 1.0) for effect in effects], device=device
            )
            self._share_key = 256 * PRESENT + torch.arange(
                len(effects), dtype=torch.int64, device=device
            )
            self._effect = tensor(
                [np.full(len(column.low), effects.index(column.effect)) for column in columns],
                torch.int64,
            )

    def fresh(self, counter: torch.Tensor) -> torch.Tensor:
        """Return fresh values, `(N, W)`, for the counter `(N,)`."""
        counter = counter[:, None] * 65_536
        value = torch.minimum(
            self.low + (self.high - self.low) * hash_uniform(counter + self._key), self.high
        )
        if not self._some:
            return value
        there = hash_uniform(counter + self._share_key) < self._share
        return torch.where(there.index_select(1, self._effect), value, self._none)


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


def _explain_idle(
    machine: Machine,
    names: Sequence[str],
    where: str,
    numbers: Mapping[str, EffectNumber],
    effect: str,
) -> str:
    """Return the message about numbers that the machine does not have, with those that it has."""
    others = []
    for name, number in numbers.items():
        if (
            name.rpartition(".")[0] == effect
            and number.masses is not None
            and number.is_on(machine)
        ):
            others.append(name)
    known = "has known masses" if machine.has_bodies else "is known by its joints only"
    mend = (
        "" if machine.has_bodies else ", or add joints[].body (axis, origin, mass, …) to its file"
    )
    return (
        f"{where}.{', '.join(names)}: machine '{machine.name}' {known}, so that they do nothing; "
        f"give {', '.join(others)}{mend}"
    )


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
        raise ConfigError(
            f"{where}: expected {least.min():.3g} to {most.max():.3g} {number.unit.replace('1', '')}".rstrip()
            + f", got {value}"
        )
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
