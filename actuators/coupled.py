"""One network for all joints: each sees commands and motion of all, and so learns how they share the pump and load each other."""

import torch

from actuators.mlp import NetworkModel, load
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Coupled:
    """Perceptrons whose first layer sees all joints: learns pump sharing and loads that depend on the pose, which `mlp` cannot.

    Attributes:
        checkpoint: A file, or the name of one that ships with the package.
    """

    checkpoint: str

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> NetworkModel:
        """Returns a model for any number of environments on `device`.

        Raises:
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds NaN.
        """
        return NetworkModel(load(self.checkpoint, "coupled", machine).to(device), machine, device)
