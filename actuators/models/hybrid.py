"""The measured valve curve with a small learned residual that fades away from its training data.

The curve (`actuators.models.valve`) predicts the step of each joint. An ensemble of boosted trees
adds a residual from the commands and steps of all joints, the joint's own increments and all
positions:

    residual   mean of the members, at most `BOUND` of a full step
    rest       part of a twentieth of full speed that the curve moves: a joint at rest stays at rest
    spread     standard deviation of the members; half the residual is left at the spread's limit
    range      1 inside the range of each input in training, 0 from `MARGIN` of it outside
    step       curve + share * rest * range / (1 + (spread / limit)^2) * residual

Axes: `N` environments, `J` joints, `H` history (oldest first), `M` members, `F` features.
"""

from typing import ClassVar

import torch

from actuators.models import checkpoint
from actuators.models.trees import TENSORS, evaluate_trees
from actuators.models.valve import ValveActuator, ValveModel
from brokk_rl.errors import CheckpointError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

OWN_SAMPLES = 7
"""Commands of the joint itself among its inputs, from a sample before its dead time on back. Chosen
by hand; not searched."""
OTHER_LAGS = (0, 2, 5)
"""Samples before a joint's dead time at which its command is an input of all. Chosen by hand; not
searched."""
SPANS = (2, 4, 12)
"""Increments over which the joint's own speed is averaged. Chosen by hand; not searched."""
BOUND = 0.3
"""Largest residual of a full step. Chosen by hand; not searched."""
MOVING = 0.05
"""Part of full speed from which the residual acts whole. Chosen by hand; not searched."""
MARGIN = 0.1
"""Part of an input's training range outside of it at which the residual is gone. Chosen by hand;
not searched."""
RESIDUAL_TENSORS = (*TENSORS, "low", "high", "limit", "share")
"""Tensors of a checkpoint."""


@spec
class HybridActuator:
    """A valve curve in charge and a learned residual within its training data.

    Attributes:
        curve: The physical model.
        checkpoint: File of the residual; `null`: the curve alone.
    """

    label: ClassVar = "hybrid"

    curve: ValveActuator
    checkpoint: str | None

    def build(
        self, machine: Machine, num_envs: int, device: torch.device
    ) -> "HybridModel | ValveModel":
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: a number of the curve makes no sense.
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds
                NaN.
        """
        curve = self.curve.build(machine, num_envs, device)
        if self.checkpoint is None:
            return curve
        return HybridModel(curve, read_residual(self.checkpoint, machine), machine, device)


def read_residual(name: str, machine: Machine) -> dict[str, torch.Tensor]:
    """Return the tensors of a residual.

    Raises:
        CheckpointError: as for `HybridActuator.build`.
    """
    path = checkpoint.find_checkpoint(name)
    tensors, _ = checkpoint.read_checkpoint(path, "hybrid", machine)
    if lacking := set(RESIDUAL_TENSORS) - set(tensors):
        raise CheckpointError(f"{path}: expected a tensor '{min(lacking)}'")
    joints = machine.num_joints
    columns = len(ResidualInputs(machine, torch.zeros(joints), torch.device("cpu")))
    for key, shape in (
        ("low", (joints, columns)),
        ("high", (joints, columns)),
        ("limit", (joints,)),
        ("share", (joints,)),
    ):
        if tuple(tensors[key].shape) != shape:
            raise CheckpointError(f"{path}: expected a tensor '{key}' of shape {shape}")
    return tensors


class ResidualInputs:
    """Features of the residual; `len` is their number, `F`.

    Args:
        machine: Gives joints, history and travel.
        dead_time_s: Of each joint, `(J,)`.
        device: Where the tensors live.
    """

    def __init__(self, machine: Machine, dead_time_s: torch.Tensor, device: torch.device) -> None:
        size, joints = machine.num_history, machine.num_joints
        back = (dead_time_s.to("cpu") / machine.period_s).round().long()
        lags = torch.arange(OWN_SAMPLES) - 1 + back[:, None]
        self._own = (size - 1 - lags.clamp(0, size - 1)).T.to(device)  # (OWN_SAMPLES, J)
        lags = torch.tensor(OTHER_LAGS) + back[:, None]
        self._others = (size - 1 - lags.clamp(0, size - 1)).T.to(device)
        self._spans = [min(span, size - 1) for span in SPANS]
        self._lower, self._travel, self._full_step = (
            torch.as_tensor(values, dtype=torch.float32, device=device)
            for values in (
                machine.lower, machine.upper - machine.lower, machine.max_speed * machine.period_s
            )
        )  # fmt: skip
        self._length = OWN_SAMPLES + len(SPANS) + 1 + (len(OTHER_LAGS) + 2) * joints

    def __len__(self) -> int:
        return self._length

    def build(self, u: torch.Tensor, q: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Return the features `(J, N, F)`.

        First the joint's own commands, mean increments and step of the curve; then commands, steps
        and places of all joints.

        Args:
            u: Commands, `(N, H, J)`.
            q: Positions, `(N, H, J)`.
            step: Step of the curve in full steps, `(N, J)`.
        """
        count = len(u)
        newest = q[:, -1]
        speeds = []
        for span in self._spans:
            speeds.append((newest - q[:, -1 - span]) / (span * self._full_step))
        own = torch.cat(
            [u.gather(1, self._own.expand(count, -1, -1)), torch.stack([*speeds, step], 1)], 1
        ).permute(2, 0, 1)
        others = torch.cat(
            [
                u.gather(1, self._others.expand(count, -1, -1)).flatten(1),
                step,
                (newest - self._lower) / self._travel,
            ],
            1,
        )
        return torch.cat([own, others.expand(len(own), -1, -1)], 2)


