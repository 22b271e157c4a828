"""Refinement of a roughly placed block: outline and mouths to edges, faces to depth, all frames at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from brokk_rl.signals import Frame
from perception.label.cuboid import (
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
SIGMAS = 3.0
"""Depth that is off by so many standard deviations is that of something else."""
DEPTH_STEP_PX = 16
"""Every so many pixels one is compared in depth, both ways."""
MIN_OCCLUSION_M = 0.03
"""Something in front of the block is nearer by this at least."""
MIN_SELF_OCCLUSION_M = 0.01
"""The block hides its own point if its surface is nearer by this."""
NUM_ROUNDS = 8
"""Edges are sought anew in each round, within a reach that shrinks."""
REACH_END = 0.25
"""Reach of the last round over that of the first."""
ATTRACTION = 0.7
"""Distance at which an edge counts 1 / e, as a part of the reach: near edges are preferred."""


@dataclass(frozen=True)
class RefinementView:
    """One frame to refine by.

    Attributes:
        frame: The frame.
        pose: Its camera in the world, `(4, 4)`.
        gray: Its picture in grey, slightly smoothed, `(h, w)` float32.
        rays: Lines of sight of some pixels with depth at depth 1, `(d, 3)`.
        inverse: Their inverse depth, `(d,)` 1/m.
        noise_per_m: Standard deviation of inverse depth.
    """

    frame: Frame
    pose: np.ndarray
    gray: np.ndarray
    rays: np.ndarray
    inverse: np.ndarray
    noise_per_m: float


@dataclass(frozen=True)
class Outline:
    """Visible points of a block's edges, or of a mouth's rim, in one frame.

    Attributes:
        points_m: In the block's own coordinates, `(n, 3)`.
        mouth: Number of the mouth whose rim they lie on, -1 for edges of the block.
        seen_px: Their projections, `(n, 2)`.
        normal: Across the outline, `(n, 2)` unit vectors; out of a mouth.
    """

    points_m: np.ndarray
    mouth: int
    seen_px: np.ndarray
    normal: np.ndarray


def prepare_view(frame: Frame, pose: np.ndarray, noise_per_m: float) -> RefinementView:
    """Return a frame ready to refine by."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    smooth = cv2.GaussianBlur(gray, (0, 0), SMOOTH_PX)
    depth_m = frame.depth_m[::DEPTH_STEP_PX, ::DEPTH_STEP_PX]
    known = np.isfinite(depth_m)
    rays = compute_pixel_rays(frame)[::DEPTH_STEP_PX, ::DEPTH_STEP_PX][known]
    inverse = 1.0 / depth_m[known].astype(float)
    return RefinementView(frame, pose, smooth, rays, inverse, noise_per_m)


def refine_cuboid(cuboid: Cuboid, views: Sequence[RefinementView], reach_px: float) -> Cuboid:
    """Return the block whose edges and mouths fit the edges of the pictures best.

    Args:
        cuboid: The block as placed.
        views: Frames to fit to.
        reach_px: Distance from the outline within which edges are sought at first.
    """
    for number in range(NUM_ROUNDS):
        reach = reach_px * REACH_END ** (number / (NUM_ROUNDS - 1))
        matches, depths = [], []
        for view in views:
            # Depth near a face, by the error of its placing, is that of the face.
            expected = 1.0 / trace_rays(cuboid, view.rays, view.pose).depth_m
            slack = np.maximum(
                reach / view.frame.camera_matrix[0, 0] * expected, SIGMAS * view.noise_per_m
            )
            near = np.abs(view.inverse - expected) < slack
            depths.append((view, view.rays[near], view.inverse[near]))
            for outline in sample_outlines(cuboid, view, reach):
                offset_px = measure_edge_offsets(outline, view.gray, reach)
                found = np.isfinite(offset_px)
                target_px = outline.seen_px + offset_px[:, None] * outline.normal
                points_m, normal = outline.points_m[found], outline.normal[found]
                matches.append((view, Outline(points_m, outline.mouth, target_px[found], normal)))

        def compute_residuals(
            change: np.ndarray,
            now: Cuboid = cuboid,
            matches: list[tuple[RefinementView, Outline]] = matches,
            depths: list[tuple[RefinementView, np.ndarray, np.ndarray]] = depths,
        ) -> np.ndarray:
            """Return distances of moved points from their edges, px, and departures of depth."""
            block = now.moved(change)
            parts = []
            for view, edge in matches:
                # A point of an edge stays on it when the face grows, one of a rim beside its mouth.
                points_m = edge.points_m * (block.size_m / now.size_m)
                if edge.mouth >= 0:
                    begin_m, end_m = now.locate(edge.mouth), block.locate(edge.mouth)
                    points_m = edge.points_m - begin_m + end_m
                pixels = project_points(block.world(points_m), view.frame, view.pose)
                across_px = ((pixels - edge.seen_px) * edge.normal).sum(1)
                parts.append(np.nan_to_num(across_px, nan=100.0))  # behind the camera: far off
            for view, rays, inverse in depths:
                off = inverse - 1.0 / trace_rays(block, rays, view.pose).depth_m
                parts.append(np.clip(off / view.noise_per_m, -SIGMAS, SIGMAS))
            return np.concatenate(parts)

        start = np.zeros(8 + 2 * len(cuboid.mouths))
        if sum(len(edge.points_m) for _, edge in matches) < len(start):
            return cuboid
        fit = least_squares(
            compute_residuals, start, loss="soft_l1", x_scale=0.01, max_nfev=20, diff_step=1e-6
        )
        cuboid = cuboid.moved(fit.x)
    return cuboid


