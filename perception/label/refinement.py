"""Outlines in pictures: how far the picture's edges lie from where a shape's outline is thought to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from brokk_rl.signals import Frame
from perception.label.cuboid import (
    FACES,
    Cuboid,
    compute_pixel_rays,
    compute_rays,
    project_points,
    trace_rays,
)

# --- from refine: Making a roughly placed block fit: its faces to the depth, its outline to the
# edges of the pictures, over all frames at once.

POINTS_PER_EDGE = 60
POINTS_PER_MOUTH = 72
STEP_PX = 0.5
SLACK = 2.0
"""A surface may be nearer by this many times what its outline may be off, for it may be seen at a
grazing angle."""


@dataclass(frozen=True)
class Outline:
    """Points of a block's outline in one frame.

    Attributes:
        points_m: In the block's own coordinates, `(n, 3)`.
        seen_px: Where they are projected to, `(n, 2)`.
        normal: Across the outline, `(n, 2)` unit vectors.
        darker_inside: The shape is a mouth: `normal` points out of it, and it is darker than what
            is around it.
    """

    points_m: np.ndarray
    seen_px: np.ndarray
    normal: np.ndarray
    darker_inside: bool = False


def smooth_gray(frame: Frame) -> np.ndarray:
    """Returns the frame in grey, slightly smoothed, `(h, w)` float32."""
    return cv2.GaussianBlur(
        cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0
    )


def sample_block_outline(
    cuboid: Cuboid, frame: Frame, pose: np.ndarray, noise_per_m: float, reach_px: float
) -> Outline:
    """Returns points of the edges of the faces that are seen, those that something hides left out.

    Args:
        cuboid: The block.
        frame: The frame.
        pose: Its camera in the world, `(4, 4)`.
        noise_per_m: Standard deviation of inverse depth, 1/m.
        reach_px: How far from the outline edges will be looked for. Points with something before
            them within that reach are left out, since its edges would be taken for theirs; the
            block itself may be placed off by as much.
    """
    part = np.linspace(0.03, 0.97, POINTS_PER_EDGE)[:, None]
    edges = cuboid.edges(pose[:3, 3])
    if not edges:
        return Outline(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)))
    points = np.concatenate([begin + part * (end - begin) for begin, end in edges])
    along = np.concatenate(
        [np.broadcast_to(end - begin, (POINTS_PER_EDGE, 3)) for begin, end in edges]
    )
    return _project_outline(points, along, cuboid, frame, pose, noise_per_m, reach_px)


def sample_mouth_outline(
    cuboid: Cuboid, number: int, frame: Frame, pose: np.ndarray, noise_per_m: float, reach_px: float
) -> Outline:
    """Returns points of the rim of a mouth, empty where its face is not seen."""
    mouth = cuboid.mouths[number]
    if cuboid.own(pose[:3, 3])[2] <= 0:
        return Outline(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)))
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS_PER_MOUTH, endpoint=False)
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    points = np.array([mouth.x_m, mouth.y_m, 0.0]) + mouth.radius_m * radial
    centre = cuboid.world(np.array([mouth.x_m, mouth.y_m, 0.0]))
    outline = _project_outline(
        points,
        np.stack([-radial[:, 1], radial[:, 0], radial[:, 2]], axis=1),
        cuboid,
        frame,
        pose,
        noise_per_m,
        reach_px,
    )
    outward = ((outline.seen_px - project_points(centre[None], frame, pose)) * outline.normal).sum(
        1, keepdims=True
    )
    return Outline(
        outline.points_m, outline.seen_px, outline.normal * np.sign(outward), darker_inside=True
    )


def measure_edge_offsets(
    outline: Outline, gray: np.ndarray, reach_px: float, attraction: float
) -> np.ndarray:
    """Returns how far along its normal the steepest edge of the picture lies from each point, `(n,)` px, NaN without one.

    Args:
        outline: Where to look.
        gray: The picture, `(h, w)` float32.
        reach_px: How far to look.
        attraction: Distance at which an edge counts for 1 / e of one at the outline, as a part of
            the reach; infinite: all alike.
    """
    if not len(outline.points_m):
        return np.zeros(0)
    along = np.arange(-reach_px - 1.0, reach_px + 1.0 + STEP_PX / 2, STEP_PX)
    where = (outline.seen_px[:, None] + along[:, None] * outline.normal[:, None]).astype(np.float32)
    profile = np.asarray(
        cv2.remap(
            gray, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    )
    span = round(2 / STEP_PX)
    slope = profile[:, span:] - profile[:, :-span]
    slope = np.maximum(slope, 0.0) if outline.darker_inside else np.abs(slope)
    place = along[span // 2 : -(span // 2)]
    score = slope * np.exp(-((place / (attraction * reach_px)) ** 2))
    best = score.argmax(1)
    strength = slope[np.arange(len(best)), best]
    return np.where(strength > 0, place[best], np.nan)


def _project_outline(
    points: np.ndarray,
    along: np.ndarray,
    cuboid: Cuboid,
    frame: Frame,
    pose: np.ndarray,
    noise_per_m: float,
    reach_px: float,
) -> Outline:
    """Returns the points that can be seen, projected, with the normals of the projected line."""
    height, width = frame.color.shape[:2]
    here = project_points(cuboid.world(points), frame, pose)
    there = project_points(
        cuboid.world(points + 1e-3 * along / np.linalg.norm(along, axis=1, keepdims=True)),
        frame,
        pose,
    )
    way = there - here
    with np.errstate(invalid="ignore"):
        normal = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(
            way, axis=1, keepdims=True
        )
    inside = (
        np.isfinite(normal).all(1) & (here >= 2).all(1) & (here <= [width - 3, height - 3]).all(1)
    )
    points, here, normal = points[inside], here[inside], normal[inside]
    shown = _find_visible(points, here, cuboid, frame, pose, noise_per_m, reach_px)
    return Outline(points[shown], here[shown], normal[shown])


def _find_visible(
    points: np.ndarray,
    pixels: np.ndarray,
    cuboid: Cuboid,
    frame: Frame,
    pose: np.ndarray,
    noise_per_m: float,
    reach_px: float,
) -> np.ndarray:
    """Returns which points neither the block itself nor something before it hides."""
    depth_m = ((cuboid.world(points) - pose[:3, 3]) @ pose[:3, :3])[:, 2]
    own = trace_rays(cuboid, compute_rays(frame, pixels), pose).depth_m
    rows, columns = np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)
    width = 2 * int(reach_px) + 1
    nearest = cv2.erode(
        np.where(np.isfinite(frame.depth_m), frame.depth_m, np.float32(1e6)),
        np.ones((width, width), np.uint8),
    )
    slack_m = SLACK * reach_px / frame.camera_matrix[0, 0] * depth_m
    before = (
        np.asarray(nearest)[rows, columns]
        < depth_m - np.maximum(3.0 * noise_per_m * depth_m**2, 0.03) - slack_m
    )
    return ~(own < depth_m - 0.01) & ~before


ROUNDS = 8
"""Edges are looked for anew so often, nearer each time."""
DEPTH_STEP = 8
"""Every so many pixels one is compared in depth, both ways."""
EDGE_SIGMA_PX = 1.0
REACH_END = 0.25
"""Reach of the last round over that of the first."""


@dataclass(frozen=True)
class RefinementView:
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


def prepare_view(frame: Frame, pose: np.ndarray) -> RefinementView:
    """Prepares a frame."""
    return RefinementView(frame, pose, smooth_gray(frame))


def refine_cuboid(
    cuboid: Cuboid, views: Sequence[RefinementView], noise_per_m: float, reach_px: float
) -> Cuboid:
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
            _edges(
                sample_block_outline(cuboid, view.frame, view.pose, noise_per_m, reach), view, reach
            )
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


def refine_mouths(
    cuboid: Cuboid, views: Sequence[RefinementView], noise_per_m: float, reach_px: float
) -> Cuboid:
    """Returns the block with its mouths moved to where the pictures have their rims; arguments as `refined`."""
    for number in range(len(cuboid.mouths)):
        cuboid = _with_mouth(cuboid, number, views, noise_per_m, reach_px)
    return cuboid


def _with_mouth(
    cuboid: Cuboid,
    number: int,
    views: Sequence[RefinementView],
    noise_per_m: float,
    reach_px: float,
) -> Cuboid:
    """Returns the block with the centre of one mouth moved to where the rim's edges are."""
    for turn in range(ROUNDS):
        reach = reach_px * REACH_END ** (turn / (ROUNDS - 1))
        edges = [
            _edges(
                sample_mouth_outline(cuboid, number, view.frame, view.pose, noise_per_m, reach),
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


def _edges(outline: Outline, view: RefinementView, reach_px: float) -> _Edges:
    offset = measure_edge_offsets(outline, view.gray, reach_px, 0.7)
    found = np.isfinite(offset)
    target = outline.seen_px + np.where(found, offset, 0.0)[:, None] * outline.normal
    return _Edges(outline.points_m[found], target[found], outline.normal[found])


def _across(block: Cuboid, points_m: np.ndarray, edge: _Edges, view: RefinementView) -> np.ndarray:
    """Returns how far points of the outline are from their edges, across the outline, in standard deviations."""
    pixels = project_points(block.world(points_m), view.frame, view.pose)
    return np.nan_to_num(
        ((pixels - edge.target_px) * edge.normal).sum(1) / EDGE_SIGMA_PX, nan=100.0
    )


def _depths(cuboid: Cuboid, view: RefinementView, noise_per_m: float, reach_px: float) -> _Depths:
    """Returns the measured points that lie as near to a face as its placing may be off, and away from the face's border."""
    rays = compute_pixel_rays(view.frame, DEPTH_STEP)
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


def _out_of_face(block: Cuboid, depth: _Depths, view: RefinementView) -> np.ndarray:
    """Returns measured minus expected inverse depth on the faces' planes, 1/m."""
    eye = block.own(view.pose[:3, 3])
    along = depth.along @ block.rotation
    out = np.zeros(len(along))
    for number, (axis, side) in enumerate(FACES):
        on = depth.face == number
        bound = (block.high_m if side > 0 else block.low_m)[axis]
        out[on] = depth.inverse[on] - along[on, axis] / (bound - eye[axis])
    return out
