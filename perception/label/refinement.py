"""Refinement of a roughly placed block: faces to the depth, outline to the edges of the pictures.

All frames are fitted at once.
"""

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

# All numbers below were chosen by hand.
POINTS_PER_EDGE = 60
POINTS_PER_MOUTH = 72
STEP_PX = 0.5
"""Samples across the outline lie this far apart."""
SMOOTH_PX = 1.0
"""Standard deviation of the smoothing before edges are sought."""
GRAZING_FACTOR = 2.0
"""A surface may be nearer by this many times the outline's error: it may be seen at a slant."""
OCCLUSION_SIGMAS = 3.0
"""Something in front of the block is nearer by this many standard deviations of depth."""
MIN_OCCLUSION_M = 0.03
"""It is nearer by this at least."""
MIN_SELF_OCCLUSION_M = 0.01
"""The block hides its own point if its surface is nearer by this."""
NUM_ROUNDS = 8
"""Edges are sought anew in each round, within a reach that shrinks."""
REACH_END = 0.25
"""Reach of the last round over that of the first."""
DEPTH_STEP_PX = 8
"""Every so many pixels one is compared in depth, both ways."""
EDGE_SIGMA_PX = 1.0
"""Standard deviation of an edge's place."""
ATTRACTION = 0.7
"""Distance at which an edge counts 1 / e, as a part of the reach: near edges are preferred."""


@dataclass(frozen=True)
class Outline:
    """Points of a block's outline in one frame.

    Attributes:
        points_m: In the block's own coordinates, `(n, 3)`.
        seen_px: Their projections, `(n, 2)`.
        normal: Across the outline, `(n, 2)` unit vectors.
        darker_inside: The shape is a mouth: `normal` points out of it, and it is darker inside.
    """

    points_m: np.ndarray
    seen_px: np.ndarray
    normal: np.ndarray
    darker_inside: bool = False


