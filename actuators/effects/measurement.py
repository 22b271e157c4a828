"""Effects on the measured positions that controller and recording receive."""

from __future__ import annotations

from typing import ClassVar

import torch

from actuators.effects.effect import ANY_INTERFACE, EffectSpec
from actuators.effects.ranges import CHANCE, EffectNumber
from actuators.models.parameters import draw_normal
from brokk_rl.spec import spec


class SensorEffect(EffectSpec):
    """An effect on the readings of a sensor at each joint."""

    side = "measurement"
    stage = "sensing"


@spec
class Quantisation(SensorEffect):
    """A coarse sensor: positions come in steps.

    Attributes:
        joints: Joints it acts on, or `all`.
        step_rad: Distance between two readings (m for a sliding joint).
    """

    smooth = False
    interfaces = ANY_INTERFACE
    numbers: ClassVar = {
        "step_rad": EffectNumber("rad", none=0.0, typical=0.003, bounds=(0.0, 0.1), scale="travel")
    }

    def measured(
        self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None
    ) -> torch.Tensor:
        """The nearest multiple of the step."""
        step = value["step_rad"]
        return torch.where(step > 0, (q / step.clamp(min=1e-9)).round() * step, q)


@spec
class SensorNoise(SensorEffect):
    """White noise on each sample of each joint.

    Attributes:
        joints: Joints it acts on, or `all`.
        sigma_rad: Standard deviation (m for a sliding joint).
    """

    stochastic = True
    interfaces = ANY_INTERFACE
    numbers: ClassVar = {
        "sigma_rad": EffectNumber("rad", none=0.0, typical=0.002, bounds=(0.0, 0.1), scale="travel")
    }

    def measured(
        self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None
    ) -> torch.Tensor:
        """`q + sigma N(0, 1)`."""
        assert counter is not None, "noise is stochastic"
        return q + value["sigma_rad"] * draw_normal(counter, CHANCE, q.shape[1])


@spec
class EncoderBias(SensorEffect):
    """The encoder's zero is off.

    Attributes:
        joints: Joints it acts on, or `all`.
        bias_rad: Excess of the reading over the true position (m for a sliding joint).
    """

    interfaces = frozenset({"speed", "torque"})  # a servo has its encoder within its loop
    numbers: ClassVar = {
        "bias_rad": EffectNumber("rad", none=0.0, typical=0.015, bounds=(-0.3, 0.3), scale="travel")
    }

    def measured(
        self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None
    ) -> torch.Tensor:
        """`q + bias`."""
        return q + value["bias_rad"]

    def truth(self, q: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """`q - bias`."""
        return q - _broadcast_over_history(value["bias_rad"], q)


@spec
class EncoderScale(SensorEffect):
    """The encoder's scale is off.

    Attributes:
        joints: Joints it acts on, or `all`.
        scale: Shown angle over true angle, about the zero of the joint.
    """

    interfaces = frozenset({"speed", "torque"})  # a servo has its encoder within its loop
    numbers: ClassVar = {"scale": EffectNumber("1", none=1.0, typical=1.015, bounds=(0.7, 1.4))}

    def measured(
        self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None
    ) -> torch.Tensor:
        """`scale q`."""
        return q * value["scale"]

    def truth(self, q: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """`q / scale`."""
        return q / _broadcast_over_history(value["scale"], q)


def _broadcast_over_history(value: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return parameters `(N, J)` so that they broadcast over `(N, J)` or `(N, H, J)`."""
    return value if q.dim() == 2 else value[:, None]
