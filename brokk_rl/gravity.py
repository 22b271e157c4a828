"""Gravity load on each joint, from masses and geometry; batched, in numpy or torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from brokk_rl.kinematics import LinkChain, LinkPlaces
from brokk_rl.machine import Machine

if TYPE_CHECKING:
    import torch

GRAVITY_M_S2 = 9.81
"""Gravity, m/s²: standard gravity (9.80665), rounded."""


class Gravity:
    """Generalised force of gravity on each joint of a serial machine that stands level.

    Args:
        machine: Axes, origins, masses and centres of mass.
        device: Where tensors (torch, float32) lie; `None` for arrays (numpy, float64).

    Raises:
        ConfigError: Geometry and masses of the machine are not known.
    """

    def __init__(self, machine: Machine, device: torch.device | None = None) -> None:
        bodies = machine.bodies
        self._chain = LinkChain(machine.joints, device)
        self._com_m = self._chain.convert([body.com_m for body in bodies])
        self._mass_kg = self._chain.convert([body.mass_kg.value for body in bodies])
        self._carried_kg = self._sum_inwards(self._mass_kg, -1)

    def load(self, q: Any) -> Any:
        """Return the gravity load in the positive direction at `q`, `(N, J)`, Nm or N."""
        links = self._chain.place(q)
        moments = self._weigh_links(links)
        # mass times place of all that a joint carries
        carried = self._sum_inwards(moments, -2)
        lever = carried - self._carried_kg[:, None] * links.place_m
        # z component of axis x lever arm, times mass
        turning = links.axis[..., 0] * lever[..., 1] - links.axis[..., 1] * lever[..., 0]
        lifting = self._carried_kg * links.axis[..., 2]
        hinge = self._chain.hinge
        return -GRAVITY_M_S2 * (hinge * turning + (1.0 - hinge) * lifting)

    def overturn(self, q: Any) -> Any:
        """Return the moment of the arm's weight about the base frame's origin, `(N, 3)`, Nm."""
        moment = self._weigh_links(self._chain.place(q)).sum(-2)
        x, y = moment[:, 0], moment[:, 1]
        return GRAVITY_M_S2 * self._chain.library.stack((-y, x, 0.0 * x), 1)

    def _sum_inwards(self, values: Any, axis: int) -> Any:
        """Return the sums of all values from each joint to the tool."""
        flip = self._chain.library.flip
        return flip(flip(values, (axis,)).cumsum(axis), (axis,))

    def _weigh_links(self, links: LinkPlaces) -> Any:
        """Return mass times centre of mass of each link in the base frame, `(N, J, 3)`, kg m."""
        com_m = (links.rotation @ self._com_m[:, :, None])[..., 0]
        return self._mass_kg[:, None] * (links.place_m + com_m)
