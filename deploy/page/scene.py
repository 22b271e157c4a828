"""Geometry of the page: the machine's links, the way of the tool, and the borehole under a click.

The mouth of a borehole is dark and has no depth of its own, so the face around it is measured: a
plane through the points beside the mouth, and on it the ray through the click.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brokk_rl.kinematics import ToolKinematics, compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from deploy.page.protocol import BoreholeChoice, InsertionReading, Vector

ABOVE_M = 0.3
"""Height over the rim from which the tool goes straight down. Chosen by hand: clear of the face."""
BELOW_M = 0.1
"""Depth of the tool in the hole at success (strict success of the task)."""
BESIDE_M = 0.05
"""Distance to the axis up to which the tool is over the hole. Chosen by hand: a hole's radius."""
INNER, OUTER = 1.1, 2.4
"""Of the borehole's radius, between which the face is measured. Chosen by hand: outside the
rim; a larger ring holds more of the face, and more that does not belong to it."""
ROUNDS = 4
"""Times that the face is measured, each time around a better centre. Chosen by hand."""
SLANT = 0.05
"""Sine of the angle between face and line of sight below which the face is not measured. By
hand."""
LEAST_POINTS, LEAST_SIDES = 24, 3
"""Points of the face, and quarters around the click in which there must be some. Chosen by hand."""
HAND_PX = 4.0
"""Standard deviation of a click on a picture of `PICTURE_PX`: a gloved finger. Chosen by hand."""
PICTURE_PX = 640
NEAREST_PX, REACH_PX, STEP_PX = 6, 24, 6
"""Half the smallest and largest window that tells the distance of the face, and the step between.
Chosen by hand: the largest covers the mouth of a hole at 2 m."""
PLANE_ROUNDS = 3
"""Times that a plane is fitted, each time without the points far from the last one."""
OUTLIER = 3.0
"""Distance from the plane, in robust standard deviations, above which a point is left out."""
MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
LEAST_ROUGH_M = 1e-4
"""Added to that limit, so that a perfect plane keeps all its points."""


def describe_geometry(machine: Machine) -> dict[str, Any] | None:
    """Return the machine's links as plain data; `None` where only its joints are known."""
    if not machine.has_bodies:
        return None
    links = []
    for joint, body in zip(machine.joints, machine.bodies, strict=True):
        origin_m = [dimension.value for dimension in body.origin_m]
        links.append({"kind": joint.kind, "axis": list(body.axis), "origin_m": origin_m})
    return {"links": links, "tip_m": machine.tip_m.tolist()}


def place_tool(
    machine: Machine, q: np.ndarray | None, chosen: BoreholeChoice | None
) -> tuple[tuple[Vector, ...], InsertionReading | None]:
    """Return the way of the tool into the chosen borehole, and where it is relative to it."""
    if q is None or chosen is None or not machine.has_bodies:
        return (), None
    tool = compute_tool_kinematics(machine, q)
    center_m, axis = np.array(chosen.center_in_base_m), np.array(chosen.axis_in_base)
    return plan_approach(tool.tip_in_base_m, center_m, axis), measure_insertion(tool, chosen)


def measure_insertion(tool: ToolKinematics, hole: BoreholeChoice) -> InsertionReading:
    """Return the position of the tool relative to a borehole.

    Args:
        tool: Pose of the tool, without batch.
        hole: The borehole.
    """
    center_m, axis = np.array(hole.center_in_base_m), np.array(hole.axis_in_base)
    off_m = center_m - tool.tip_in_base_m
    depth_m = float(off_m @ axis)
    lateral_m = float(np.linalg.norm(np.cross(off_m, axis)))
    into = float(np.clip(-tool.axis_in_base @ axis, -1.0, 1.0))
    view = _find_view_along(tool)
    return InsertionReading(
        depth_m=depth_m,
        lateral_m=lateral_m,
        angle_rad=math.acos(into),
        wanted_m=BELOW_M,
        inserted=depth_m >= BELOW_M and lateral_m <= hole.radius_m,
        center_in_view_m=to_vector(view @ off_m),
        axis_in_view=to_vector(view @ axis),
    )


