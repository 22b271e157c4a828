"""The effects that a diagnosis chooses among: all that are registered, third parties' too, known by their contract only."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import torch
import yaml

from brokk_rl import registry
from brokk_rl.contracts.actuator import ActuatorModel
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.history import History
from brokk_rl.machine import Machine

log = logging.getLogger(__name__)

ORDER = {"joints": 0, "speed": 1, "command": 2, "measurement": 4, "kinematics": 5}
"""From the machine outwards; delays of a command lie outside of what the valve makes of it."""


@dataclass(frozen=True, eq=False)
class Kind:
    """An effect of the registry.

    Attributes:
        name: As in `effect=[name]`.
        target: The spec.
        num_joints: `J` of the machine that it is used on.
    """

    name: str
    target: Any
    num_joints: int

    @property
    def numbers(self) -> dict[str, Any]:
        """What is known about each of its numbers: `none`, `typical`, `bounds`, `unit`, `per_joint`."""
        return self.target.numbers

    @property
    def stage(self) -> str:
        """On which part of the way from command to estimate it lies."""
        return self.target.stage

    @property
    def order(self) -> tuple[int, int]:
        """Place from the machine outwards."""
        return ORDER.get(self.target.side, 3), int(self.target.stage == "timing")

    @property
    def running(self) -> str | None:
        """Name of the number that is the time since the machine was started; it is given, not fitted."""
        return getattr(self.target, "running", None)

    @property
    def together(self) -> bool:
        """Whether what it does to one joint depends on the others."""
        return self.target.side == "joints"

    @cached_property
    def fitted(self) -> tuple[str, ...]:
        """Numbers that make the effect: those with a neutral value."""
        return tuple(name for name, number in self.numbers.items() if number.none is not None)

    @cached_property
    def shaping(self) -> tuple[str, ...]:
        """Numbers that only shape it, such as a time constant."""
        return tuple(
            n for n, number in self.numbers.items() if number.none is None and n != self.running
        )

    @cached_property
    def neutral(self) -> Any:
        """The spec with every number at its neutral or, for one that has none, at its typical value."""
        values = {
            n: number.typical if number.none is None else number.none
            for n, number in self.numbers.items()
        }
        if any(field.name == "joints" for field in fields(self.target)):
            values["joints"] = "all"
        return self.target(**values)

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> Any:
        """Returns `model` with the effect around it, at its neutral value; numbers are written into `parameters`."""
        return self.neutral.wrap(model, machine, num_envs, device)

    def size(self, name: str) -> float:
        """Returns typical less neutral value: the natural unit of a number. One without a neutral value: its typical value."""
        number = self.numbers[name]
        return number.typical - (number.none or 0.0)

    def clipped(self, name: str, value: np.ndarray) -> np.ndarray:
        """Returns `value` within the bounds of number `name`."""
        return np.clip(value, *self.numbers[name].bounds)


def load(machine: Machine, names: Sequence[str] | None = None) -> list[Kind]:
    """Returns the effects of the registry that can be simulated on `machine`, or of these `names`.

    Raises:
        ConfigError: a name is unknown, or an effect cannot be imported.
    """
    found = {}
    for option in registry.list_options():
        if option.group != "effect":
            continue
        path = (yaml.safe_load(option.path.read_text()) or {}).get("_target_", "")
        module, _, attribute = str(path).rpartition(".")
        try:
            target = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(
                f"effect={option.name}: {path} cannot be imported ({error}); reinstall {option.package}"
            ) from error
        if hasattr(target, "numbers"):  # an option may hold several effects: it is none itself
            found[option.name] = Kind(option.name, target, machine.num_joints)
    for name in names or ():
        if name not in found:
            raise ConfigError(
                f"diagnosis.effects: '{name}' is no effect; {list_choices(name, found)}"
            )
    usable = []
    for kind in (found[name] for name in names or found):
        try:
            _try(kind, machine)
            usable.append(kind)
        except ConfigError as error:
            log.info("%s is left out: %s", kind.name, error)
    return usable


def shared(kinds: Iterable[Kind]) -> frozenset[str]:
    """Returns the effects with one cause for all joints."""
    return frozenset(kind.name for kind in kinds if getattr(kind.target, "shared", False))


def _try(kind: Kind, machine: Machine) -> None:
    """Raises a `ConfigError` when the effect needs what is not known of the machine."""
    device = torch.device("cpu")
    rest = torch.as_tensor((machine.lower + machine.upper) / 2, dtype=torch.float32).expand(
        1, machine.num_history, -1
    )
    model = kind.wrap(Still(), machine, 1, device)
    with torch.inference_mode():
        model.step(History(q=rest.clone(), u=torch.zeros_like(rest)))
        model.misplacement(rest[:, -1]) if kind.target.side == "kinematics" else None


class Still:
    """A machine that does not move."""

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Nothing to forget."""

    def step(self, history: Any) -> torch.Tensor:
        """Returns the positions as they are."""
        return history.q[:, -1]
