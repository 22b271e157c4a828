"""The registered effects as a diagnosis sees them.

A diagnosis knows effects by their contract only, so that effects of third parties take part.
Axes: `C` candidates, `J` joints.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import torch

from actuators.models.linear import Hold
from brokk_rl import build, registry
from brokk_rl.contracts.actuator import Actuator, ActuatorModel
from brokk_rl.errors import ConfigError, group_by_reason, list_choices
from brokk_rl.history import History
from brokk_rl.machine import Machine
from diagnosis.answer import Estimate, Stage

log = logging.getLogger(__name__)

SIDE_ORDER = {"drive": -1, "joints": 0, "speed": 1, "command": 2, "measurement": 4, "kinematics": 5}
"""From the machine outwards; delays of a command lie outside of what the valve makes of it."""


EffectValues = Mapping[str, np.ndarray]
"""Numbers of an effect by name, each `(C, J)`, or `(C, 1)` for one that joints do not have."""


@dataclass(frozen=True, eq=False)
class EffectType:
    """An effect of the registry.

    Attributes:
        name: As in `effect=[name]`.
        target: The spec.
        machine: The machine that it is used on.
    """

    name: str
    target: Any
    machine: Machine

    @cached_property
    def numbers(self) -> dict[str, Any]:
        """Facts about each of its numbers on this machine: `none`, `trials`, `unit`, `per_joint`.

        Their `typical` and `bounds` are those of the reference machine; see `typical` and `limits`.
        """
        return {n: one for n, one in self.target.numbers.items() if one.is_on(self.machine)}

    @property
    def stage(self) -> Stage:
        """On which part of the way from command to estimate it lies."""
        return self.target.stage

    @property
    def order(self) -> tuple[int, int, int]:
        """Place from the machine outwards."""
        side = SIDE_ORDER.get(self.target.side, 3)
        return side, int(self.target.stage == "timing"), getattr(self.target, "layer", 0)

    @property
    def running(self) -> str | None:
        """Name of the number that is the time since the machine was started; it is given, not fitted."""
        return getattr(self.target, "running", None)

    @cached_property
    def fitted(self) -> tuple[str, ...]:
        """Number that make the effect: those with a neutral value."""
        return tuple(name for name, number in self.numbers.items() if number.none is not None)

    @cached_property
    def shaping(self) -> tuple[str, ...]:
        """Number that only shape it, such as a time constant."""
        return tuple(
            n for n, number in self.numbers.items() if number.none is None and n != self.running
        )

    @cached_property
    def neutral(self) -> Any:
        """The spec with every number at its neutral or, for one that has none, at its typical value."""
        values = {
            n: number.typical if number.none is None else number.none
            for n, number in self.target.numbers.items()
        }
        if any(field.name == "joints" for field in fields(self.target)):
            values["joints"] = "all"
        return self.target(**values)

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> Any:
        """Return `model` with the effect around it, at its neutral value; numbers are written into `parameters`."""
        return self.neutral.wrap(model, machine, num_envs, device)

    def typical(self, name: str) -> np.ndarray:
        """Return the typical value of a number on each joint, `(J,)`, or `(1,)` without joints."""
        return self.numbers[name].scale_to(self.machine, self.numbers[name].typical)

    def limits(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest value of a number, each `(J,)` or `(1,)`."""
        return self.numbers[name].limit_on(self.machine)

    def size(self, name: str) -> np.ndarray:
        """Return typical less neutral value, `(J,)` or `(1,)`: the natural unit of a number.

        One without a neutral value: its typical value.
        """
        return self.typical(name) - (self.numbers[name].none or 0.0)

    def size_on(self, name: str, joint: int | None) -> float:
        """Return the natural unit of a number on one joint; `None`: of one that joints do not have."""
        size = self.size(name)
        return float(size[joint if joint is not None and len(size) > 1 else 0])

    def clipped(self, name: str, value: np.ndarray) -> np.ndarray:
        """Return `value`, `(…, J)` or `(…, 1)`, within the bounds of number `name`."""
        return np.clip(value, *self.limits(name))


