"""Occlusion by the arm: links as capsules, and the part of a rim that they leave in sight.

Axes: `K` capsules, `P` points of a rim; anything may stand before them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from perception.calibrate.transforms import span_plane

NUM_RIM_POINTS = 16
"""Points of a rim: a part of it is then known to 6 %."""


class Capsules(NamedTuple):
    """Rods with round ends.

    Attributes:
        start_m: One end of each axis, `(…, K, 3)`.
        end_m: The other.
        radius_m: Radii, `(K,)`.
    """

    start_m: np.ndarray
    end_m: np.ndarray
    radius_m: np.ndarray


@spec
class ArmShape:
    """Thickness of the arm, as pictures and the choice of a view take it.

    Attributes:
        link_m: Radius of the links and of the hammer.
        tool_m: Radius of the chisel.
        chisel_m: Length of the chisel that stands out of the hammer.
    """

    link_m: float
    tool_m: float
    chisel_m: float

    def trace(self, machine: Machine, q: np.ndarray) -> np.ndarray:
        """Return the joints in order, the end of the hammer and the tip, `(…, J + 2, 3)`."""
        arm = compute_tool_kinematics(machine, q)
        hammer_m = arm.tip_in_base_m - self.chisel_m * arm.axis_in_base
        ends_m = np.stack([hammer_m, arm.tip_in_base_m], -2)
        return np.concatenate([arm.joints_in_base_m, ends_m], -2)

    def cover(self, machine: Machine, q: np.ndarray) -> Capsules:
        """Return the arm at `q`, `(…, J)`, as capsules."""
        chain_m = self.trace(machine, q)
        radius_m = np.full(chain_m.shape[-2] - 1, self.link_m)
        radius_m[-1] = self.tool_m
        return Capsules(chain_m[..., :-1, :], chain_m[..., 1:, :], radius_m)


def sample_circle(center_m: np.ndarray, axis: np.ndarray, radius_m: float) -> np.ndarray:
    """Return points on a circle, `(P, 3)`."""
    first, second = span_plane(axis)
    angle = np.linspace(0.0, 2.0 * np.pi, NUM_RIM_POINTS, endpoint=False)[:, None]
    across = np.cos(angle) * first + np.sin(angle) * second
    return center_m + radius_m * across


def compute_visible_share(
    camera_m: np.ndarray, rim_m: np.ndarray, capsules: Capsules
) -> np.ndarray:
    """Return the part of a rim that capsules leave in sight, `(…,)`.

    Args:
        camera_m: Centres of projection, `(…, 3)`.
        rim_m: Points of the rim, `(P, 3)`.
        capsules: What hides it; leading axes broadcast with those of `camera_m`.
    """
    camera = np.asarray(camera_m)[..., None, None, :]
    distance_m = _measure_distance(
        camera,
        rim_m[:, None] - camera,
        capsules.start_m[..., None, :, :],
        (capsules.end_m - capsules.start_m)[..., None, :, :],
    )
    return (distance_m > capsules.radius_m).all(-1).mean(-1)


def _measure_distance(p: np.ndarray, u: np.ndarray, r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the distance of segments p to p + u from segments r to r + v, `(…,)`.

    Ericson, Real-Time Collision Detection, section 5.1.9.
    """
    w = p - r
    a, b, e = (u * u).sum(-1), (u * v).sum(-1), np.maximum((v * v).sum(-1), 1e-12)
    c, f = (u * w).sum(-1), (v * w).sum(-1)
    denominator = np.maximum(a * e - b * b, 1e-12)
    s = np.clip((b * f - c * e) / denominator, 0.0, 1.0)
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, 1e-12), 0.0, 1.0)
    return np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
