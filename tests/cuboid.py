"""A world for the eye: a textured box with a hole on the ground, seen by rays; numpy only, exact depth and masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brokk_rl.signals import Frame

SIZE_M = np.array([1.2, 0.8, 0.6])
"""Extents of the box along x, y, z; it stands on the ground, its front face at x = 0, looking along
-x."""
HOLE_M = np.array([0.0, 0.05, 0.35])
"""Centre of the mouth of the hole, on the front face; its axis is -x."""
RADIUS_M = 0.05
NEAR = np.array([0.0, -SIZE_M[1] / 2, 0.0])


@dataclass(frozen=True)
class View:
    """A frame with what is true of it."""

    frame: Frame
    world_from_camera: np.ndarray
    block: np.ndarray
    mouth: np.ndarray
    occluder: np.ndarray


def looking(eye_m: tuple[float, float, float], at_m: tuple[float, float, float]) -> np.ndarray:
    """Returns the pose, `(4, 4)`, of a camera at `eye_m` that looks at `at_m`; z is up in the world."""
    forward = np.subtract(at_m, eye_m) / np.linalg.norm(np.subtract(at_m, eye_m))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, np.asarray(eye_m)], axis=1)
    return pose


def sight(
    pose: np.ndarray, size_px: tuple[int, int], focal_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the camera's matrix, and the rays of its pixels in the world, one metre of depth long each."""
    width, height = size_px
    matrix = np.diag([focal_px, focal_px, 1.0])
    matrix[:2, 2] = (width - 1) / 2, (height - 1) / 2
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))])
    rays = np.moveaxis(pixels, 0, -1) @ np.linalg.inv(matrix).T
    return matrix, rays @ pose[:3, :3].T


def seen(
    pose: np.ndarray,
    size_px: tuple[int, int] = (320, 180),
    noise_per_m: float = 0.0,
    occluder_m: tuple[float, float, float] | None = None,
    with_box: bool = True,
    seed: int = 0,
) -> View:
    """Renders one view; `occluder_m` is the centre of a ball of 8 cm that floats in front of the box."""
    camera_matrix, rays = sight(pose, size_px, 0.55 * size_px[0])
    eye = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        depth, what = np.where(ground < 30, ground, np.inf), np.where(ground < 30, 1, 0)
        if with_box:
            low, high = (NEAR - eye) / rays, (NEAR + SIZE_M - eye) / rays
            enters, leaves = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
            hit = (enters > 0) & (enters < leaves) & (enters < depth)
            depth, what = np.where(hit, enters, depth), np.where(hit, 2, what)
    points = eye + rays * np.where(np.isfinite(depth), depth, 0.0)[..., None]
    front = (what == 2) & (np.abs(points[..., 0]) < 1e-9)
    mouth = front & (np.linalg.norm(points - HOLE_M, axis=-1) < RADIUS_M)
    depth, what = np.where(mouth, depth + 0.2, depth), np.where(mouth, 3, what)
    if occluder_m is not None:
        offset = eye - np.asarray(occluder_m)
        a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - 0.08**2
        root = b**2 - a * c
        ball = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
        what, depth = np.where(ball < depth, 4, what), np.minimum(ball, depth)
    grain = np.random.default_rng(1).uniform(0.75, 1.0, (64, 64, 64))
    cell = (points * 25).astype(int) % 64
    kinds = [what == 3, what == 4, what == 1, front, what == 2]
    shade = np.select(kinds, [0.06, 0.9, 0.3, 0.75, 0.55], 0.95)
    bright = shade * grain[cell[..., 0], cell[..., 1], cell[..., 2]]
    color = bright[..., None] * np.array([1.0, 0.97, 0.9])
    noise = np.random.default_rng(seed).normal(0.0, 1.0, depth.shape) * noise_per_m
    with np.errstate(divide="ignore"):
        depth = 1.0 / (1.0 / depth + noise)
    known = np.isfinite(depth) & (depth > 0.1) & (depth < 40)
    depth = np.where(known, depth, np.nan).astype(np.float32)
    color = (255 * color).clip(0, 255).astype(np.uint8)
    frame = Frame(color, depth, camera_matrix, pose, 0.0)
    return View(frame, pose, np.isin(what, (2, 3)), what == 3, what == 4)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Returns the intersection over union of two masks."""
    return float((one & other).sum() / max((one | other).sum(), 1))
