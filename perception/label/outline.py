"""Outlines in pictures: how far the picture's edges lie from where a shape's outline is thought to be."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from brokk_rl.signals import Frame
from perception.label.cuboid import Cuboid, look, project, sight

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


def block_outline(
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
    return _outline(points, along, cuboid, frame, pose, noise_per_m, reach_px)


def mouth_outline(
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
    outline = _outline(
        points,
        np.stack([-radial[:, 1], radial[:, 0], radial[:, 2]], axis=1),
        cuboid,
        frame,
        pose,
        noise_per_m,
        reach_px,
    )
    outward = ((outline.seen_px - project(centre[None], frame, pose)) * outline.normal).sum(
        1, keepdims=True
    )
    return Outline(
        outline.points_m, outline.seen_px, outline.normal * np.sign(outward), darker_inside=True
    )


def offsets(outline: Outline, gray: np.ndarray, reach_px: float, attraction: float) -> np.ndarray:
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


def _outline(
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
    here = project(cuboid.world(points), frame, pose)
    there = project(
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
    shown = _unhidden(points, here, cuboid, frame, pose, noise_per_m, reach_px)
    return Outline(points[shown], here[shown], normal[shown])


def _unhidden(
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
    own = look(cuboid, sight(frame, pixels), pose).depth_m
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