def smooth_gray(frame: Frame) -> np.ndarray:
    """Return the frame in grey, slightly smoothed, `(h, w)` float32."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return cv2.GaussianBlur(gray, (0, 0), SMOOTH_PX)


def sample_block_outline(
    cuboid: Cuboid, frame: Frame, pose: np.ndarray, noise_per_m: float, reach_px: float
) -> Outline:
    """Return the visible points on the edges of the faces that are seen.

    Args:
        cuboid: The block.
        frame: The frame.
        pose: Its camera in the world, `(4, 4)`.
        noise_per_m: Standard deviation of inverse depth, 1/m.
        reach_px: Distance from the outline within which edges will be sought. Points with something
            in front of them within that reach are left out, since its edges would be taken for
            theirs; the block itself may be placed off by as much.
    """
    part = np.linspace(0.03, 0.97, POINTS_PER_EDGE)[:, None]  # corners belong to no single edge
    points, along = [], []
    for begin, end in cuboid.edges(pose[:3, 3]):
        points.append(begin + part * (end - begin))
        along.append(np.broadcast_to(end - begin, (POINTS_PER_EDGE, 3)))
    if not points:
        return Outline(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)))
    view = cuboid, frame, pose, noise_per_m, reach_px
    return _project_outline(np.concatenate(points), np.concatenate(along), *view)


def sample_mouth_outline(
    cuboid: Cuboid, number: int, frame: Frame, pose: np.ndarray, noise_per_m: float, reach_px: float
) -> Outline:
    """Return visible points on the rim of a mouth, none where its face is not seen."""
    mouth = cuboid.mouths[number]
    if cuboid.own(pose[:3, 3])[2] <= 0:
        return Outline(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)))
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS_PER_MOUTH, endpoint=False)
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    tangent = np.stack([-radial[:, 1], radial[:, 0], radial[:, 2]], axis=1)
    center_m = np.array([mouth.x_m, mouth.y_m, 0.0])
    points = center_m + mouth.radius_m * radial
    outline = _project_outline(points, tangent, cuboid, frame, pose, noise_per_m, reach_px)
    center_px = project_points(cuboid.world(center_m)[None], frame, pose)
    outward = ((outline.seen_px - center_px) * outline.normal).sum(1, keepdims=True)
    normal = outline.normal * np.sign(outward)
    return Outline(outline.points_m, outline.seen_px, normal, darker_inside=True)


def measure_edge_offsets(
    outline: Outline, gray: np.ndarray, reach_px: float, attraction: float
) -> np.ndarray:
    """Return the distance of the steepest edge along each point's normal, `(n,)` px.

    NaN where there is none.

    Args:
        outline: Where to look.
        gray: The picture, `(h, w)` float32.
        reach_px: How far to look.
        attraction: Distance at which an edge counts 1 / e of one at the outline, as a part of the
            reach.
    """
    if not len(outline.points_m):
        return np.zeros(0)
    along = np.arange(-reach_px - 1.0, reach_px + 1.0 + STEP_PX / 2, STEP_PX)
    where = (outline.seen_px[:, None] + along[:, None] * outline.normal[:, None]).astype(np.float32)
    maps = where[..., 0], where[..., 1]
    profile = cv2.remap(gray, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = np.asarray(profile)
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
    """Return the visible points, projected, with the normals of the projected line."""
    height, width = frame.color.shape[:2]
    pixels = project_points(cuboid.world(points), frame, pose)
    step = 1e-3 * along / np.linalg.norm(along, axis=1, keepdims=True)
    way = project_points(cuboid.world(points + step), frame, pose) - pixels
    with np.errstate(invalid="ignore"):
        across = np.stack([-way[:, 1], way[:, 0]], axis=1)
        normal = across / np.linalg.norm(way, axis=1, keepdims=True)
    in_picture = (pixels >= 2).all(1) & (pixels <= [width - 3, height - 3]).all(1)
    inside = np.isfinite(normal).all(1) & in_picture
    points, pixels, normal = points[inside], pixels[inside], normal[inside]
    visible = _find_visible(points, pixels, cuboid, frame, pose, noise_per_m, reach_px)
    return Outline(points[visible], pixels[visible], normal[visible])


def _find_visible(
    points: np.ndarray,
    pixels: np.ndarray,
    cuboid: Cuboid,
    frame: Frame,
    pose: np.ndarray,
    noise_per_m: float,
    reach_px: float,
) -> np.ndarray:
    """Return which points neither the block itself nor something in front of it hides."""
    depth_m = ((cuboid.world(points) - pose[:3, 3]) @ pose[:3, :3])[:, 2]
    own_m = trace_rays(cuboid, compute_rays(frame, pixels), pose).depth_m
    rows, columns = np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)
    side = 2 * int(reach_px) + 1
    known_m = np.where(np.isfinite(frame.depth_m), frame.depth_m, np.float32(1e6))
    nearest_m = np.asarray(cv2.erode(known_m, np.ones((side, side), np.uint8)))[rows, columns]
    slack_m = GRAZING_FACTOR * reach_px / frame.camera_matrix[0, 0] * depth_m
    noise_m = np.maximum(OCCLUSION_SIGMAS * noise_per_m * depth_m**2, MIN_OCCLUSION_M)
    is_occluded = nearest_m < depth_m - noise_m - slack_m
    return ~(own_m < depth_m - MIN_SELF_OCCLUSION_M) & ~is_occluded


@dataclass(frozen=True)
class RefinementView:
    """One frame to refine by: the frame, its camera's pose in the world, its picture in grey."""

    frame: Frame
    pose: np.ndarray
    gray: np.ndarray


@dataclass(frozen=True)
class _EdgeMatches:
    """Edges along an outline: points of the block, their targets, the normals there."""

    points_m: np.ndarray
    target_px: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class _DepthSamples:
    """Measured points on faces of the block: inverse depth, ray in the world, face number."""

    inverse: np.ndarray
    along: np.ndarray
    face: np.ndarray


