"""What the 3D scene of the page needs besides positions: the machine's links, once, and the way that the tool has to go."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from deploy.page.protocol import Vector

ABOVE_M, BELOW_M = 0.3, 0.1
"""From where over the rim the tool goes straight down, and how deep it has to go: 0.10 m in the
hole is the task's success."""
BESIDE_M = 0.05
"""Distance to the axis of the borehole up to which the tool is over it."""


def describe_geometry(machine: Machine) -> dict[str, Any] | None:
    """Returns what the page needs to draw the machine, as plain data; `None` where it is known by its joints only."""
    if not machine.has_bodies:
        return None
    links = [
        {
            "kind": joint.kind,
            "axis": list(body.axis),
            "origin_m": [dimension.value for dimension in body.origin_m],
        }
        for joint, body in zip(machine.joints, machine.bodies, strict=True)
    ]
    return {"links": links, "tip_m": machine.tip_m.tolist()}


def plan_approach(tip_m: np.ndarray, center_m: np.ndarray, axis: np.ndarray) -> tuple[Vector, ...]:
    """Returns the way of the tip to a point over the rim of a borehole, then along its axis into it, in the base frame.

    This is where the tool has to go, not what the policy will do: that also depends on who moves
    the levers.

    Args:
        tip_m: Tip of the tool, `(3,)`.
        center_m: Centre of the rim, `(3,)`.
        axis: Unit vector out of the hole, `(3,)`.
    """
    off_m = tip_m - center_m
    is_over = (
        float(off_m @ axis) < ABOVE_M and float(np.linalg.norm(np.cross(off_m, axis))) < BESIDE_M
    )
    way = (
        (tip_m, center_m - BELOW_M * axis)
        if is_over
        else (tip_m, center_m + ABOVE_M * axis, center_m - BELOW_M * axis)
    )
    return tuple((float(x), float(y), float(z)) for x, y, z in way)


INNER, OUTER, ROUNDS = 1.1, 2.4, 4
"""Of the borehole's radius, between which the face is measured, and how often."""
SLANT = 0.05
"""Sine of the angle between face and sight from which on the face says nothing."""
LEAST_POINTS, LEAST_SIDES = 24, 3
"""Points of the face, and quarters around the click in which there must be some."""
HAND_PX = 4.0
"""Standard deviation of a click: a gloved finger on a picture of 640 px."""
NEAREST_PX, REACH_PX = 6, 24
"""Half the size of the window that tells how far away the face is, and how large it may become."""


def locate_borehole(
    frame: Frame, x: float, y: float, radius_m: float
) -> tuple[np.ndarray, float] | None:
    """Returns the centre of the borehole that a person points at, `(3,)` in the base frame, and its standard deviation in m.

    Args:
        frame: What the person saw.
        x: Across the picture, 0 at its left edge, 1 at its right.
        y: Down the picture, 0 at its upper edge, 1 at its lower.
        radius_m: Of the borehole.

    Returns:
        `None` where no face is measured around the click, or nobody knows where the camera is.
    """
    if frame.base_from_camera is None:
        return None
    height, width = frame.depth_m.shape
    u, v = x * width - 0.5, y * height - 0.5
    about_m = _measure_distance_m(frame.depth_m, u, v)
    if about_m is None:
        return None
    from_pixel, focal_px = np.linalg.inv(frame.camera_matrix), float(frame.camera_matrix[0, 0])
    ray = from_pixel @ np.array([u, v, 1.0])
    reach = int(OUTER * focal_px * radius_m / about_m) + NEAREST_PX
    rows, columns = np.mgrid[
        max(0, int(v) - reach) : int(v) + reach + 1, max(0, int(u) - reach) : int(u) + reach + 1
    ]
    rows, columns = rows[rows < height], columns[rows < height]
    rows, columns = rows[columns < width], columns[columns < width]
    depth_m = frame.depth_m[rows, columns]
    points_m = (np.stack([columns, rows, np.ones(len(rows))], 1) @ from_pixel.T) * depth_m[:, None]
    center_m, least = ray * about_m, 0.0
    for _ in range(ROUNDS):  # what lies beside the mouth is known better each time
        apart_m = np.linalg.norm(points_m - center_m, axis=1)
        face = (apart_m > least * radius_m) & (apart_m < OUTER * radius_m)
        sides = set(zip((columns[face] > u).tolist(), (rows[face] > v).tolist(), strict=True))
        if int(face.sum()) < LEAST_POINTS or len(sides) < LEAST_SIDES:
            return None
        point_m, normal, rough_m = _fit_plane(points_m[face])
        slope = float(normal @ ray)
        if abs(slope) < SLANT * float(np.linalg.norm(ray)):
            return None  # the face is seen from its edge
        center_m, least = ray * float(normal @ point_m) / slope, INNER
    pose = frame.base_from_camera
    std_m = math.hypot(HAND_PX * width / 640 * float(center_m[2]) / focal_px, rough_m)
    return pose[:3, :3] @ center_m + pose[:3, 3], std_m


def _measure_distance_m(depth_m: np.ndarray, u: float, v: float) -> float | None:
    """Returns how far away what is clicked at is, from the smallest window that knows."""
    for half in range(NEAREST_PX, REACH_PX + 1, 6):
        window = depth_m[
            max(0, int(v) - half) : int(v) + half + 1, max(0, int(u) - half) : int(u) + half + 1
        ]
        known = window[np.isfinite(window)]
        if len(known) >= LEAST_POINTS:
            return float(np.median(known))
    return None


def _fit_plane(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns a point of the plane through most of the points, `(K, 3)`, its normal, and how rough it is in m."""
    kept = points_m
    for _ in range(3):
        middle_m = kept.mean(0)
        normal = np.linalg.svd(kept - middle_m, full_matrices=False)[2][2]
        off_m = np.abs((points_m - middle_m) @ normal)
        limit_m = 3.0 * 1.4826 * float(np.median(off_m)) + 1e-4
        kept = points_m[off_m <= limit_m]
    return middle_m, normal, float(np.sqrt(np.mean(((kept - middle_m) @ normal) ** 2)))
