"""Linear baseline that knows dead bands: hinges of past commands and a joint's own increments.

Axes: `N` environments, `J` joints, `H` history (oldest first), `K` hinges a sign.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from actuators import open_loop
from actuators.models import checkpoint
from actuators.models.linear import ArxModel
from brokk_rl.errors import CheckpointError, ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import spec

VALIDATION_S = 5.0
"""Horizon of the free runs that choose the penalty: the headline horizon of the verdict."""
VALIDATION_STRIDE_S = 2.0
"""Distance between them, s. Chosen by hand; not searched."""


@spec
class HingeArx:
    """Linear in hinges of the last commands of a joint and in its last increments.

    Attributes:
        checkpoint: A file.
    """

    checkpoint: str

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ArxModel:
        """Return the model.

        Raises:
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds
                NaN.
        """
        path = checkpoint.find_checkpoint(self.checkpoint)
        tensors, _ = checkpoint.read_checkpoint(path, "hinge_arx", machine)
        if "weight" not in tensors or "knees" not in tensors:
            raise CheckpointError(f"{path}: expected tensors 'weight' and 'knees'")
        weight, knees = tensors["weight"], tensors["knees"]
        columns = (2 * knees.numel() + 1) * machine.num_history - 1
        if tuple(weight.shape) != (machine.num_joints, columns):
            raise CheckpointError(
                f"{path}: expected a tensor 'weight' of shape {(machine.num_joints, columns)}"
            )
        build_features = partial(build_hinge_features, knees=knees.to(device))
        return ArxModel(weight.to(device), build_features, machine, device)


def build_hinge_features(u: torch.Tensor, q: torch.Tensor, knees: torch.Tensor) -> torch.Tensor:
    """Return the features of histories `u` and `q` `(N, H, J)`, `(N, (2 K + 1) H - 1, J)`.

    First `max(u - knee, 0)` of each knee, then `max(-u - knee, 0)`, each over the history; then
    the increments. Their sum is any curve of the command that is straight between the knees.
    """
    hinges = []
    for sign in (1.0, -1.0):
        for knee in knees:
            hinges.append(torch.relu(sign * u - knee))
    return torch.cat([*hinges, q[:, 1:] - q[:, :-1]], 1)


@spec
class HingeArxFit:
    """Ridge regression of the next increment on hinges of the command, joint by joint.

    Attributes:
        name: Name in tables and of the checkpoint.
        knees: Commands at which a hinge begins, each way.
        ridges: Penalties relative to the mean square of the inputs; free runs through the
            validation recordings choose one.
    """

    name: str
    knees: tuple[float, ...]
    ridges: tuple[float, ...]

    def check(self) -> None:
        if not self.knees or min(self.knees) < 0 or max(self.knees) >= 1:
            raise ConfigError(
                f"fit.knees: expected commands from 0 to below 1, got {list(self.knees)}"
            )
        if not self.ridges or min(self.ridges) <= 0:
            raise ConfigError(f"fit.ridges: expected numbers above 0, got {list(self.ridges)}")

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> HingeArx:
        """Fit to `train`, choose the penalty by `validation`, write `<name>.safetensors`.

        Raises:
            RecordingError: too little data.
        """
        knees = torch.tensor(self.knees)
        moments = _accumulate_moments(machine, train, knees)
        path = folder / f"{self.name}.safetensors"

        def write(ridge: float) -> HingeArx:
            weight = torch.as_tensor(_solve_ridge(*moments, ridge), dtype=torch.float32)
            tensors = {"weight": weight, "knees": knees}
            checkpoint.write_checkpoint(path, "hinge_arx", machine, tensors, {"ridge": ridge})
            return HingeArx(checkpoint=str(path))

        if open_loop.find_longest_horizon_s(validation, machine) < VALIDATION_S:
            return write(self.ridges[len(self.ridges) // 2])  # too short to choose by
        cut = open_loop.cut_windows(validation, machine, VALIDATION_S, VALIDATION_STRIDE_S)
        travel, losses = machine.upper - machine.lower, []
        for ridge in self.ridges:
            error = open_loop.roll_out(write(ridge), machine, cut, device) - cut.measured
            losses.append(float(np.mean(np.square(error[:, -1] / travel))))
        # a fit that ran away has no finite loss
        return write(self.ridges[int(np.argmin(np.nan_to_num(losses, nan=np.inf)))])


def _accumulate_moments(
    machine: Machine, recordings: Sequence[Recording], knees: torch.Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Gram matrices `(J, F, F)`, products with the target `(J, F)` and scales `(J, F)`."""
    size, joints = machine.num_history, machine.num_joints
    features = (2 * len(knees) + 1) * size - 1
    gram, product, count = np.zeros((joints, features, features)), np.zeros((joints, features)), 0
    for recording in recordings:
        if recording.num_samples <= size:
            continue
        u, q = (torch.as_tensor(x, dtype=torch.float64) for x in (recording.u, recording.q))
        seen = [x.unfold(0, size, 1)[:-1].transpose(1, 2) for x in (u, q)]
        inputs = build_hinge_features(seen[0], seen[1], knees.double()).permute(2, 0, 1).numpy()
        target = (q[size:] - q[size - 1 : -1]).T.numpy()
        gram += inputs.transpose(0, 2, 1) @ inputs
        product += (inputs.transpose(0, 2, 1) @ target[..., None])[..., 0]
        count += target.shape[1]
    if not count:
        raise RecordingError(
            f"too little data: none of {len(recordings)} recordings is longer than the history of {size} samples"
        )
    scale = np.sqrt(np.einsum("jff->jf", gram) / count) + 1e-9
    return (gram / count / scale[:, :, None] / scale[:, None, :], product / count / scale, scale)


def _solve_ridge(
    gram: np.ndarray, product: np.ndarray, scale: np.ndarray, ridge: float
) -> np.ndarray:
    """Return the weights of each joint, `(J, F)`."""
    penalised = gram + ridge * np.eye(gram.shape[1])
    return np.linalg.solve(penalised, product[..., None])[..., 0] / scale
