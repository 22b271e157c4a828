"""Making a roughly placed block fit: its faces to the depth, its outline to the edges of the pictures, over all frames at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from brokk_rl.signals import Frame
from perception.label.cuboid import FACES, Cuboid, project, sight_lines
from perception.label.outline import Outline, block_outline, mouth_outline, offsets, smooth_gray

ROUNDS = 8
"""Edges are looked for anew so often, nearer each time."""
DEPTH_STEP = 8
"""Every so many pixels one is compared in depth, both ways."""
EDGE_SIGMA_PX = 1.0
REACH_END = 0.25
"""Reach of the last round over that of the first."""


@dataclass(frozen=True)
class Seen:
    """One frame to refine by: the frame, where its camera was, and its picture in grey."""

    frame: Frame
    pose: np.ndarray
    gray: np.ndarray


@dataclass(frozen=True)
class _Edges:
    """Where the picture has edges along an outline: points of the block, their targets, the normals there."""

    points_m: np.ndarray
    target_px: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class _Depths:
    """Measured points that lie on faces of the block, in the world, with sight and face."""

    inverse: np.ndarray
    along: np.ndarray
    face: np.ndarray


def seen(frame: Frame, pose: np.ndarray) -> Seen:
    """Prepares a frame."""
    return Seen(frame, pose, smooth_gray(frame))


def refined(cuboid: Cuboid, views: Sequence[Seen], noise_per_m: float, reach_px: float) -> Cuboid:
    """Returns the block that fits best.

    Args:
        cuboid: Where it was placed.
        views: Frames to fit to.
        noise_per_m: Standard deviation of inverse depth, 1/m.
        reach_px: How far from the outline edges are looked for at first.
    """
    for number in range(ROUNDS):
        reach = reach_px * REACH_END ** (number / (ROUNDS - 1))
        edges = [
            _edges(block_outline(cuboid, view.frame, view.pose, noise_per_m, reach), view, reach)
            for view in views
        ]
        depths = [_depths(cuboid, view, noise_per_m, reach) for view in views]

        def misfit(
            change: np.ndarray,
            now: Cuboid = cuboid,
            edges: list[_Edges] = edges,
            depths: list[_Depths] = depths,
        ) -> np.ndarray:
            block = now.moved(change)
            parts = []
            for view, edge, depth in zip(views, edges, depths, strict=True):
                # a point of an edge stays on it when the face grows
                parts.append(
                    _across(block, edge.points_m * (block.size_m / now.size_m), edge, view)
                )
                parts.append(_out_of_face(block, depth, view) / noise_per_m)
            return np.concatenate(parts)

        found = least_squares(
            misfit, np.zeros(8), loss="soft_l1", x_scale=[0.01] * 3 + [0.01] * 5, max_nfev=20
        )
        cuboid = cuboid.moved(found.x)
    return cuboid


def refined_mouths(
    cuboid: Cuboid, views: Sequence[Seen], noise_per_m: float, reach_px: float
) -> Cuboid:
    """Returns the block with its mouths moved to where the pictures have their rims; arguments as `refined`."""
    for number in range(len(cuboid.mouths)):
        cuboid = _with_mouth(cuboid, number, views, noise_per_m, reach_px)
    return cuboid


def _with_mouth(
    cuboid: Cuboid, number: int, views: Sequence[Seen], noise_per_m: float, reach_px: float
) -> Cuboid:
    """Returns the block with the centre of one mouth moved to where the rim's edges are."""
    for turn in range(ROUNDS):
        reach = reach_px * REACH_END ** (turn / (ROUNDS - 1))
        edges = [
            _edges(
                mouth_outline(cuboid, number, view.frame, view.pose, noise_per_m, reach),
                view,
                reach,
            )
            for view in views
        ]
        if not sum(len(edge.points_m) for edge in edges):
            return cuboid

        def misfit(
            change: np.ndarray, now: Cuboid = cuboid, edges: list[_Edges] = edges
        ) -> np.ndarray:
            shift = np.array([change[0], change[1], 0.0])
            return np.concatenate(
                [
                    _across(now, edge.points_m + shift, edge, view)
                    for view, edge in zip(views, edges, strict=True)
                ]
            )

        found = least_squares(misfit, np.zeros(2), loss="soft_l1", x_scale=0.01, max_nfev=20)
        mouths = list(cuboid.mouths)
        mouths[number] = replace(
            mouths[number],
            x_m=mouths[number].x_m + float(found.x[0]),
            y_m=mouths[number].y_m + float(found.x[1]),
        )
        cuboid = replace(cuboid, mouths=tuple(mouths))
    return cuboid


def _edges(outline: Outline, view: Seen, reach_px: float) -> _Edges:
    offset = offsets(outline, view.gray, reach_px, 0.7)
    found = np.isfinite(offset)
    target = outline.seen_px + np.where(found, offset, 0.0)[:, None] * outline.normal
    return _Edges(outline.points_m[found], target[found], outline.normal[found])


def _across(block: Cuboid, points_m: np.ndarray, edge: _Edges, view: Seen) -> np.ndarray:
    """Returns how far points of the outline are from their edges, across the outline, in standard deviations."""
    pixels = project(block.world(points_m), view.frame, view.pose)
    return np.nan_to_num(
        ((pixels - edge.target_px) * edge.normal).sum(1) / EDGE_SIGMA_PX, nan=100.0
    )


def _depths(cuboid: Cuboid, view: Seen, noise_per_m: float, reach_px: float) -> _Depths:
    """Returns the measured points that lie as near to a face as its placing may be off, and away from the face's border."""
    rays = sight_lines(view.frame, DEPTH_STEP)
    measured = view.frame.depth_m[::DEPTH_STEP, ::DEPTH_STEP]
    known = np.isfinite(measured)
    rays, measured = rays[known], measured[known].astype(float)
    along = rays @ view.pose[:3, :3].T
    points = cuboid.own(view.pose[:3, 3] + along * measured[:, None])
    slack = np.maximum(
        reach_px / view.frame.camera_matrix[0, 0] * measured, 3.0 * noise_per_m * measured**2
    )
    face, nearest = np.full(len(points), -1), slack.copy()
    eye = cuboid.own(view.pose[:3, 3])
    for number, (axis, side) in enumerate(FACES):
        bound = (cuboid.high_m if side > 0 else cuboid.low_m)[axis]
        away = np.abs(points[:, axis] - bound)
        others = [k for k in range(3) if k != axis]
        room = np.minimum(points - cuboid.low_m, cuboid.high_m - points)[:, others].min(1)
        here = (away < nearest) & (room > slack) & (side * (eye[axis] - bound) > 0)
        face[here], nearest[here] = number, away[here]
    for mouth in cuboid.mouths:
        within = (
            np.hypot(points[:, 0] - mouth.x_m, points[:, 1] - mouth.y_m) < mouth.radius_m + slack
        )
        face[within & (face == 0)] = -1
    on = face >= 0
    return _Depths(1.0 / measured[on], along[on], face[on])


def _out_of_face(block: Cuboid, depth: _Depths, view: Seen) -> np.ndarray:
    """Returns measured minus expected inverse depth on the faces' planes, 1/m."""
    eye = block.own(view.pose[:3, 3])
    along = depth.along @ block.rotation
    out = np.zeros(len(along))
    for number, (axis, side) in enumerate(FACES):
        on = depth.face == number
        bound = (block.high_m if side > 0 else block.low_m)[axis]
        out[on] = depth.inverse[on] - along[on, axis] / (bound - eye[axis])
    return out
