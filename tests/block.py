"""A camera above a block with three boreholes: pictures and depth with noise, the same each time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.signals import Frame
from deploy.page.protocol import BoreholeChoice, Vector

BLOCK_M = ((1.9, -0.8, 0.0), (3.3, 0.8, 0.75))
UP = (0.0, 0.0, 1.0)
TARGETS = (
    BoreholeChoice("1", (2.6, 0.0, 0.75), UP, 0.06, 0.002, 0.97, False),
    BoreholeChoice("2", (2.25, 0.4, 0.75), UP, 0.06, 0.004, 0.86, False),
    BoreholeChoice("3", (2.95, -0.4, 0.75), UP, 0.06, 0.011, 0.41, False),
)
EYE_M, LOOK_AT_M = np.array([0.1, 0.33, 1.6]), np.array([2.7, 0.0, 0.5])
FOV_RAD = 1.0
"""Across the width."""
NOISE = 0.002
"""Standard deviation of depth over depth, as a stereo camera's at 2 m."""
FARTHEST_M = 12.0
"""Depth beyond which the ground is not measured."""
FINE_GRAIN, COARSE_GRAIN, GRAIN_PX = 9.0, 5.0, 8
"""Standard deviations of the grain of the picture, and the size of the coarse one."""
NOISE_STEP_PX = 37
"""Shift of the noise from frame to frame."""
SEED = 7


class BlockCamera:
    """Makes frames; the scene stands still, the noise does not.

    Args:
        width: Of the picture, px.
        height: Of the picture, px.
        block: Two opposite corners of the block in the base frame, m.
        holes: Boreholes in its upper face.
    """

    def __init__(
        self, width: int, height: int, block: tuple[Vector, Vector], holes: Sequence[BoreholeChoice]
    ) -> None:
        ahead = (LOOK_AT_M - EYE_M) / np.linalg.norm(LOOK_AT_M - EYE_M)
        # The camera is level: its right is horizontal.
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._pose = np.eye(4)
        self._pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], 1)
        self._pose[:3, 3] = EYE_M
        # Pinhole camera by its field of view across the width.
        focal = width / 2 / np.tan(FOV_RAD / 2)
        self._matrix = np.array(
            [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
        )
        v, u = np.mgrid[:height, :width]
        across, down = (u - self._matrix[0, 2]) / focal, (v - self._matrix[1, 2]) / focal
        rays = np.stack([across, down, np.ones_like(u, float)], -1)
        way = rays @ self._pose[:3, :3].T  # one m of depth along each
        chance = np.random.default_rng(SEED)
        self._depth_m, shade = _render_scene(way, block, holes)
        fine = chance.normal(0.0, FINE_GRAIN, (height, width, 1))
        cells = chance.normal(0.0, COARSE_GRAIN, (height // GRAIN_PX + 1, width // GRAIN_PX + 1))
        coarse = cells.repeat(GRAIN_PX, 0).repeat(GRAIN_PX, 1)[:height, :width, None]
        grain = fine + coarse
        self._color = (shade + grain).clip(0, 255).astype(np.uint8)
        # Twice as wide: a shifted window of it serves each frame as fresh noise.
        self._noise = chance.normal(0.0, NOISE, (height, 2 * width)).astype(np.float32)

    def take_frame(self, number: int, t_s: float) -> Frame:
        """Return the `number`-th frame, taken at `t_s`."""
        width = self._color.shape[1]
        start = number * NOISE_STEP_PX % width
        depth_m = self._depth_m * (1.0 + self._noise[:, start : start + width])
        return Frame(self._color, depth_m, self._matrix, self._pose, t_s)


def _render_scene(
    way: np.ndarray, block: tuple[Vector, Vector], holes: Sequence[BoreholeChoice]
) -> tuple[np.ndarray, np.ndarray]:
    """Return depth `(h, w)` in m, float32, NaN where unknown, and colour `(h, w, 3)`.

    The rays `way`, `(h, w, 3)`, begin at `EYE_M`.
    """
    low, high = np.array(block[0]), np.array(block[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = np.sort(np.stack([(low - EYE_M) / way, (high - EYE_M) / way]), 0)
        near, face = enter.max(-1), enter.argmax(-1)
        hit = (near < leave.min(-1)) & (near > 0)
        ground = np.where(way[..., 2] < 0, -EYE_M[2] / way[..., 2], np.nan)
    ground[ground > FARTHEST_M] = np.nan
    depth_m = np.where(hit, near, ground)
    shade = np.where(hit[..., None], np.array([[150.0], [128.0], [186.0]])[face], 96.0) * np.array(
        [1.0, 0.98, 0.93]
    )
    point_m = EYE_M + np.nan_to_num(depth_m)[..., None] * way
    for hole in holes:
        beside_m = np.linalg.norm(point_m[..., :2] - hole.center_in_base_m[:2], axis=-1)
        inside = hit & (face == 2) & (beside_m < hole.radius_m)
        depth_m = np.where(inside, np.nan, depth_m)  # stereo sees nothing in a dark hole
        shade[inside] = 22.0
    shade[np.isnan(depth_m) & ~hit] = [170.0, 200.0, 225.0]
    return depth_m.astype(np.float32), shade