def _find_view_along(tool: ToolKinematics) -> np.ndarray:
    """Return the rotation from the base to the view along the tool: right, up, ahead, `(3, 3)`.

    Right is the machine's right of the direction in which the arm points. Levers and view then
    agree: for a tool that points down, forward is up.
    """
    x, y, _ = tool.tip_in_base_m
    ahead = tool.axis_in_base
    # An arm that stands over the machine's own axis points nowhere; forward is as good as any.
    right = np.array([y, -x, 0.0]) if math.hypot(x, y) > 0 else np.array([0.0, -1.0, 0.0])
    right = right - (right @ ahead) * ahead
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, ahead), ahead])


def to_vector(values: np.ndarray) -> Vector:
    """Return an array `(3,)` as a tuple of plain numbers."""
    x, y, z = map(float, values)
    return x, y, z


def plan_approach(tip_m: np.ndarray, center_m: np.ndarray, axis: np.ndarray) -> tuple[Vector, ...]:
    """Return the way of the tip to a point over the rim, then along the axis into the hole.

    In the base frame. This is where the tool has to go, not the path that the policy will take:
    that depends on the operator too.

    Args:
        tip_m: Tip of the tool, `(3,)`.
        center_m: Centre of the rim, `(3,)`.
        axis: Unit vector out of the hole, `(3,)`.
    """
    off_m = tip_m - center_m
    height_m, beside_m = float(off_m @ axis), float(np.linalg.norm(np.cross(off_m, axis)))
    way = [tip_m, center_m - BELOW_M * axis]
    is_over = height_m < ABOVE_M and beside_m < BESIDE_M
    if not is_over:
        way.insert(1, center_m + ABOVE_M * axis)
    return tuple((float(x), float(y), float(z)) for x, y, z in way)


def locate_borehole(
    frame: Frame, x: float, y: float, radius_m: float
) -> tuple[np.ndarray, float] | None:
    """Return the centre of the borehole at a point of the picture, and its standard deviation in m.

    The centre is `(3,)` in the base frame.

    Args:
        frame: The frame that the person saw.
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
    first_row, first_column = max(0, int(v) - reach), max(0, int(u) - reach)
    last_row, last_column = min(height, int(v) + reach + 1), min(width, int(u) + reach + 1)
    rows, columns = np.mgrid[first_row:last_row, first_column:last_column].reshape(2, -1)
    depth_m = frame.depth_m[rows, columns]
    points_m = (np.stack([columns, rows, np.ones(len(rows))], 1) @ from_pixel.T) * depth_m[:, None]
    center_m, least = ray * about_m, 0.0
    for _ in range(ROUNDS):
        # each round knows the centre better, and so the ring around the mouth
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
    std_m = math.hypot(HAND_PX * width / PICTURE_PX * float(center_m[2]) / focal_px, rough_m)
    return pose[:3, :3] @ center_m + pose[:3, 3], std_m


def _measure_distance_m(depth_m: np.ndarray, u: float, v: float) -> float | None:
    """Return the distance at a pixel, from the smallest window with enough known depths."""
    for half in range(NEAREST_PX, REACH_PX + 1, STEP_PX):
        window = depth_m[
            max(0, int(v) - half) : int(v) + half + 1, max(0, int(u) - half) : int(u) + half + 1
        ]
        known = window[np.isfinite(window)]
        if len(known) >= LEAST_POINTS:
            return float(np.median(known))
    return None


def _fit_plane(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a point of the plane through most of `points_m`, `(K, 3)`, its normal and roughness."""
    kept = points_m
    for _ in range(PLANE_ROUNDS):
        middle_m = kept.mean(0)
        normal = np.linalg.svd(kept - middle_m, full_matrices=False)[2][2]
        off_m = np.abs((points_m - middle_m) @ normal)
        limit_m = OUTLIER * MAD_TO_STD * float(np.median(off_m)) + LEAST_ROUGH_M
        kept = points_m[off_m <= limit_m]
    return middle_m, normal, float(np.sqrt(np.mean(((kept - middle_m) @ normal) ** 2)))
