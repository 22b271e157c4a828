"""Where the links of a machine are, in numpy: the machine's computer has no torch."""

from __future__ import annotations

from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from deploy.page.shown import Vector


def points_in_base_m(machine: Machine, q: np.ndarray) -> np.ndarray:
    """Returns the origins of all joints and then the tip of the tool, `(J + 1, 3)` in the base frame, at joint positions `(J,)`.

    Raises:
        ConfigError: the machine is known by its joints only.
    """
    turned, at, points = np.eye(3), np.zeros(3), []
    for joint, body, value in zip(machine.joints, machine.bodies, q, strict=True):
        axis = np.asarray(body.axis, dtype=float)
        at = at + turned @ [dimension.value for dimension in body.origin_m]
        points.append(at)
        if joint.kind == "hinge":
            turned = turned @ _rotation(axis, float(value))
        else:
            at = at + turned @ axis * float(value)
    return np.array([*points, at + turned @ machine.tip_m])


def geometry(machine: Machine) -> dict[str, Any] | None:
    """Returns what the page needs to draw the machine, as plain data; `None` where it is known by its joints only."""
    if not machine.has_bodies:
        return None
    links = [
        {"kind": joint.kind, "axis": list(body.axis), "origin_m": [dimension.value for dimension in body.origin_m]}
        for joint, body in zip(machine.joints, machine.bodies, strict=True)
    ]
    return {"links": links, "tip_m": machine.tip_m.tolist()}


def approach(tip_m: np.ndarray, center_m: np.ndarray, axis: np.ndarray, above_m: float, below_m: float) -> tuple[Vector, ...]:
    """Returns the way of the tip to `above_m` over the rim of a borehole, then along its axis to `below_m` in it.

    This is where the tool has to go, not what the policy will do: that also depends on who moves the levers.
    """
    corners = (tip_m, center_m + above_m * axis, center_m - below_m * axis)
    start = 1 if float((tip_m - center_m) @ axis) < above_m and np.linalg.norm(np.cross(tip_m - center_m, axis)) < 0.05 else 0
    way = (tip_m, corners[2]) if start else corners
    return tuple((float(point[0]), float(point[1]), float(point[2])) for point in way)


def _rotation(axis: np.ndarray, angle_rad: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross
