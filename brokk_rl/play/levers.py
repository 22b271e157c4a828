"""A person at the levers of one simulated machine: keys or a gamepad."""

from __future__ import annotations

import torch

from brokk_rl.contracts.actuator import FollowerModel
from brokk_rl.gamepad import Gamepad
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


class GamepadLevers:
    """Levers of all joints on a gamepad.

    Args:
        gamepad: The gamepad; this closes it.
        axes: Axis of the gamepad for each joint, in machine order, as in `Gamepad.read_axes`.
    """

    def __init__(self, gamepad: Gamepad, axes: tuple[int, ...]) -> None:
        self._gamepad, self._axes = gamepad, axes

    def read(self) -> torch.Tensor | None:
        """Return positions of the levers, `(J,)`; `None` where no axis has moved since."""
        return torch.tensor(self._gamepad.read_axes(self._axes)) if self._gamepad.poll() else None

    def close(self) -> None:
        """Close the device."""
        self._gamepad.close()