def prepare_view(frame: Frame, pose: np.ndarray) -> RefinementView:
    """Return a frame ready to refine by."""
    return RefinementView(frame, pose, smooth_gray(frame))


def refine_cuboid(
    cuboid: Cuboid, views: Sequence[RefinementView], noise_per_m: float, reach_px: float
) -> Cuboid:
    """Return the block that fits best.

    The cameras of a pair that is not calibrated see all depth too near or too far, by the same in
    inverse depth. That offset is fitted along: edges of many views know the distance, and the depth
    would pull the block away from them.

    Args:
        cuboid: The block as placed.
        views: Frames to fit to, all of one camera.
        noise_per_m: Standard deviation of inverse depth, 1/m.
        reach_px: Distance from the outline within which edges are sought at first.
    """
    offset_per_m = 0.0
    for number in range(NUM_ROUNDS):
        reach = _compute_reach_px(reach_px, number)
        edges, depths = [], []
        for view in views:
            outline = sample_block_outline(cuboid, view.frame, view.pose, noise_per_m, reach)
            edges.append(_match_edges(outline, view, reach))
            depths.append(_select_depths(cuboid, view, noise_per_m, reach))

        def compute_residuals(
            change: np.ndarray,
            now: Cuboid = cuboid,
            edges: list[_EdgeMatches] = edges,
            depths: list[_DepthSamples] = depths,
        ) -> np.ndarray:
            block, offset_per_m = now.moved(change[:8]), change[8]
            # The offset is about as large as the noise.
            parts = [np.array([offset_per_m / noise_per_m])]
            for view, edge, depth in zip(views, edges, depths, strict=True):
                # a point of an edge stays on it when the face grows
                points_m = edge.points_m * (block.size_m / now.size_m)
                parts.append(_compute_edge_residuals(block, points_m, edge, view))
                off = _compute_depth_residuals(block, depth, view) - offset_per_m
                parts.append(off / noise_per_m)
            return np.concatenate(parts)

        fit = least_squares(
            compute_residuals,
            np.append(np.zeros(8), offset_per_m),
            loss="soft_l1",
            x_scale=[0.01] * 8 + [noise_per_m],
            max_nfev=20,
        )
        cuboid, offset_per_m = cuboid.moved(fit.x[:8]), float(fit.x[8])
    return cuboid


def refine_mouths(
    cuboid: Cuboid, views: Sequence[RefinementView], noise_per_m: float, reach_px: float
) -> Cuboid:
    """Return the block with its holes moved to the edges of the pictures; see `refine_cuboid`."""
    for number in range(len(cuboid.mouths)):
        cuboid = _refine_mouth(cuboid, number, views, noise_per_m, reach_px)
    return cuboid


def _refine_mouth(
    cuboid: Cuboid,
    number: int,
    views: Sequence[RefinementView],
    noise_per_m: float,
    reach_px: float,
) -> Cuboid:
    for turn in range(NUM_ROUNDS):
        reach = _compute_reach_px(reach_px, turn)
        edges = []
        for view in views:
            outline = sample_mouth_outline(
                cuboid, number, view.frame, view.pose, noise_per_m, reach
            )
            edges.append(_match_edges(outline, view, reach))
        if not sum(len(edge.points_m) for edge in edges):
            return cuboid

        def compute_residuals(
            change: np.ndarray, now: Cuboid = cuboid, edges: list[_EdgeMatches] = edges
        ) -> np.ndarray:
            shift = np.array([change[0], change[1], 0.0])
            parts = []
            for view, edge in zip(views, edges, strict=True):
                parts.append(_compute_edge_residuals(now, edge.points_m + shift, edge, view))
            return np.concatenate(parts)

        fit = least_squares(
            compute_residuals, np.zeros(2), loss="soft_l1", x_scale=0.01, max_nfev=20
        )
        mouths = list(cuboid.mouths)
        mouth = mouths[number]
        mouths[number] = replace(
            mouth, x_m=mouth.x_m + float(fit.x[0]), y_m=mouth.y_m + float(fit.x[1])
        )
        cuboid = replace(cuboid, mouths=tuple(mouths))
    return cuboid


