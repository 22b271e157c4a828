"""A person at the levers of one simulated machine."""

from __future__ import annotations

import torch

from brokk_rl.contracts.actuator import FollowerModel
from brokk_rl.machine import Machine, mask_exclusive_joints

KEY_STEP = 0.25
"""Stroke by which one press of a key moves a lever. Chosen by hand: four presses to full speed."""


class PersonAtLevers(FollowerModel):
    """Follower that gives a person's commands in one environment and the policy's in the others.

    Levers stay where they were put until they are released.

    Args:
        inner: Follower of the other environments.
        machine: The machine.

    Attributes:
        env: Environment that the person drives; `None` for none.
        levers: Positions of the levers, `(J,)` in [-1, 1].
        proposed: Last commands that the policy proposed, `(N, J)`.
    """

    def __init__(self, inner: FollowerModel, machine: Machine) -> None:
        self._inner = inner
        self._is_exclusive = torch.as_tensor(machine.is_exclusive)
        self.env: int | None = None
        self.levers = torch.zeros(machine.num_joints)
        self.proposed: torch.Tensor | None = None

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """State of the follower inside."""
        return self._inner.state

    def reset(self, mask: torch.Tensor) -> None:
        """Reset the follower inside; the person's levers stay."""
        self._inner.reset(mask)

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return the commands that are given, `(N, J)`, for those proposed."""
        self.proposed = proposed
        given = self._inner.step(proposed)
        if self.env is None:
            return given
        given = given.clone()
        given[self.env] = self.read_command().to(given.device)
        return given

    def read_command(self) -> torch.Tensor:
        """Return the person's command, `(J,)`: a lever of an exclusive joint rules out the others."""
        positioning = bool(self.levers[self._is_exclusive].any())
        return self.levers * mask_exclusive_joints(self._is_exclusive, positioning)