def load_effects(
    machine: Machine, names: Sequence[str] | None = None, simulator: Actuator | None = None
) -> list[EffectType]:
    """Return the effects of the registry that can be simulated on `machine`, or of these `names`.

    Args:
        machine: The machine.
        names: Names to choose; `None`: all.
        simulator: Adds effects on its own numbers, if it has methods `list_effects` and `list_left_out`.

    Raises:
        ConfigError: a name is unknown, or an effect cannot be imported.
    """
    found = {}
    for option in registry.list_options("effect"):
        target = build.load_class(option.target, f"effect={option.name}") if option.target else None
        if not hasattr(target, "numbers"):  # an option may hold several effects: it is none itself
            continue
        target = getattr(target, "find_variant", lambda _, own=target: own)(machine)
        if target is not None:
            found[option.name] = EffectType(option.name, target, machine)
    if hasattr(simulator, "list_effects"):  # it has such numbers of its own, not those of a drive
        found = {name: kind for name, kind in found.items() if kind.target.side != "drive"}
    inside = getattr(simulator, "list_effects", dict)()
    for name, target in inside.items():
        found[name] = EffectType(name, target, machine)
    left_out = getattr(simulator, "list_left_out", dict)()
    reasons = {} if names else dict(left_out)
    for name in names or ():
        if name in left_out:
            raise ConfigError(f"diagnosis.effects: '{name}' cannot be simulated: {left_out[name]}")
        if name not in found:
            raise ConfigError(
                f"diagnosis.effects: '{name}' is no effect; {list_choices(name, found)}"
            )
    usable = []
    for kind in (found[name] for name in names or found):
        if kind.name in inside:
            usable.append(kind)
            continue
        try:
            _check_simulable(kind, machine)
            usable.append(kind)
        except ConfigError as error:
            reasons[kind.name] = str(error).partition(";")[0]
    if reasons:
        log.info("not asked about: %s", group_by_reason(reasons))
    return usable


def list_shared_effects(kinds: Iterable[EffectType]) -> frozenset[str]:
    """Return the effects with one cause for all joints."""
    return frozenset(kind.name for kind in kinds if getattr(kind.target, "shared", False))


def _check_simulable(kind: EffectType, machine: Machine) -> None:
    """Raise a `ConfigError` when the effect needs unknown properties of the machine."""
    device = torch.device("cpu")
    rest = torch.as_tensor((machine.lower + machine.upper) / 2, dtype=torch.float32).expand(
        1, machine.num_history, -1
    )
    model = kind.wrap(Hold(), machine, 1, device)
    with torch.inference_mode():
        model.step(History(q=rest.clone(), u=torch.zeros_like(rest)))
        model.misplacement(rest[:, -1]) if kind.target.side == "kinematics" else None


@dataclass(frozen=True)
class DetectedEffect:
    """An effect with its numbers.

    Attributes:
        kind: The effect.
        joints: Which joints have it, `(J,)` bool.
        parameters: By name and joint, or `machine`.
        net_gain: Log-likelihood gain less its penalty, nats.
        gain: Log-likelihood gain, nats.
    """

    kind: EffectType
    joints: np.ndarray
    parameters: Mapping[str, Mapping[str, Estimate]]
    net_gain: float
    gain: float

    def values(self) -> dict[str, np.ndarray]:
        """Return its numbers, each `(J,)` or `(1,)`."""
        found = {}
        for name, estimates in self.parameters.items():
            if "machine" in estimates:
                found[name] = np.array([estimates["machine"].mean])
                continue
            number = self.kind.numbers[name]
            off = self.kind.typical(name) if number.none is None else number.none
            found[name] = np.broadcast_to(off, len(self.joints)).astype(float)
            found[name][self.joints] = [one.mean for one in estimates.values()]
        return found
