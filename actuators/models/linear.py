"""Baselines that a learned actuator must beat: a machine that stands still, and a linear model."""

from __future__ import annotations

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view

from actuators.contracts import FitTask
from actuators.models import checkpoint
from actuators.models.joint_model import MemorylessModel
from actuators.models.machine_tensors import MachineTensors
from brokk_rl.errors import CheckpointError, RecordingError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import NonNegative, spec


@spec
class Hold(MemorylessModel):
    """Never moves, `q' = q`: the error that any model must beat. Effects on a drive do nothing to it."""

    @property
    def drive_changes(self) -> dict[str, torch.Tensor]:
        """Nothing of an effect on a drive is kept."""
        return {}

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> Hold:
        """Return itself: there is nothing to build."""
        return self

    def step(self, history: History) -> torch.Tensor:
        """Return the newest position, shape `(N, J)`."""
        return history.q[:, -1].clone()


@spec
class HoldFit:
    """Nothing to learn: the machine stands still.

    Attributes:
        name: Name in tables.
    """

    name: str

    def fit(self, task: FitTask) -> Hold:
        """Return `Hold`."""
        return Hold()


@spec
class Arx:
    """Linear in the last 13 u, |u| u and increments; one row of weights a joint.

    Attributes:
        checkpoint: A file, or the name of one that ships with the package.
    """

    checkpoint: str

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ArxModel:
        """Return the model.

        Raises:
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds
                NaN.
        """
        tensors, _ = checkpoint.read_checkpoint(self.checkpoint, "arx", machine)
        expected = (machine.num_joints, 3 * machine.num_history - 1)
        if "weight" not in tensors or tuple(tensors["weight"].shape) != expected:
            raise CheckpointError(
                f"{self.checkpoint}: expected a tensor 'weight' of shape {expected}"
            )
        return ArxModel(tensors["weight"].to(device), machine, device)


def build_arx_features(u: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return `[u, |u| u, increments]` of histories `u` and `q` `(N, H, J)`, `(N, 3 H - 1, J)`."""
    return torch.cat([u, u.abs() * u, q[:, 1:] - q[:, :-1]], 1)


class ArxModel(MemorylessModel):
    """`q' = q + weight . features`, each joint from its own history.

    Args:
        weight: `(J, F)`.
        machine: The machine.
        device: Where the tensors live.
    """

    def __init__(self, weight: torch.Tensor, machine: Machine, device: torch.device) -> None:
        self._weight, self._plant = weight, MachineTensors(machine, device)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        inputs = build_arx_features(history.u, history.q)
        moved = torch.einsum("nij,ji->nj", inputs, self._weight)
        return self._plant.hold(history.q[:, -1] + moved)


@spec
class ArxFit:
    """Ridge regression of the next increment, joint by joint.

    Attributes:
        name: Name in tables and of the checkpoint.
        ridge: Weight of the penalty, relative to the mean square of the inputs.
    """

    name: str
    ridge: NonNegative

    def fit(self, task: FitTask) -> Arx:
        """Fit to `task.train` and write `<name>.safetensors`.

        Raises:
            RecordingError: too little data.
        """
        machine, size = task.machine, task.machine.num_history
        rows, targets = [], []
        for recording in task.train:
            if recording.num_samples <= size:
                continue
            u, q = recording.u.astype(np.float64), recording.q.astype(np.float64)
            # (T - H, J, H)
            views = [
                sliding_window_view(u, size, 0),
                sliding_window_view(np.abs(u) * u, size, 0),
                sliding_window_view(np.diff(q, axis=0), size - 1, 0),
            ]
            rows.append(np.concatenate([view[:-1] for view in views], 2))
            targets.append(q[size:] - q[size - 1 : -1])
        if not rows:
            raise RecordingError(
                f"too little data: none of {len(task.train)} recordings is longer than the history of {size} samples"
            )
        inputs, target = np.concatenate(rows), np.concatenate(targets)
        weight = np.zeros((machine.num_joints, inputs.shape[2]))
        for j in range(machine.num_joints):
            x = inputs[:, j]
            scale = np.sqrt(np.mean(x**2, 0)) + 1e-9
            gram = (x / scale).T @ (x / scale) / len(x) + self.ridge * np.eye(x.shape[1])
            weight[j] = np.linalg.solve(gram, (x / scale).T @ target[:, j] / len(x)) / scale
        path = task.folder / f"{self.name}.safetensors"
        tensors = {"weight": torch.as_tensor(weight, dtype=torch.float32)}
        checkpoint.write_checkpoint(path, "arx", machine, tensors, {"ridge": self.ridge})
        return Arx(checkpoint=str(path))
