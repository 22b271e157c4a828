"""Effects on what controller and recording see of the positions."""

from typing import ClassVar

import torch

from actuators.effects import draw
from actuators.effects.ranges import CHANCE, Joints, Number, Value
from actuators.effects.wrapped import EffectSpec, Wrapped
from brokk_rl.contracts import ActuatorModel
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Quantisation(EffectSpec):
    """A coarse sensor: positions come in steps.

    Attributes:
        joints: Joints it acts on, or `all`.
        step_rad: Distance between two readings (m for a sliding joint).
    """

    joints: Joints
    step_rad: Value
    side = "measurement"
    stage = "sensing"
    smooth = False
    numbers: ClassVar = {"step_rad": Number("rad", none=0.0, typical=0.003, bounds=(0.0, 0.1))}

    def measured(self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None) -> torch.Tensor:
        """The nearest multiple of the step."""
        step = value["step_rad"]
        return torch.where(step > 0, (q / step.clamp(min=1e-9)).round() * step, q)


@spec
class SensorNoise(EffectSpec):
    """White noise on each sample of each joint.

    Attributes:
        joints: Joints it acts on, or `all`.
        sigma_rad: Standard deviation (m for a sliding joint).
    """

    joints: Joints
    sigma_rad: Value
    side = "measurement"
    stage = "sensing"
    stochastic = True
    numbers: ClassVar = {"sigma_rad": Number("rad", none=0.0, typical=0.002, bounds=(0.0, 0.1))}

    def measured(self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None) -> torch.Tensor:
        """`q + sigma N(0, 1)`."""
        assert counter is not None, "noise is stochastic"
        return q + value["sigma_rad"] * draw.normal(counter, CHANCE, q.shape[1])


@spec
class EncoderBias(EffectSpec):
    """The encoder's zero is off.

    Attributes:
        joints: Joints it acts on, or `all`.
        bias_rad: What the encoder shows too much (m for a sliding joint).
    """

    joints: Joints
    bias_rad: Value
    side = "measurement"
    stage = "sensing"
    numbers: ClassVar = {"bias_rad": Number("rad", none=0.0, typical=0.015, bounds=(-0.3, 0.3))}

    def measured(self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None) -> torch.Tensor:
        """`q + bias`."""
        return q + value["bias_rad"]

    def truth(self, q: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """`q - bias`."""
        return q - _along(value["bias_rad"], q)


@spec
class EncoderScale(EffectSpec):
    """The encoder's scale is off.

    Attributes:
        joints: Joints it acts on, or `all`.
        scale: Shown angle over true angle, about the zero of the joint.
    """

    joints: Joints
    scale: Value
    side = "measurement"
    stage = "sensing"
    numbers: ClassVar = {"scale": Number("1", none=1.0, typical=1.015, bounds=(0.7, 1.4))}

    def measured(self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None) -> torch.Tensor:
        """`scale q`."""
        return q * value["scale"]

    def truth(self, q: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """`q / scale`."""
        return q / _along(value["scale"], q)


class Measured:
    """A model with its sensors, for free runs: from measured positions to the next measured ones.

    In a simulator the world keeps the true positions; in a free run nobody does. This keeps them, beginning where the history says,
    and is an actuator model in which `history.q` and the result are what recordings hold.
    """

    def __init__(self, model: Wrapped, machine: Machine, num_envs: int, device: torch.device) -> None:
        self._model: ActuatorModel = model
        self._sensors = model
        self._q = torch.zeros(num_envs, machine.num_history, machine.num_joints, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`q`, the true history `(N, H, J)`, and the model's as `inner.…`."""
        return {"q": self._q, "fresh": self._fresh} | {f"inner.{name}": value for name, value in self._model.state.items()}

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets the true positions in the environments of `mask`, shape `(N,)` bool."""
        if self._q.requires_grad:
            self._q.detach_()
        self._fresh.logical_or_(mask)
        self._model.reset(mask)

    def step(self, history: History) -> torch.Tensor:
        """Returns the measured positions one control period later, shape `(N, J)`."""
        true = torch.where(self._fresh[:, None, None], self._sensors.truth(history.q), self._q)
        q = self._model.step(History(q=true, u=history.u))
        self._q.copy_(torch.cat((true[:, 1:], q[:, None]), 1))
        self._fresh.fill_(False)
        return self._sensors.measure(q)


def _along(value: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Returns parameters `(N, J)` so that they broadcast over `(N, J)` or `(N, H, J)`."""
    return value if q.dim() == 2 else value[:, None]
