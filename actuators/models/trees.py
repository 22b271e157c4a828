"""Gradient-boosted trees as tensors: the strongest baseline without physics.

Trees are complete and of one depth, so that a step is the same few gathers for all environments.
A node sends values above its threshold to the right.

Axes: `N` environments, `J` joints, `H` history (oldest first), `E` trees a joint, `D` depth, `F`
features.
"""

import torch

from actuators.models import checkpoint
from brokk_rl.errors import CheckpointError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

TENSORS = ("feature", "threshold", "leaf", "offset")
"""Tensors of a checkpoint."""
OTHER_LAGS = (1, 3, 6)
"""Samples back at which the commands of all joints are features. Chosen by hand; not searched."""


@spec
class BoostedTrees:
    """Gradient-boosted trees a joint, from its history, all commands and all positions.

    Attributes:
        checkpoint: A file.
    """

    checkpoint: str

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "BoostedTreesModel":
        """Return the model.

        Raises:
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds
                NaN.
        """
        path = checkpoint.find_checkpoint(self.checkpoint)
        tensors, _ = checkpoint.read_checkpoint(path, "boosting", machine)
        if lacking := set(TENSORS) - set(tensors):
            raise CheckpointError(f"{path}: expected a tensor '{min(lacking)}'")
        sizes = {name: tuple(tensors[name].shape) for name in TENSORS}
        joints, trees, nodes = sizes["feature"]
        expected = {
            "feature": (machine.num_joints, trees, nodes),
            "threshold": (joints, trees, nodes),
            "leaf": (joints, trees, nodes + 1),
            "offset": (joints,),
        }
        if sizes != expected:
            raise CheckpointError(f"{path}: expected tensors of shapes {expected}, got {sizes}")
        return BoostedTreesModel(tensors, machine, device)


class BoostedTreesModel:
    """`q' = q + sum of trees`, each joint with trees of its own."""

    def __init__(
        self, tensors: dict[str, torch.Tensor], machine: Machine, device: torch.device
    ) -> None:
        self._forest = {name: tensors[name].to(device) for name in TENSORS}
        self._forest["feature"] = self._forest["feature"].long()
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)
        self._full_step = torch.as_tensor(
            machine.max_speed * machine.period_s, dtype=torch.float32, device=device
        )

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Do nothing."""

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        place = (history.q[:, -1] - self._lower) / (self._upper - self._lower)
        features = build_tree_features(history.u, history.q / self._full_step, place)
        moved = evaluate_trees(features, **self._forest) * self._full_step
        return (history.q[:, -1] + moved).clamp(self._lower, self._upper)


def build_tree_features(u: torch.Tensor, q: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Return the features of each joint, `(J, N, F)`.

    In this order: the joint's commands and increments, the commands of all joints `OTHER_LAGS`
    samples back, and the places of all joints.

    Args:
        u: Commands, `(N, H, J)`.
        q: Positions in full steps of each joint, `(N, H, J)`.
        place: Newest positions from 0 to 1 over the travel, `(N, J)`.
    """
    own = torch.cat([u, q[:, 1:] - q[:, :-1]], 1).permute(2, 0, 1)
    lags = [min(lag, u.shape[1] - 1) for lag in OTHER_LAGS]
    others = torch.cat([*(u[:, -1 - lag] for lag in lags), place], 1)
    return torch.cat([own, others.expand(len(own), -1, -1)], 2)


def evaluate_trees(
    features: torch.Tensor,
    feature: torch.Tensor,
    threshold: torch.Tensor,
    leaf: torch.Tensor,
    offset: torch.Tensor,
) -> torch.Tensor:
    """Return the sums of trees, `(N, J)`, at features `(J, N, F)`.

    Args:
        features: The inputs.
        feature: Index of each inner node's feature, `(J, E, 2^D - 1)`, level by level.
        threshold: Of each inner node, `(J, E, 2^D - 1)`.
        leaf: Values of the leaves from left to right, `(J, E, 2^D)`.
        offset: Value without trees, `(J,)`.
    """
    joints, trees, leaves = leaf.shape
    count = features.shape[1]
    feature = feature.long()
    node = torch.zeros((joints, trees, count), dtype=torch.int64, device=features.device)
    values = features.transpose(1, 2)  # (J, F, N)
    for _ in range((leaves - 1).bit_length()):
        seen = values.gather(1, feature.gather(2, node))
        node = 2 * node + 1 + (seen > threshold.gather(2, node)).long()
    return (leaf.gather(2, node - (leaves - 1)).sum(1) + offset[:, None]).T