def _compute_reach_px(first_px: float, number: int) -> float:
    """Return the reach of a round: it shrinks geometrically to `REACH_END` of the first."""
    return first_px * REACH_END ** (number / (NUM_ROUNDS - 1))


def _match_edges(outline: Outline, view: RefinementView, reach_px: float) -> _EdgeMatches:
    offset = measure_edge_offsets(outline, view.gray, reach_px, ATTRACTION)
    found = np.isfinite(offset)
    target = outline.seen_px + np.where(found, offset, 0.0)[:, None] * outline.normal
    return _EdgeMatches(outline.points_m[found], target[found], outline.normal[found])


def _compute_edge_residuals(
    block: Cuboid, points_m: np.ndarray, edge: _EdgeMatches, view: RefinementView
) -> np.ndarray:
    """Return distances of outline points from their edges, across the outline, in sigmas."""
    pixels = project_points(block.world(points_m), view.frame, view.pose)
    across = ((pixels - edge.target_px) * edge.normal).sum(1)
    return np.nan_to_num(across / EDGE_SIGMA_PX, nan=100.0)  # behind the camera: far off


def _select_depths(
    cuboid: Cuboid, view: RefinementView, noise_per_m: float, reach_px: float
) -> _DepthSamples:
    """Return the measured points near a face, by the error of its placing, and off its border."""
    rays = compute_pixel_rays(view.frame, DEPTH_STEP_PX)
    measured = view.frame.depth_m[::DEPTH_STEP_PX, ::DEPTH_STEP_PX]
    known = np.isfinite(measured)
    rays, measured = rays[known], measured[known].astype(float)
    along = rays @ view.pose[:3, :3].T
    points = cuboid.own(view.pose[:3, 3] + along * measured[:, None])
    slack = np.maximum(
        reach_px / view.frame.camera_matrix[0, 0] * measured,
        OCCLUSION_SIGMAS * noise_per_m * measured**2,
    )
    face, nearest = np.full(len(points), -1), slack.copy()
    eye = cuboid.own(view.pose[:3, 3])
    for number, (axis, side) in enumerate(FACES):
        bound = (cuboid.high_m if side > 0 else cuboid.low_m)[axis]
        away = np.abs(points[:, axis] - bound)
        others = []
        for k in range(3):
            if k != axis:
                others.append(k)
        room = np.minimum(points - cuboid.low_m, cuboid.high_m - points)[:, others].min(1)
        on_face = (away < nearest) & (room > slack) & (side * (eye[axis] - bound) > 0)
        face[on_face], nearest[on_face] = number, away[on_face]
    for mouth in cuboid.mouths:
        distance = np.hypot(points[:, 0] - mouth.x_m, points[:, 1] - mouth.y_m)
        face[(distance < mouth.radius_m + slack) & (face == 0)] = -1
    chosen = face >= 0
    return _DepthSamples(1.0 / measured[chosen], along[chosen], face[chosen])


def _compute_depth_residuals(
    block: Cuboid, depth: _DepthSamples, view: RefinementView
) -> np.ndarray:
    """Return measured minus expected inverse depth on the faces' planes, 1/m."""
    eye = block.own(view.pose[:3, 3])
    along = depth.along @ block.rotation
    residuals = np.zeros(len(along))
    for number, (axis, side) in enumerate(FACES):
        on_face = depth.face == number
        bound = (block.high_m if side > 0 else block.low_m)[axis]
        expected = along[on_face, axis] / (bound - eye[axis])
        residuals[on_face] = depth.inverse[on_face] - expected
    return residuals
