"""Inputs of an effect in one control period: its numbers and memory, the history, constants of the machine."""

from dataclasses import dataclass
from functools import cached_property

import torch

from actuators.effects.ranges import CHANCE
from actuators.models.joint_weight import JointWeight, build_joint_weight
from actuators.models.parameters import draw_uniform
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine

Memory = dict[str, torch.Tensor]


class MachineTensors:
    """Constants of the machine as tensors: full step, limits, weight, geometry.

    Weight and geometry are built when an effect first asks for them. Most effects do not ask, and
    so they also work on machines of which only the joints are known. A captured step can hold the
    computation but not the construction: effects that always need them say so beforehand.

    Args:
        machine: The machine.
        device: Where the tensors live.
        weighed: Whether the weight is asked for in every step.
        placed: Whether the geometry is asked for in every step.
    """

    def __init__(
        self, machine: Machine, device: torch.device, weighed: bool = False, placed: bool = False
    ) -> None:
        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.period_s = machine.period_s
        self.full_step = tensor(machine.max_speed * machine.period_s)
        self.lower, self.upper = tensor(machine.lower), tensor(machine.upper)
        self.middle = 0.5 * (self.lower + self.upper)
        self.half_travel = 0.5 * (self.upper - self.lower)
        self.has_masses = machine.has_bodies
        self._slides = torch.tensor([j.kind == "slide" for j in machine.joints], device=device)
        self._machine, self._device = machine, device
        if weighed:
            self._weight  # noqa: B018
        if placed:
            self.kinematics  # noqa: B018

    @cached_property
    def _weight(self) -> JointWeight:
        return build_joint_weight(self._machine, self._device)

    def weight(self, q: torch.Tensor) -> torch.Tensor:
        """Return gravity load over yield force at `q`, positive direction, `(N, J)`."""
        return self._weight.weigh(q)

    def read_pose(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return cosine and sine of the angles from mid-travel, each `(N, J)`.

        A sliding joint has 1, and its place in the travel from -1 to 1.
        """
        away, half = q - 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        cos = torch.where(self._slides, torch.ones_like(q), torch.cos(away))
        return cos, torch.where(self._slides, away / half, torch.sin(away))

    @cached_property
    def kinematics(self) -> Kinematics:
        """Forward kinematics."""
        return Kinematics(self._machine, self._device)


@dataclass(frozen=True)
class StepInputs:
    """Everything that an effect may use in one control period.

    Attributes:
        value: Parameters by name, `(N, J)` or `(N, 1)`.
        memory: The memory that the effect returned one period ago.
        history: Positions and commands; the newest command has just come into force.
        plant: Constants of the machine.
        moved: Increment of the inner model, `(N, J)`; speed side only.
        counter: Counter of random draws, `(N,)`; stochastic effects only.
        weight: `plant.weight` of the newest position, where it is computed already.
    """

    value: dict[str, torch.Tensor]
    memory: Memory
    history: History
    plant: MachineTensors
    moved: torch.Tensor
    counter: torch.Tensor | None
    weight: torch.Tensor | None = None

    @property
    def chance(self) -> torch.Tensor:
        """A uniform number in [0, 1) per environment, `(N, 1)`; all joints share one frame."""
        assert self.counter is not None, "only a stochastic effect has chances"
        return draw_uniform(self.counter, CHANCE, 1)
