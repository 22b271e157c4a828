"""A hole in an endless face, drawn ray by ray, for tests of perception."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse, Masks
from brokk_rl.signals import Frame
from perception.ellipse import conic

K = np.array([[528.0, 0.0, 319.5], [0.0, 528.0, 239.5], [0.0, 0.0, 1.0]])
CENTER, AXIS = np.array([0.05, 0.02, 1.2]), np.array([0.0, -0.57, -0.82]) / np.hypot(0.57, 0.82)
PIXELS = np.stack([*np.meshgrid(np.arange(640), np.arange(480)), np.ones((480, 640))], -1)
RAYS = PIXELS @ np.linalg.inv(K).T


def drawn(
    radius_m: float = 0.05, depth_m: float = 0.3, noise: float = 0.0
) -> tuple[Frame, Masks, Ellipse]:
    """Returns a frame with a hole in an endless face, ray by ray, its masks, and the ellipse of its rim."""
    m = AXIS / (AXIS @ CENTER)
    inverse = RAYS @ m
    hit = RAYS / inverse[..., None] - CENTER
    inside = np.linalg.norm(hit, axis=-1) < radius_m
    depth = 1.0 / (inverse + np.random.default_rng(0).normal(0, 1, inverse.shape) * noise)
    gray = np.full(inverse.shape, 150.0)
    along, start = RAYS @ AXIS, hit
    across = RAYS - along[..., None] * AXIS
    a, b = (across**2).sum(-1), (across * start).sum(-1)
    # Where the wall is hit.
    reach = (-b + np.sqrt(np.maximum(b * b - a * ((start**2).sum(-1) - radius_m**2), 0))) / a
    deep = np.minimum(-reach * along, depth_m)
    if depth_m:
        gray[inside] = (120 * np.exp(-deep / 0.04))[inside]
        depth[inside] = ((1 / inverse) + deep / -along)[inside]
    else:
        gray[inside] = 15.0
    gray = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 0.6)
    color = np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, 2)
    frame = Frame(color, depth.astype(np.float32), K, np.eye(4), 0.0)
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)[:, None]
    first, second = np.array([1.0, 0, 0]), np.cross(AXIS, [1.0, 0, 0])
    points = CENTER + radius_m * (np.cos(angle) * first + np.sin(angle) * second)
    seen = points @ K.T
    row = conic.fit_ellipses((seen[:, :2] / seen[:, 2:])[None], np.ones((1, 90)))[0]
    ellipse = Ellipse(*map(float, row), rms_px=0.05, coverage=1.0, score=0.9)
    return frame, Masks(np.ones(inverse.shape, np.float32), None), ellipse


def both_views(
    m: np.ndarray, pull_px: float, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a plane's grain, of variance one before it is smoothed, as both cameras see it, `(480, 640)` each."""
    grain = cv2.GaussianBlur(generator.normal(0, 1, (480, 900)).astype(np.float32), (0, 0), 1.2)
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    # the right camera sees at column x what the left one has at u = x + pull (m . ray(u)), solved
    # for u
    x = u - pull_px * (m[0] * (u - K[0, 2]) / K[0, 0] + m[1] * (v - K[1, 2]) / K[1, 1] + m[2])
    back = (u - x[:, :1]) / (1 - pull_px * m[0] / K[0, 0])
    place = (back + 200).astype(np.float32), v.astype(np.float32)
    return grain[:, 200:840], cv2.remap(grain, *place, cv2.INTER_CUBIC)


def as_color(gray: np.ndarray) -> np.ndarray:
    """Returns a grey picture, `(h, w)`, as one of colour."""
    return np.repeat(np.rint(np.clip(gray, 0, 255)).astype(np.uint8)[..., None], 3, 2)


def blank(height: int, width: int, **changes: Any) -> Frame:
    """Returns a black frame whose depth is 1 m everywhere."""
    color, depth_m = as_color(np.zeros((height, width))), np.ones((height, width), np.float32)
    return replace(Frame(color, depth_m, np.eye(3), None, 0.0), **changes)