def measure_misfit_px(cuboid: Cuboid, view: RefinementView, reach_px: float) -> float | None:
    """Return how far three quarters of the outline lie at most from edges of a picture, px.

    `None` where too little of the outline is in view.
    """
    offsets_px = np.concatenate(
        [
            measure_edge_offsets(outline, view.gray, reach_px)
            for outline in sample_outlines(cuboid, view, reach_px)
        ]
    )
    known_px = offsets_px[np.isfinite(offsets_px)]
    return float(np.percentile(np.abs(known_px), 75)) if len(known_px) > POINTS_PER_EDGE else None


def sample_outlines(cuboid: Cuboid, view: RefinementView, reach_px: float) -> list[Outline]:
    """Return the visible points on the edges of the faces that are seen, and on rims of mouths.

    Points with something in front of them within `reach_px` are left out, since its edges would be
    taken for theirs.
    """
    part = np.linspace(0.03, 0.97, POINTS_PER_EDGE)[:, None]  # corners belong to no single edge
    outlines = []
    for begin, end in cuboid.edges(view.pose[:3, 3]):
        along = np.broadcast_to(end - begin, (POINTS_PER_EDGE, 3))
        outlines.append(
            _project_outline(begin + part * (end - begin), along, -1, cuboid, view, reach_px)
        )
    if cuboid.own(view.pose[:3, 3])[2] <= 0:
        return outlines
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS_PER_MOUTH, endpoint=False)
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    tangent = np.stack([-radial[:, 1], radial[:, 0], radial[:, 2]], axis=1)
    for number, mouth in enumerate(cuboid.mouths):
        center_m = cuboid.locate(number)
        points = center_m + mouth.radius_m * radial
        rim = _project_outline(points, tangent, number, cuboid, view, reach_px)
        center_px = project_points(cuboid.world(center_m[None]), view.frame, view.pose)
        outward = ((rim.seen_px - center_px) * rim.normal).sum(1, keepdims=True)
        outlines.append(replace(rim, normal=rim.normal * np.sign(outward)))
    return outlines


def measure_edge_offsets(outline: Outline, gray: np.ndarray, reach_px: float) -> np.ndarray:
    """Return the distance of the steepest edge along each point's normal, `(n,)` px.

    NaN where there is none. Mouths are darker inside.
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
    slope = np.maximum(slope, 0.0) if outline.mouth >= 0 else np.abs(slope)
    place = along[span // 2 : -(span // 2)]
    score = slope * np.exp(-((place / (ATTRACTION * reach_px)) ** 2))
    best = score.argmax(1)
    strength = slope[np.arange(len(best)), best]
    return np.where(strength > 0, place[best], np.nan)


def _project_outline(
    points: np.ndarray,
    along: np.ndarray,
    mouth: int,
    cuboid: Cuboid,
    view: RefinementView,
    reach_px: float,
) -> Outline:
    """Return the visible points, projected, with the normals of the projected line."""
    frame, pose = view.frame, view.pose
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
    # Neither the block itself nor something in front of it hides the others.
    depth_m = ((cuboid.world(points) - pose[:3, 3]) @ pose[:3, :3])[:, 2]
    own_m = trace_rays(cuboid, compute_rays(frame, pixels), pose).depth_m
    rows, columns = np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)
    side = 2 * int(reach_px) + 1
    known_m = np.where(np.isfinite(frame.depth_m), frame.depth_m, np.float32(1e6))
    nearest_m = np.asarray(cv2.erode(known_m, np.ones((side, side), np.uint8)))[rows, columns]
    slack_m = GRAZING_FACTOR * reach_px / frame.camera_matrix[0, 0] * depth_m
    noise_m = np.maximum(SIGMAS * view.noise_per_m * depth_m**2, MIN_OCCLUSION_M)
    visible = (own_m > depth_m - MIN_SELF_OCCLUSION_M) & (nearest_m > depth_m - noise_m - slack_m)
    return Outline(points[visible], mouth, pixels[visible], normal[visible])
