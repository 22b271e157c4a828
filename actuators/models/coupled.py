"""Networks that know of each other: a network a joint, one pump for all, and loads that depend on the pose of all joints."""

import torch

from actuators.models.mlp import NetworkModel, load
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Coupled:
    """A perceptron a joint, slowed down where joints ask for more than the pump gives and by the load of the pose (`mlp`: neither).

    Attributes:
        checkpoint: A file, or the name of one that ships with the package.
    """

    checkpoint: str

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> NetworkModel:
        """Returns a model for any number of environments on `device`.

        Raises:
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds
                NaN.
        """
        return NetworkModel(load(self.checkpoint, "coupled", machine).to(device), machine, device)
