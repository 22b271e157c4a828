"""The paper's actuator network, one per joint, all joints computed as one.

The paper feeds 13 commands and 13 positions. Here the 13 positions of a joint enter as its newest position and the 12 increments
between them: the same information in another basis, so that the network sees speeds at full resolution instead of small
differences of large numbers, and what it learns in one place holds in another unless the data say otherwise.
"""

from itertools import pairwise

import torch
from torch import nn


class JointNetworks(nn.Module):
    """For each joint a perceptron with two hidden ReLU layers, from `2 H` inputs to the next increment (paper, section III-A).

    The last layer is followed by a dead zone of half width `quiet`: an increment smaller than the noise of the measurement is none.
    A machine at rest therefore stays at rest, however long the model runs on its own predictions.

    Args:
        num_joints: Number of joints, `J`.
        num_history: Samples of commands and positions, `H`.
        width: Units in each hidden layer.
        generator: Draws the initial weights.

    Buffers:
        command_scale, increment_scale, position_center, position_scale: normalisation, each `(J,)`; `quiet` `(J,)` in rad or m.
    """

    command_scale: torch.Tensor
    increment_scale: torch.Tensor
    position_center: torch.Tensor
    position_scale: torch.Tensor
    quiet: torch.Tensor

    def __init__(self, num_joints: int, num_history: int, width: int, generator: torch.Generator | None = None) -> None:
        super().__init__()

        def uniform(*shape: int, fan_in: int) -> nn.Parameter:
            values = torch.rand(num_joints, *shape, generator=generator) * 2.0 - 1.0
            return nn.Parameter(values / fan_in**0.5)  # as torch.nn.Linear draws them

        sizes = (2 * num_history, width, width, 1)
        self.num_history, self.width = num_history, width
        self.weight = nn.ParameterList([uniform(m, n, fan_in=m) for m, n in pairwise(sizes)])
        self.bias = nn.ParameterList([uniform(1, n, fan_in=m) for m, n in pairwise(sizes)])
        for name in ("command_scale", "increment_scale", "position_center", "position_scale", "quiet"):
            self.register_buffer(name, torch.zeros(num_joints) if name in ("position_center", "quiet") else torch.ones(num_joints))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Returns normalised increments `(J, B)` before the dead zone, for normalised inputs `(J, B, 2 H)`."""
        hidden = torch.relu(torch.baddbmm(self.bias[0], inputs, self.weight[0]))
        return self.head(hidden)

    def head(self, hidden: torch.Tensor) -> torch.Tensor:
        """Returns normalised increments `(J, B)` before the dead zone, from the first hidden layer `(J, B, width)`."""
        hidden = torch.relu(torch.baddbmm(self.bias[1], hidden, self.weight[1]))
        return torch.baddbmm(self.bias[2], hidden, self.weight[2]).squeeze(2)

    def increment(self, output: torch.Tensor) -> torch.Tensor:
        """Returns increments `(J, B)` in rad or m, after the dead zone, for the network's output `(J, B)`."""
        physical = output * self.increment_scale[:, None]
        quiet = self.quiet[:, None]
        return torch.relu(physical - quiet) - torch.relu(-physical - quiet)

    def inputs(self, u: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Returns normalised inputs `(J, B, 2 H)`: commands, increments, newest position, for `u` and `q` of shape `(J, B, H)`."""
        commands = u / self.command_scale[:, None, None]
        increments = (q[..., 1:] - q[..., :-1]) / self.increment_scale[:, None, None]
        return torch.cat([commands, increments, self.position(q[..., -1:])], 2)

    def position(self, q: torch.Tensor) -> torch.Tensor:
        """Returns normalised positions, `(J, B, 1)`."""
        return (q - self.position_center[:, None, None]) / self.position_scale[:, None, None]

    def roll_out(self, u: torch.Tensor, q: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
        """Runs freely on its own predictions.

        The part of the first layer that sees commands is computed for all steps at once.

        Args:
            u: Commands, `(J, B, H - 1 + K)`: the history and the commands of the `K` steps to come.
            q: Position history, `(J, B, H)`.
            lower: Lower end of travel, `(J,)`.
            upper: Upper end of travel, `(J,)`.

        Returns:
            Positions after each of the `K` steps, `(J, B, K)`.
        """
        num_joints, batch, _ = q.shape
        size = self.num_history
        seen = (u / self.command_scale[:, None, None]).unfold(2, size, 1)  # (J, B, K, H)
        steps = seen.shape[2]
        from_commands = torch.bmm(seen.reshape(num_joints, batch * steps, size), self.weight[0][:, :size])
        from_commands = (from_commands + self.bias[0]).view(num_joints, batch, steps, self.width).unbind(2)
        of_state = self.weight[0][:, size:]
        increments = (q[..., 1:] - q[..., :-1]) / self.increment_scale[:, None, None]
        at, path = q[..., -1], []
        for k in range(steps):
            state = torch.cat([increments, self.position(at[..., None])], 2)
            hidden = torch.relu(torch.baddbmm(from_commands[k], state, of_state))
            moved = self.increment(self.head(hidden))
            at = torch.minimum(torch.maximum(at + moved, lower[:, None]), upper[:, None])
            increments = torch.cat([increments[..., 1:], (moved / self.increment_scale[:, None])[..., None]], 2)
            path.append(at)
        return torch.stack(path, 2)
