"""Parameters of an actuator: one value or one per joint, random draws, dead time and dead band.

Random numbers come from a counter in the state instead of a generator. No host is involved, a CUDA
graph may hold the draws, and a run that is restored from its state goes on exactly; a generator would
be memory outside the state, which the contract of an actuator model forbids.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, get_type_hints

import numpy as np
import torch
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine

OTHER = "other"
"""Key for the joints that a per-joint table does not name."""

SUITABLE = {
    "speed": "actuator=lag or another model of a speed",
    "position": "actuator=servo fit=servo",
    "torque": "actuator=force fit=force",
}
"""Actuators and fits for each interface, as an error names them."""
COMMANDS = {"speed": "valve or velocity", "position": "position", "torque": "torque with max_force"}
"""Commands of a joint that have each interface."""

PerJoint = float | dict[str, float]
"""One number for all joints, or a table by joint name; `other` stands for the joints it does not
name."""


@dataclass(frozen=True)
class NumberBounds:
    """Constraint of a number, or of each in a table by joint.

    Attributes:
        text: The bounds in words.
        low: Smallest value.
        high: Largest value.
    """

    text: str
    low: float
    high: float = math.inf

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def check(self, value: PerJoint) -> PerJoint:
        """Return the number or table; raise an error of pydantic where one is out of bounds."""
        numbers = value.values() if isinstance(value, dict) else (value,)
        if all(self.low <= one <= self.high for one in numbers):
            return value
        raise PydanticCustomError("bounds", "expected {text}", {"text": self.text})


PositivePerJoint = Annotated[PerJoint, NumberBounds("more than 0", 1e-12)]
NonNegativePerJoint = Annotated[PerJoint, NumberBounds("0 or more", 0.0)]
SharePerJoint = Annotated[PerJoint, NumberBounds("0 to 1", 0.0, 1.0)]


def check_interface(machine: Machine, interface: str, title: str) -> None:
    """Refuse a machine whose commands set another quantity.

    Args:
        machine: The machine.
        interface: Quantity that the model's commands set, a value of `Machine.interface`.
        title: The model and what its commands are, such as "a servo follows positions".

    Raises:
        ConfigError: the machine is commanded by something else.
    """
    if machine.interface != interface:
        raise ConfigError(
            f"actuator or fit: {title}, but machine '{machine.name}' is commanded by {machine.interface}; choose "
            f"{SUITABLE[machine.interface]}, or write another command at its joints: {COMMANDS[interface]}"
        )


def expand_per_joint(value: PerJoint, machine: Machine, where: str) -> np.ndarray:
    """Return `value` for every joint of `machine`, shape `(J,)`.

    A table that has `other` may name joints that this machine lacks, so that one file serves
    several machines; without `other` it must name exactly the joints of the machine.

    Raises:
        ConfigError: a joint is missing or unknown; names `where`.
    """
    if not isinstance(value, Mapping):
        return np.full(machine.num_joints, float(value))
    known = machine.joint_names
    if OTHER not in value:
        for name in value:
            if name not in known:
                raise ConfigError(
                    f"{where}: '{name}' is no joint of machine '{machine.name}'; {list_choices(name, (*known, OTHER))}"
                )
    missing = [name for name in known if name not in value and OTHER not in value]
    if missing:
        raise ConfigError(
            f"{where}: no value for {', '.join(missing)} of machine '{machine.name}'; add them, or '{OTHER}'"
        )
    return np.array([float(value.get(name, value.get(OTHER, 0.0))) for name in known])


def read_parameters(
    config: Any, machine: Machine, absent: Mapping[str, np.ndarray] = MappingProxyType({})
) -> dict[str, np.ndarray]:
    """Return the numbers of an actuator's spec for every joint, `(J,)` each.

    Args:
        config: The spec. Its fields of one number, or one for each joint, are read.
        machine: The machine, whose `dead_time_s` stands for one that is `None`.
        absent: Values `(J,)` of other fields that are `None`; without one such a field is left out.

    Raises:
        ConfigError: a joint is missing or unknown.
    """
    given = {"dead_time_s": np.full(machine.num_joints, machine.dead_time_s), **absent}
    found = {}
    for name, hint in get_type_hints(type(config)).items():
        value = getattr(config, name, None)
        if hint in (PerJoint, PerJoint | None) and value is not None:
            found[name] = expand_per_joint(value, machine, f"actuator.{name}")
        elif hint == PerJoint | None and name in given:
            found[name] = given[name]
    return found


# random numbers


def start_counter(num_envs: int, salt: int, device: torch.device) -> torch.Tensor:
    """Return the first counter of each environment, `(N,)` int64, from torch's seed.

    `salt` keeps effects apart.
    """
    seed = (torch.initial_seed() + salt * 2_654_435_761) % 2**31
    return torch.arange(num_envs, dtype=torch.int64, device=device) * 2_654_435_761 + seed


def draw_uniform(draw: torch.Tensor, column: int, width: int) -> torch.Tensor:
    """Return numbers in [0, 1), `(N, width)`, for the counter `(N,)`.

    Each `column` (below 256) gives independent ones.
    """
    place = torch.arange(width, dtype=torch.int64, device=draw.device) + 256 * column
    return hash_uniform(draw[:, None] * 65_536 + place)


def hash_uniform(key: torch.Tensor) -> torch.Tensor:
    """Return uniform numbers in [0, 1) for int64 keys.

    Mixing steps of splitmix64 (Steele et al. 2014), which wrap around.
    """
    key = key * -7_046_029_254_386_353_131
    key = (key ^ ((key >> 30) & 0x3FFFFFFFF)) * -4_658_895_280_553_007_687
    key = (key ^ ((key >> 27) & 0x1FFFFFFFFF)) * -7_723_592_293_110_705_685
    return ((key >> 40) & 0xFFFFFF).to(torch.float32) / float(1 << 24)


def draw_normal(draw: torch.Tensor, column: int, width: int) -> torch.Tensor:
    """Return standard normal numbers, `(N, width)` (Box and Muller).

    Uses `column` and `column + 1`.
    """
    radius = torch.sqrt(-2.0 * torch.log(1.0 - draw_uniform(draw, column, width)))
    return radius * torch.cos(2.0 * math.pi * draw_uniform(draw, column + 1, width))


# dead time and dead band


def check_dead_time(longest_s: float, machine: Machine, where: str) -> None:
    """Raise a `ConfigError` when the machine's history does not reach back `longest_s`."""
    reach_s = (machine.num_history - 1) * machine.period_s
    if not 0.0 <= longest_s <= reach_s + 1e-6:
        raise ConfigError(
            f"{where}: a dead time of {longest_s:.3f} s does not fit the {reach_s:.3f} s that the history of "
            f"machine '{machine.name}' reaches back; shorten it or raise machine.num_history"
        )


