"""Geometry of the plants: weight of the arm, and its tool point.

All arrays begin with `N` runs. Each run has a base that may stand tilted and links that may differ
from the drawing.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.kinematics import GRAVITY_M_S2, LinkChain, rotate_about_axis
from brokk_rl.machine import Machine
from exam.plants.changes import PlantParameters


class Arm:
    """Weight and tool of a serial machine.

    Args:
        machine: Axes, origins, masses.
        numbers: `extra_m`, `roll_rad`, `pitch_rad`, `(N, J)`; the tilt of a base is that of the
            first column.
    """

    def __init__(self, machine: Machine, numbers: PlantParameters) -> None:
        bodies = machine.bodies
        self._chain = LinkChain(machine.joints)
        self._mass_kg = np.array([body.mass_kg.value for body in bodies])[:, None]
        self._com_m = np.array([body.com_m for body in bodies])[:, :, None]
        self._yield = np.array([body.yield_force.value for body in bodies])
        origins_m = [[dimension.value for dimension in body.origin_m] for body in bodies]
        drawn_m = np.array([*origins_m, machine.tip_m])
        # link j reaches from joint j to the next one, or to the tip
        length_m = np.maximum(np.linalg.norm(drawn_m[1:], axis=1), 1e-9)
        longer = 1.0 + numbers["extra_m"] / length_m
        longer = np.concatenate([np.ones((len(longer), 1)), longer], 1)
        self._reach_m = (drawn_m * longer[..., None])[..., None]
        pitch, roll = numbers["pitch_rad"][:, 0], numbers["roll_rad"][:, 0]
        pitched = rotate_about_axis(np.array([0.0, 1.0, 0.0]), pitch)
        self._base = pitched @ rotate_about_axis(np.array([1.0, 0.0, 0.0]), roll)
        self._down = self._base.transpose(0, 2, 1) @ np.array([0.0, 0.0, -GRAVITY_M_S2])

    def load(self, q: np.ndarray) -> np.ndarray:
        """Return the weight on each joint over its yield force, positive along the joint, `(N, J)`."""
        rotation, at_m, axes = self._place(q)
        centre_m = at_m + (rotation @ self._com_m)[..., 0]
        carried_kg = _sum_to_tip(np.broadcast_to(self._mass_kg, centre_m.shape))
        lever = _sum_to_tip(self._mass_kg * centre_m) - carried_kg * at_m
        down = self._down[:, None]
        is_hinge = self._chain.hinge[:, None] > 0
        push = np.where(is_hinge, np.cross(lever, down), carried_kg * down)
        return (axes * push).sum(-1) / self._yield

    def tool(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the measured tip, `(N, 3)` m, and its angle below the horizontal, `(N,)`."""
        rotation, at_m, _ = self._place(q)
        along = rotation[:, -1] @ self._reach_m[:, -1]
        tip_m = (self._base @ (at_m[:, -1, :, None] + along))[..., 0]
        along = (self._base @ along)[..., 0]
        heading = np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], 1)
        return tip_m, np.arctan2(-along[:, 2], (along[:, :2] * heading).sum(1))

    def _place(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rotation of each link, origin and axis of each joint, in the base frame."""
        rotation, _, axes = self._chain.place(q)
        before = np.roll(rotation, 1, axis=1)
        before[:, 0] = np.eye(3)
        slide_m = (q * (1.0 - self._chain.hinge))[..., None] * axes
        steps_m = (before @ self._reach_m[:, :-1])[..., 0] + slide_m
        return rotation, np.cumsum(steps_m, axis=1), axes


def _sum_to_tip(values: np.ndarray) -> np.ndarray:
    """Return the sum over each link and all behind it, the links on the second axis."""
    return np.flip(np.cumsum(np.flip(values, 1), 1), 1)
