"""The paper's actuator model: a small perceptron a joint predicts the next increment from 650 ms of commands and positions."""

import torch

from actuators.models import checkpoint
from actuators.models.network import JointNetworks
from brokk_rl.errors import CheckpointError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Mlp:
    """One perceptron a joint, 2 x 32 ReLU, from 13 commands and 13 positions to the next increment (the paper's model).

    Attributes:
        checkpoint: A file, or the name of one that ships with the package.
    """

    checkpoint: str

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "NetworkModel":
        """Returns a model for any number of environments on `device`.

        Raises:
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds
                NaN.
        """
        return NetworkModel(load(self.checkpoint, "mlp", machine).to(device), machine, device)


class NetworkModel:
    """Actuator networks at work, separate or coupled. Has no memory beyond the history."""

    def __init__(self, networks: JointNetworks, machine: Machine, device: torch.device) -> None:
        self._networks = networks.requires_grad_(False)
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Does nothing."""

    def step(self, history: History) -> torch.Tensor:
        """Returns the joint positions one control period later, shape `(N, J)`."""
        networks = self._networks
        output = networks(networks.inputs(history.u.permute(2, 0, 1), history.q.permute(2, 0, 1)))
        return (history.q[:, -1] + networks.increment(output).T).clamp(self._lower, self._upper)


def load(name: str, kind: str, machine: Machine) -> JointNetworks:
    """Returns the networks of a checkpoint, on the CPU; `kind` is `mlp` (separate) or `coupled`.

    Raises:
        CheckpointError: as for `Mlp.build`.
    """
    path = checkpoint.found(name)
    tensors, header = checkpoint.read(path, kind, machine)
    networks = JointNetworks(
        machine.num_joints,
        machine.num_history,
        int(header.get("width", 0)),
        coupled=kind == "coupled",
    )
    try:
        networks.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(
            f"{path}: the tensors do not fit the network that its header describes ({error})"
        ) from error
    return networks