class HybridModel:
    """The curve and its residual at work in `N` environments; see the module for its equations."""

    def __init__(
        self,
        curve: ValveModel,
        tensors: dict[str, torch.Tensor],
        machine: Machine,
        device: torch.device,
    ) -> None:
        self._curve = curve
        self._tensors = {name: value.to(device) for name, value in tensors.items()}
        self._lower, self._upper, self._full_step = (
            torch.as_tensor(values, dtype=torch.float32, device=device)
            for values in (machine.lower, machine.upper, machine.max_speed * machine.period_s)
        )
        self._inputs = ResidualInputs(machine, curve.parameters["dead_time_s"][0], device)
        self._spread = torch.zeros_like(curve.state["step"])

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """That of the curve, and `spread` of the ensemble in full steps, `(N, J)`."""
        return {**self._curve.state, "spread": self._spread}

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history."""
        self._curve.reset(mask)
        self._spread.masked_fill_(mask[:, None], 0.0)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        moved = self._curve.step(history)
        step = self._curve.state["step"] / self._full_step
        inputs = self._inputs.build(history.u, history.q, step)
        residual, spread = compute_residual(inputs, step, self._tensors)
        self._spread.copy_(spread)
        moved = moved + residual * self._full_step
        q = history.q[:, -1]
        return torch.minimum(
            torch.maximum(moved, torch.minimum(self._lower, q)), torch.maximum(self._upper, q)
        )


def compute_residual(
    inputs: torch.Tensor, step: torch.Tensor, tensors: dict[str, torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return residual and spread of the ensemble in full steps, each `(N, J)`.

    Args:
        inputs: Features, `(J, N, F)`.
        step: Step of the curve in full steps, `(N, J)`.
        tensors: `RESIDUAL_TENSORS`; trees of all members with `offset` `(M, J)`, `feature` and
            `threshold` `(M, J, E, 2^D - 1)`, `leaf` `(M, J, E, 2^D)`.
    """
    members = []
    for m in range(len(tensors["offset"])):
        members.append(evaluate_trees(inputs, *(tensors[name][m] for name in TENSORS)))
    each = torch.stack(members)
    mean, spread = each.mean(0).clamp(-BOUND, BOUND), each.std(0, unbiased=False)
    low, high = tensors["low"][:, None], tensors["high"][:, None]
    outside = torch.maximum(low - inputs, inputs - high) / (high - low).clamp(min=1e-6)
    within = (1.0 - outside.amax(2) / MARGIN).clamp(0.0, 1.0).T
    agreed = 1.0 / (1.0 + (spread / tensors["limit"]).square())
    moving = (step.abs() / MOVING).clamp(max=1.0)
    return tensors["share"] * moving * within * agreed * mean, spread
