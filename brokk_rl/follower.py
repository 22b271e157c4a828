"""The neutral follower: the given command equals the proposed command.

On the machine a person reads the proposed lever positions and moves the levers, late and
imperfectly; such a follower is one of `conf/follower`. This is the neutral one, of which every
other is a departure.
"""

from __future__ import annotations

from typing import ClassVar

import torch

from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class NoFollower:
    """No person in between: the policy's command is given unchanged and at once."""

    label: ClassVar = "nobody"

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> NoFollowerModel:
        """Return the follower that changes nothing; see `brokk_rl.contracts.actuator.Follower`."""
        return NoFollowerModel()


class NoFollowerModel:
    """Gives the proposed command."""

    def __init__(self) -> None:
        self.state: dict[str, torch.Tensor] = {}

    def reset(self, mask: torch.Tensor) -> None:
        """Have no memory."""

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return `proposed`, `(N, J)`."""
        return proposed


def select_levers(priority: torch.Tensor, most: torch.Tensor | int) -> torch.Tensor:
    """Return the levers that are moved, `(N, J)` bool: the `most` of highest `priority`.

    Args:
        priority: Priority of each lever, `(N, J)`; of equal ones the first counts.
        most: Number of levers, one for all environments or `(N, 1)`.
    """
    mine, others = priority[:, :, None], priority[:, None, :]
    order = torch.arange(priority.shape[1], device=priority.device)
    before = (others > mine) | ((others == mine) & (order < order[:, None]))
    return before.sum(2) < most
