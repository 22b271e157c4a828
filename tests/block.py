"""A camera above a block with three boreholes: pictures and depth with noise, the same each time."""

from __future__ import annotations

import numpy as np
from cuboid import looking, sight

from brokk_rl.signals import Frame
from deploy.page.protocol import BoreholeChoice

BLOCK_M = ((1.9, -0.8, 0.0), (3.3, 0.8, 0.75))
UP = (0.0, 0.0, 1.0)
TARGETS = (
    BoreholeChoice("1", (2.6, 0.0, 0.75), UP, 0.06, 0.002, 0.97, False),
    BoreholeChoice("2", (2.25, 0.4, 0.75), UP, 0.06, 0.004, 0.86, False),
    BoreholeChoice("3", (2.95, -0.4, 0.75), UP, 0.06, 0.011, 0.41, False),
)
POSE = looking((0.1, 0.33, 1.6), (2.7, 0.0, 0.5))
FOCAL = 0.915
"""Focal length over the width: one radian is seen across it."""
NOISE, GRAIN = 0.002, 9.0
"""Standard deviation of depth over depth, as a stereo camera's at 2 m, and of the picture's grain."""
FARTHEST_M = 12.0
"""Depth beyond which the ground is not measured."""


def seen_at(frame: Frame, center_m: np.ndarray) -> tuple[float, float]:
    """Returns where in the picture a point of the base frame is, as parts of width and height."""
    from_base = np.linalg.inv(frame.base_from_camera)
    u, v, w = frame.camera_matrix @ (from_base[:3, :3] @ center_m + from_base[:3, 3])
    height, width = frame.depth_m.shape
    return (u / w + 0.5) / width, (v / w + 0.5) / height


def take_frame(size_px: tuple[int, int], number: int, t_s: float) -> Frame:
    """Returns the `number`-th frame, taken at `t_s`; the scene stands still, the noise does not."""
    matrix, way = sight(POSE, size_px, FOCAL * size_px[0])
    eye_m, (low, high) = POSE[:3, 3], np.array(BLOCK_M)
    enter, leave = np.sort(np.stack([(low - eye_m) / way, (high - eye_m) / way]), 0)
    near, face = enter.max(-1), enter.argmax(-1)
    hit = (near < leave.min(-1)) & (near > 0)
    ground = np.where(way[..., 2] < 0, -eye_m[2] / way[..., 2], np.nan)
    depth_m = np.where(hit, near, np.where(ground > FARTHEST_M, np.nan, ground))
    shade = np.where(hit, np.array([150.0, 128.0, 186.0])[face], 96.0)
    point_m = eye_m + np.nan_to_num(depth_m)[..., None] * way
    for hole in TARGETS:
        beside_m = np.linalg.norm(point_m[..., :2] - hole.center_in_base_m[:2], axis=-1)
        inside = hit & (face == 2) & (beside_m < hole.radius_m)
        depth_m = np.where(inside, np.nan, depth_m)  # stereo sees nothing in a dark hole
        shade[inside] = 22.0
    chance = np.random.default_rng(number)
    depth_m = depth_m * (1.0 + NOISE * chance.standard_normal(depth_m.shape))
    color = shade[..., None] * [1.0, 0.98, 0.93] + GRAIN * chance.standard_normal((*shade.shape, 1))
    picture = color.clip(0, 255).astype(np.uint8)
    return Frame(picture, depth_m.astype(np.float32), matrix, POSE, t_s)
