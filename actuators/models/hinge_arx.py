"""Linear baseline that knows dead bands: hinges of past commands and a joint's own increments.

Axes: `N` environments, `J` joints, `H` history (oldest first), `K` hinges a sign.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from actuators.models import checkpoint
from brokk_rl import open_loop
from brokk_rl.errors import CheckpointError, ConfigError, RecordingError
from brokk_rl.history import History
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

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "HingeArxModel":
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
        return HingeArxModel(weight.to(device), knees.to(device), machine, device)


class HingeArxModel:
    """`q' = q + weight . [hinges of u, increments]`, each joint from its own history."""

    def __init__(
        self, weight: torch.Tensor, knees: torch.Tensor, machine: Machine, device: torch.device
    ) -> None:
        self._weight, self._knees = weight, knees
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Do nothing."""

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        inputs = build_hinge_features(history.u, history.q, self._knees)
        moved = torch.einsum("nij,ji->nj", inputs, self._weight)
        return (history.q[:, -1] + moved).clamp(self._lower, self._upper)


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
        grams, products, scales = _accumulate_moments(machine, train, knees)
        path = folder / f"{self.name}.safetensors"
        best, chosen, ridges = np.inf, self.ridges[len(self.ridges) // 2], self.ridges
        longest_s = open_loop.find_longest_horizon_s(validation, machine)
        if longest_s < VALIDATION_S:  # too short to choose by
            _write_weights(
                path, machine, _solve_ridge(grams, products, scales, chosen), knees, chosen
            )
            return HingeArx(checkpoint=str(path))
        cut = open_loop.cut_windows(validation, machine, VALIDATION_S, VALIDATION_STRIDE_S)
        for ridge in ridges:
            _write_weights(
                path, machine, _solve_ridge(grams, products, scales, ridge), knees, ridge
            )
            error = open_loop.roll_out(HingeArx(checkpoint=str(path)), machine, cut, device)
            travel = machine.upper - machine.lower
            loss = float(np.mean(np.square((error - cut.measured)[:, -1] / travel)))
            best, chosen = (loss, ridge) if loss < best else (best, chosen)
        _write_weights(path, machine, _solve_ridge(grams, products, scales, chosen), knees, chosen)
        return HingeArx(checkpoint=str(path))


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


def _write_weights(
    path: Path, machine: Machine, weight: np.ndarray, knees: torch.Tensor, ridge: float
) -> None:
    tensors = {"weight": torch.as_tensor(weight, dtype=torch.float32), "knees": knees}
    checkpoint.write_checkpoint(path, "hinge_arx", machine, tensors, {"ridge": ridge})
