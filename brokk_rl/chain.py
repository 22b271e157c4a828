"""Where the tool is: forward kinematics of a serial machine over a whole recording, in numpy and double precision.

For computers without torch, and where there is no hurry; `brokk_rl.kinematics` is for every step of
a thousand machines.

Axes: `T` time, `J` joints; anything may stand before `J`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from brokk_rl.machine import Machine


class Tool(NamedTuple):
    """The tool's pose.

    Attributes:
        tip_in_base_m: Tip of the tool, `(…, 3)`.
        axis_in_base: Unit vector from the last joint to the tip, `(…, 3)`.
        jacobian: Motion of the tip for unit motion of each joint, `(…, 3, J)`, m/rad or m/m.
        turn: Motion of the axis likewise, `(…, 3, J)`, 1/rad.
        joints_in_base_m: Origins of the joints, `(…, J, 3)`.
        axes_in_base: Unit axes of the joints, `(…, J, 3)`.
    """

    tip_in_base_m: np.ndarray
    axis_in_base: np.ndarray
    jacobian: np.ndarray
    turn: np.ndarray
    joints_in_base_m: np.ndarray
    axes_in_base: np.ndarray


def tool(machine: Machine, q: np.ndarray) -> Tool:
    """Returns the tool's pose at joint positions `q`, `(…, J)`, rad or m.

    Raises:
        ConfigError: the machine's geometry is not known.
    """
    q = np.asarray(q, float)
    shape, num = q.shape[:-1], machine.num_joints
    rotation, at_m = np.broadcast_to(np.eye(3), (*shape, 3, 3)), np.zeros((*shape, 3))
    axes, origins = np.empty((*shape, num, 3)), np.empty((*shape, num, 3))
    for j, (joint, body) in enumerate(zip(machine.joints, machine.bodies, strict=True)):
        at_m = at_m + rotation @ np.array([d.value for d in body.origin_m])
        axes[..., j, :], origins[..., j, :] = rotation @ np.array(body.axis), at_m
        if joint.kind == "slide":
            at_m = at_m + axes[..., j, :] * q[..., j, None]
        else:
            rotation = rotation @ _turned(np.array(body.axis), q[..., j])
    tip = at_m + rotation @ machine.tip_m
    axis = rotation @ (machine.tip_m / np.linalg.norm(machine.tip_m))
    hinge = np.array([joint.kind == "hinge" for joint in machine.joints])[:, None]
    jacobian = np.where(hinge, np.cross(axes, tip[..., None, :] - origins), axes)
    turn = np.where(hinge, np.cross(axes, axis[..., None, :]), 0.0)
    return Tool(tip, axis, np.swapaxes(jacobian, -1, -2), np.swapaxes(turn, -1, -2), origins, axes)


def _turned(axis: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Returns rotations about a unit axis, `(…, 3, 3)` (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = angle_rad[..., None, None]
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
