"""Geometry of the plants: weight of the arm, and its tool point.

All arrays begin with `N` runs. Each run has a base that may stand tilted and links that may differ
from the drawing.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Body, Machine
from exam.plants.changes import PlantParameters

GRAVITY_M_S2 = 9.81
"""Gravity, m/s²: standard gravity (9.80665), rounded."""


class Arm:
    """Weight and tool of a serial machine.

    Args:
        machine: Axes, origins, masses.
        numbers: `extra_m`, `roll_rad`, `pitch_rad`, `(N, J)`; the tilt of a base is that of the
            first column.
    """

    def __init__(self, machine: Machine, numbers: PlantParameters) -> None:
        self._axes = [np.array(body.axis) for body in machine.bodies]
        self._hinge = [joint.kind == "hinge" for joint in machine.joints]
        self._mass_kg = [body.mass_kg.value for body in machine.bodies]
        self._com_m = [np.array(body.com_m) for body in machine.bodies]
        self._yield = np.array([body.yield_force.value for body in machine.bodies])
        drawn = [_read_origin(body) for body in machine.bodies] + [machine.tip_m]
        # link j reaches from joint j to the next one, or to the tip
        self._reach_m = [drawn[0][None]]
        for j, link_m in enumerate(drawn[1:]):
            length_m = max(float(np.linalg.norm(link_m)), 1e-9)
            self._reach_m.append(link_m * (1.0 + numbers["extra_m"][:, j, None] / length_m))
        self._base = _rotate(np.array([0.0, 1.0, 0.0]), numbers["pitch_rad"][:, 0]) @ _rotate(
            np.array([1.0, 0.0, 0.0]), numbers["roll_rad"][:, 0]
        )
        self._down = self._base.transpose(0, 2, 1) @ np.array([0.0, 0.0, -GRAVITY_M_S2])

    def load(self, q: np.ndarray) -> np.ndarray:
        """Return the weight on each joint over its yield force, positive along the joint, `(N, J)`."""
        at_m, axes, _ = self._chain(q)
        weight = np.zeros_like(q)
        for k, com_m in enumerate(self._centres):
            force = self._mass_kg[k] * self._down
            for j in range(k + 1):
                push = np.cross(com_m - at_m[j], force) if self._hinge[j] else force
                weight[:, j] += (axes[j] * push).sum(1)
        return weight / self._yield

    def tool(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the measured tip, `(N, 3)` m, and its angle below the horizontal, `(N,)`."""
        at_m, _, tip_m = self._chain(q)
        tip_m = (self._base @ tip_m[..., None])[..., 0]
        last_m = (self._base @ at_m[-1][..., None])[..., 0]
        along = tip_m - last_m
        heading = np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], 1)
        return tip_m, np.arctan2(-along[:, 2], (along[:, :2] * heading).sum(1))

    def _chain(self, q: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
        """Return origins, axes and tip in the base frame; store centres of mass in `_centres`."""
        turned, at_m = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        origins, axes, self._centres = [], [], []
        for j, axis in enumerate(self._axes):
            at_m = (
                at_m + (turned @ np.broadcast_to(self._reach_m[j], (len(q), 3))[..., None])[..., 0]
            )
            if not self._hinge[j]:
                at_m = at_m + q[:, j, None] * (turned @ axis)
            origins.append(at_m)
            axes.append(turned @ axis)
            if self._hinge[j]:
                turned = turned @ _rotate(axis, q[:, j])
            self._centres.append(at_m + turned @ self._com_m[j])
        tip_m = at_m + (turned @ np.broadcast_to(self._reach_m[-1], (len(q), 3))[..., None])[..., 0]
        return origins, axes, tip_m


def _read_origin(body: Body) -> np.ndarray:
    """Return the origin of a body in its parent as drawn, `(3,)` m."""
    return np.array([dimension.value for dimension in body.origin_m])


def _rotate(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the rotations about a unit axis by each angle, `(N, 3, 3)`."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (
        np.eye(3)
        + np.sin(angle)[:, None, None] * cross
        + (1.0 - np.cos(angle))[:, None, None] * (cross @ cross)
    )
