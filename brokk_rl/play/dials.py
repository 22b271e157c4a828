"""Dials of effects: sizes of what makes a machine differ, changed while it runs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from brokk_rl.contracts.actuator import ActuatorModel
from brokk_rl.machine import Machine

LARGEST = 3.0
"""Largest size of an effect, in typical sizes. Chosen by hand: three times what a machine has."""


@dataclass(frozen=True)
class EffectDial:
    """One number of an effect: 0 is none of it, 1 the typical size on a machine that has it.

    Attributes:
        effect: Name of the effect.
        number: Name of the number, with its unit.
        low: Smallest size, in typical sizes.
        high: Largest size.
        typical: Number at size 1 on each joint, `(J,)` or `(1,)`.
        none: Number at size 0, likewise.
        parameters: Numbers of the model by name, `(N, J)` or `(N, 1)`; an entry is replaced.
        key: Name of the number there.
    """

    effect: str
    number: str
    low: float
    high: float
    typical: torch.Tensor
    none: torch.Tensor
    parameters: dict[str, torch.Tensor]
    key: str

    @property
    def label(self) -> str:
        """Name of the dial."""
        return f"{self.effect}.{self.number}"

    def turn(self, size: float) -> None:
        """Give all machines the effect in `size`, limited to what makes sense."""
        size = min(max(size, self.low), self.high)
        value = self.none + size * (self.typical - self.none)
        before = self.parameters[self.key]
        # a replaced entry is not drawn anew when an episode begins
        self.parameters[self.key] = value.to(before).expand_as(before).clone()


def list_dials(model: ActuatorModel, machine: Machine) -> list[EffectDial]:
    """Return a dial for each number of each effect around an actuator model.

    Numbers that only shape an effect, such as its time constant, have none.
    """
    found = []
    layer: Any = model
    while layer is not None:
        if hasattr(layer, "effects") and hasattr(layer, "parameters"):
            for name, effect in layer.effects.items():
                for key, number in effect.numbers.items():
                    if number.none is None or not number.is_on(machine):
                        continue
                    dial = _make_dial(layer, name, effect.name(), key, number, machine)
                    if dial.low < dial.high:
                        found.append(dial)
        layer = getattr(layer, "inner", None)
    return found


def _make_dial(
    chain: Any, prefix: str, effect: str, key: str, number: Any, machine: Machine
) -> EffectDial:
    """Return the dial of one number; `prefix` is the name of its effect in the chain."""
    none, typical = (number.scale_to(machine, value) for value in (number.none, number.typical))
    ends = (np.array(number.limit_on(machine)) - none) / (typical - none)
    low, high = max(-LARGEST, ends.min(0).max()), min(LARGEST, ends.max(0).min())
    return EffectDial(
        effect=effect,
        number=key,
        low=math.ceil(low * 10 - 1e-6) / 10,
        high=math.floor(high * 10 + 1e-6) / 10,
        typical=torch.as_tensor(typical, dtype=torch.float32),
        none=torch.as_tensor(none, dtype=torch.float32),
        parameters=chain.parameters,
        key=f"{prefix}.{key}" if prefix else key,
    )
