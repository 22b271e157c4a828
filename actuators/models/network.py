"""Actuator networks: one perceptron per joint, all joints computed in one batch.

The paper feeds 13 commands and 13 positions. Here the 13 positions of a joint enter as its newest
position and the 12 increments between them: the same information in another basis, so that the
network sees speeds at full resolution instead of small differences of large numbers, and a relation
learned in one place holds in another unless the data say otherwise.

Axes: `J` joints, `B` batch, `H` history, `K` steps.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import nn

from actuators.models import checkpoint
from actuators.models.joint_model import MemorylessModel
from actuators.models.machine_tensors import MachineTensors
from brokk_rl.errors import CheckpointError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


class JointNetworks(nn.Module):
    """Per joint a perceptron with two hidden ReLU layers to the next increment (paper, III-A).

    The last layer is followed by a dead zone of half width `quiet`: an increment smaller than the
    noise of the measurement is none. A machine at rest therefore stays at rest, however long the
    model runs on its own predictions.

    Args:
        num_joints: Number of joints, `J`.
        num_history: Samples of commands and positions, `H`.
        width: Units a joint in each hidden layer.
        generator: Draws the initial weights.

    Buffers:
        command_scale, increment_scale, position_center, position_scale: normalisation, each `(J,)`;
        `quiet` `(J,)` in rad or m.
    """

    command_scale: torch.Tensor
    increment_scale: torch.Tensor
    position_center: torch.Tensor
    position_scale: torch.Tensor
    quiet: torch.Tensor

    def __init__(
        self,
        num_joints: int,
        num_history: int,
        width: int,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.num_history = num_history
        layers = list(pairwise((2 * num_history, width, width, 1)))
        weight = [_initialise_weights(num_joints, m, n, m, generator) for m, n in layers]
        bias = [_initialise_weights(num_joints, 1, n, m, generator) for m, n in layers]
        self.weight, self.bias = nn.ParameterList(weight), nn.ParameterList(bias)
        for name in ("command_scale", "increment_scale", "position_scale"):
            self.register_buffer(name, torch.ones(num_joints))
        for name in ("position_center", "quiet"):
            self.register_buffer(name, torch.zeros(num_joints))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return normalised increments `(J, B)` before the dead zone, for inputs `(J, B, 2 H)`."""
        hidden = torch.relu(torch.baddbmm(self.bias[0], inputs, self.weight[0]))
        hidden = torch.relu(torch.baddbmm(self.bias[1], hidden, self.weight[1]))
        return torch.baddbmm(self.bias[2], hidden, self.weight[2]).squeeze(2)

    def increment(self, output: torch.Tensor) -> torch.Tensor:
        """Return increments `(J, B)` in rad or m, after the dead zone."""
        quiet = (self.quiet / self.increment_scale)[:, None]
        return (output - output.clamp(-quiet, quiet)) * self.increment_scale[:, None]

    def inputs(self, u: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return normalised inputs `(J, B, 2 H)` for `u` and `q` of shape `(J, B, H)`.

        Commands, then increments, then the newest position.
        """
        commands = u / self.command_scale[:, None, None]
        increments = (q[..., 1:] - q[..., :-1]) / self.increment_scale[:, None, None]
        position = (q[..., -1] - self.position_center[:, None]) / self.position_scale[:, None]
        return torch.cat([commands, increments, position[..., None]], 2)

    def roll_out(
        self, u: torch.Tensor, q: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor
    ) -> torch.Tensor:
        """Run freely on its own predictions.

        Args:
            u: Commands, `(J, B, H - 1 + K)`: the history and the commands of the `K` steps to come.
            q: Position history, `(J, B, H)`.
            lower: Lower end of travel, `(J,)`.
            upper: Upper end of travel, `(J,)`.

        Returns:
            Positions after each of the `K` steps, `(J, B, K)`.
        """
        path = []
        for seen in u.unfold(2, self.num_history, 1).unbind(2):
            moved = self.increment(self(self.inputs(seen, q)))
            at = (q[..., -1] + moved).clamp(lower[:, None], upper[:, None])
            q = torch.cat([q[..., 1:], at[..., None]], 2)
            path.append(at)
        return torch.stack(path, 2)


def _initialise_weights(
    num_joints: int, rows: int, columns: int, fan_in: int, generator: torch.Generator | None
) -> nn.Parameter:
    """Draw weights `(J, rows, columns)` as `torch.nn.Linear` does."""
    drawn = torch.rand(num_joints, rows, columns, generator=generator) * 2.0 - 1.0
    return nn.Parameter(drawn / fan_in**0.5)


@spec
class Mlp:
    """One perceptron a joint, 2 x 32 ReLU, from 13 commands and 13 positions (the paper's model).

    Attributes:
        checkpoint: A file, or the name of one that ships with the package.
    """

    checkpoint: str

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> NetworkModel:
        """Return a model for any number of environments on `device`.

        Raises:
            CheckpointError: the checkpoint is missing, corrupt, made for another machine, or holds
                NaN.
        """
        networks = load_networks(self.checkpoint, machine)
        return NetworkModel(networks.to(device), machine, device)


class NetworkModel(MemorylessModel):
    """Actuator networks at work. Has no memory beyond the history."""

    def __init__(self, networks: JointNetworks, machine: Machine, device: torch.device) -> None:
        self._networks = networks.requires_grad_(False)
        self._plant = MachineTensors(machine, device)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        networks = self._networks
        output = networks(networks.inputs(history.u.permute(2, 0, 1), history.q.permute(2, 0, 1)))
        return self._plant.hold(history.q[:, -1] + networks.increment(output).T)


def load_networks(name: str, machine: Machine) -> JointNetworks:
    """Return the networks of a checkpoint, on the CPU.

    Raises:
        CheckpointError: as for `Mlp.build`.
    """
    tensors, header = checkpoint.read_checkpoint(name, "mlp", machine)
    width = int(header.get("width", 0))
    networks = JointNetworks(machine.num_joints, machine.num_history, width)
    try:
        networks.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(
            f"{name}: the tensors do not fit the network that its header describes ({error})"
        ) from error
    return networks