def select_commands_in_force(
    u: torch.Tensor, delay_periods: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Split the coming control period at the moment when the delayed command changes.

    A command is held for one period, so with a dead time of `n + f` periods the valve sees the
    command of `n + 1` periods ago for the first part `f` of the period and that of `n` periods ago
    for the rest. Nothing is interpolated: this is exact.

    Args:
        u: Command history, shape `(N, H, J)`, newest last.
        delay_periods: Dead time in control periods, shape `(N, J)`, in [0, H - 1].

    Returns:
        The earlier command, the later command, and the part of the period in which the earlier one
        acts, each `(N, J)`.
    """
    earlier, later, part = split_run_commands(u.transpose(0, 1), delay_periods, u.shape[1])
    return earlier[0], later[0], part


def split_run_commands(
    u: torch.Tensor, delay_periods: torch.Tensor, first: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return `select_commands_in_force` of each step of a run, the two commands `(T - first + 1, N, J)`.

    Args:
        u: Commands of the run, `(T, N, J)`; step `k` follows command `first + k - 1`.
        delay_periods: Dead time in control periods, `(N, J)`.
        first: Length of the history at the first step.
    """
    # half a millionth of a period forgives 0.55 / 0.05 = 11.000000000000002
    whole = torch.floor(delay_periods + 5e-7)
    part = (delay_periods - whole).clamp(0.0, 1.0)
    steps = torch.arange(first - 2, len(u), device=u.device)[:, None, None]
    found = u.gather(0, (steps - whole.to(torch.int64)).clamp(0, len(u) - 1))
    return found[:-1], found[1:], part


def open_valve(
    u: torch.Tensor, dead_band_extend: torch.Tensor, dead_band_retract: torch.Tensor
) -> torch.Tensor:
    """Return the valve opening in [-1, 1], shape of `u`.

    Zero inside the dead band, one at full command each way.
    """
    extend = torch.relu(u - dead_band_extend) / (1.0 - dead_band_extend)
    retract = torch.relu(-u - dead_band_retract) / (1.0 - dead_band_retract)
    return extend - retract
