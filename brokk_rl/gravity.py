"""Gravity load on each joint, from masses and geometry; batched, in torch."""

import torch

from brokk_rl.machine import Machine

GRAVITY_M_S2 = 9.81
"""Gravity, m/s²: standard gravity (9.80665), rounded."""


class Gravity:
    """Generalised force of gravity on each joint of a serial machine that stands level.

    Args:
        machine: Axes, origins, masses and centres of mass.
        device: Where to compute.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        def tensor(rows: list) -> torch.Tensor:
            return torch.tensor(rows, dtype=torch.float32, device=device)

        bodies = machine.bodies
        self._axis = tensor([body.axis for body in bodies])
        self._origin_m = tensor([[d.value for d in body.origin_m] for body in bodies])
        self._com_m = tensor([body.com_m for body in bodies])
        self._mass_kg = tensor([body.mass_kg.value for body in bodies])
        self._hinge = tensor([float(joint.kind == "hinge") for joint in machine.joints])
        self._carried_kg = self._mass_kg.flip(0).cumsum(0).flip(0)
        x, y, z = self._axis.unbind(1)
        zero = torch.zeros_like(x)
        self._cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
        self._cross_twice = self._cross @ self._cross
        self._eye = torch.eye(3, device=device)

    def load(self, q: torch.Tensor) -> torch.Tensor:
        """Return the gravity load in the positive direction at `q`, `(N, J)`, Nm or N."""
        axis, origin_m, moments = self._place(q)
        carried = moments.flip(1).cumsum(1).flip(1) - self._carried_kg[:, None] * origin_m
        turning = (
            axis[..., 0] * carried[..., 1] - axis[..., 1] * carried[..., 0]
        )  # z of axis x lever arm, times mass
        lifting = self._carried_kg * axis[..., 2]
        return -GRAVITY_M_S2 * (self._hinge * turning + (1.0 - self._hinge) * lifting)

    def overturn(self, q: torch.Tensor) -> torch.Tensor:
        """Return the moment of the arm's weight about the base frame's origin, `(N, 3)`, Nm."""
        moment = self._place(q)[2].sum(1)
        x, y = moment[:, 0], moment[:, 1]
        return GRAVITY_M_S2 * torch.stack((-y, x, torch.zeros_like(x)), 1)

    def _place(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return joint axes, joint origins (m), and mass times place of each body (kg m).

        Each `(N, J, 3)`, in the base frame.
        """
        angle = (q * self._hinge)[..., None, None]
        turn = (
            self._eye + angle.sin() * self._cross + (1.0 - angle.cos()) * self._cross_twice
        )  # Rodrigues
        slide = (q * (1.0 - self._hinge))[..., None] * self._axis
        rotation, at_m = self._eye.expand(q.shape[0], 3, 3), q.new_zeros(q.shape[0], 3)
        origins, axes, moments = [], [], []
        for j in range(q.shape[1]):
            axes.append(rotation @ self._axis[j])
            at_m = at_m + (rotation @ (self._origin_m[j] + slide[:, j])[..., None]).squeeze(-1)
            rotation = rotation @ turn[:, j]
            origins.append(at_m)
            moments.append(self._mass_kg[j] * (at_m + rotation @ self._com_m[j]))
        return torch.stack(axes, 1), torch.stack(origins, 1), torch.stack(moments, 1)
