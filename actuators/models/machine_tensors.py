"""Constants of a machine as tensors: full step, limits, weight, geometry."""

from __future__ import annotations

from functools import cached_property

import torch

from actuators.models.joint_weight import JointWeight, build_joint_weight
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine


class MachineTensors:
    """Constants of the machine as tensors, each `(J,)`.

    Weight and geometry are built when somebody first asks for them. Most effects do not ask, and
    so they also work on machines of which only the joints are known.

    Args:
        machine: The machine.
        device: Where the tensors live.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.period_s = machine.period_s
        self.full_step = tensor(machine.max_speed * machine.period_s)
        self.max_speed = tensor(machine.max_speed)
        self.lower, self.upper = tensor(machine.lower), tensor(machine.upper)
        self.middle = 0.5 * (self.lower + self.upper)
        self.half_travel = 0.5 * (self.upper - self.lower)
        self.has_masses = machine.has_bodies
        self._slides = torch.tensor([j.kind == "slide" for j in machine.joints], device=device)
        self._machine, self._device = machine, device

    def prepare(self) -> None:
        """Build weight and geometry: a captured step can hold the computation but not the construction."""
        self._weight  # noqa: B018
        self.kinematics  # noqa: B018

    @cached_property
    def _weight(self) -> JointWeight:
        return build_joint_weight(self._machine, self._device)

    def weight(self, q: torch.Tensor) -> torch.Tensor:
        """Return gravity load over yield force at `q`, positive direction, `(N, J)`."""
        return self._weight.weigh(q)

    def read_pose(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return sine and cosine of the angles from mid-travel, each `(N, J)`; see `read_pose`."""
        return read_pose(q, self.middle, self.half_travel, self._slides)

    def hold(self, q: torch.Tensor) -> torch.Tensor:
        """Return positions within the travel."""
        return q.clamp(self.lower, self.upper)

    def hold_from(self, begin: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return positions within the travel; a joint that began beyond a stop may stay there."""
        return q.clamp(torch.minimum(self.lower, begin), torch.maximum(self.upper, begin))

    @cached_property
    def kinematics(self) -> Kinematics:
        """Forward kinematics."""
        return Kinematics(self._machine, self._device)


def read_pose(
    q: torch.Tensor, middle: torch.Tensor, half: torch.Tensor, slides: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return sine and cosine of the angles from mid-travel, each like `q`.

    A sliding joint has its place in the travel, from -1 to 1, and 1.
    """
    away = q - middle
    cos = torch.where(slides, torch.ones_like(q), torch.cos(away))
    return torch.where(slides, away / half, torch.sin(away)), cos
