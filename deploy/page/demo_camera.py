"""The camera of the made-up machine: a block with boreholes on flat ground, by rays through each pixel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.signals import Frame
from deploy.page.protocol import Target, Vector

EYE_M, LOOK_AT_M = np.array([0.1, 0.33, 1.6]), np.array([2.7, 0.0, 0.5])
FOV_RAD = 1.0
"""Across the width."""
NOISE = 0.002
"""Standard deviation of depth over depth, as a stereo camera's at 2 m."""
SEED = 7


class Camera:
    """Makes frames; the scene stands still, the noise does not.

    Args:
        width: Of the picture, px.
        height: Of the picture, px.
        block: Two opposite corners of the block in the base frame, m.
        holes: Boreholes in its upper face.
    """

    def __init__(
        self, width: int, height: int, block: tuple[Vector, Vector], holes: Sequence[Target]
    ) -> None:
        ahead = (LOOK_AT_M - EYE_M) / np.linalg.norm(LOOK_AT_M - EYE_M)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._pose = np.eye(4)
        self._pose[:3, :3], self._pose[:3, 3] = (
            np.stack([right, np.cross(ahead, right), ahead], 1),
            EYE_M,
        )
        focal = width / 2 / np.tan(FOV_RAD / 2)
        self._matrix = np.array(
            [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
        )
        v, u = np.mgrid[:height, :width]
        rays = np.stack(
            [
                (u - self._matrix[0, 2]) / focal,
                (v - self._matrix[1, 2]) / focal,
                np.ones_like(u, float),
            ],
            -1,
        )
        way = rays @ self._pose[:3, :3].T  # one m of depth along each
        chance = np.random.default_rng(SEED)
        self._depth_m, shade = _scene(way, block, holes)
        grain = (
            chance.normal(0.0, 9.0, (height, width, 1))
            + chance.normal(0.0, 5.0, (height // 8 + 1, width // 8 + 1))
            .repeat(8, 0)
            .repeat(8, 1)[:height, :width, None]
        )
        self._color = (shade + grain).clip(0, 255).astype(np.uint8)
        self._noise = chance.normal(0.0, NOISE, (height, 2 * width)).astype(np.float32)

    def frame(self, number: int, t_s: float) -> Frame:
        """Returns the `number`-th frame, taken at `t_s`."""
        width = self._color.shape[1]
        start = number * 37 % width
        depth_m = self._depth_m * (1.0 + self._noise[:, start : start + width])
        return Frame(self._color, depth_m, self._matrix, self._pose, t_s)


def _scene(
    way: np.ndarray, block: tuple[Vector, Vector], holes: Sequence[Target]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns depth `(h, w)` float32 in m, NaN where nothing is met, and colour `(h, w, 3)`, for rays `way` from `EYE_M`."""
    low, high = np.array(block[0]), np.array(block[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = np.sort(np.stack([(low - EYE_M) / way, (high - EYE_M) / way]), 0)
        near, face = enter.max(-1), enter.argmax(-1)
        hit = (near < leave.min(-1)) & (near > 0)
        ground = np.where(way[..., 2] < 0, -EYE_M[2] / way[..., 2], np.nan)
    ground[ground > 12.0] = np.nan
    depth_m = np.where(hit, near, ground)
    shade = np.where(hit[..., None], np.array([[150.0], [128.0], [186.0]])[face], 96.0) * np.array(
        [1.0, 0.98, 0.93]
    )
    point_m = EYE_M + np.nan_to_num(depth_m)[..., None] * way
    for hole in holes:
        inside = (
            hit
            & (face == 2)
            & (
                np.linalg.norm(point_m[..., :2] - hole.center_in_base_m[:2], axis=-1)
                < hole.radius_m
            )
        )
        depth_m = np.where(inside, np.nan, depth_m)  # stereo sees nothing in a dark hole
        shade[inside] = 22.0
    shade[np.isnan(depth_m) & ~hit] = [170.0, 200.0, 225.0]
    return depth_m.astype(np.float32), shade
