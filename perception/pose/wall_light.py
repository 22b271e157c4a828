"""Light on the wall of a hole in dust, which a flat disc does not have.

Dust adds light that changes slowly, so offset and gradient of the inside say nothing: they are
fitted along. The known circle and plane of the face give the place on the wall that each pixel
would show. Light of the sky fades there with depth, and is bright below the far part of the rim. Light
of the sun was looked for too, and changed no decision on 16 holes and 30 flat discs in haze.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.ellipse import conic
from perception.pose.appearance import RING
from perception.pose.plane import FacePlane

FADE, BRINK_PX, OUTERMOST = 0.3, 1.5, 0.95
"""Depth at which the light of the sky has faded to 1 / e, in radii; px within the rim that its blur
reaches, and largest radius without it. FADE was the best of 0.3, 0.5 and 1 on scenes of seed 1001."""
IN_DUST = "log-likelihood ratio of a hole to a flat disc"
"""Reason for a refusal in dust: it cannot be told, or it is a disc."""
# Each of these times 0.8 or 1.25 left every count of holes and discs in 8 rendered frames as it was,
# and changed their median error by 0.4 mm at most. Pairs were not varied.
LEAST_INSIDE, LEAST_POWER, SMOOTH_PX = 60, 0.1, 1.5
"""Least pixels inside and on the face; least sum of squares of the expected light, in pixels that
are fully lit; blur before the darkest quarter is taken, px."""
WALL_SKY, DISC_SKY = (0.27, 0.13), (0.0, 0.035)
"""Mean and standard deviation of the share of the sky on the wall of holes and on flat discs in
dust, for 120 holes and 232 discs at 1 to 4 m of seed 1001 of dust.py (commit 1bfbfc41); half of
them give the same within 0.02."""


@dataclass(frozen=True)
class WallLight:
    """Light on the wall inside a rim.

    Attributes:
        sky: Brightness of the wall at the rim over that of the depth of the hole, in parts of the
            contrast between face and darkest quarter of the inside.
        sky_std: Its standard deviation by the noise of the picture.
    """

    sky: float
    sky_std: float

    @property
    def log_ratio(self) -> float:
        """Log-likelihood ratio of a hole to a flat disc; 0 where the share of the sky is impossible.

        No wall is brighter than the face, and none is darker than the depth below it.
        """
        if not abs(self.sky) <= 1.0:
            return 0.0
        log_density = []
        for mean, own_std in (WALL_SKY, DISC_SKY):
            std = float(np.hypot(own_std, self.sky_std))
            log_density.append(-0.5 * ((self.sky - mean) / std) ** 2 - np.log(std))
        return float(log_density[0] - log_density[1])


def measure_wall_light(
    light: np.ndarray,
    depth_m: np.ndarray,
    ellipse: np.ndarray,
    camera_matrix: np.ndarray,
    plane: FacePlane,
    center_m: np.ndarray,
    radius_m: float,
) -> WallLight:
    """Measure the light on the wall that a hole would have behind its rim, NaN for too few pixels.

    The gradient on the face does not tell that of the dust inside, since dust about as bright as
    the face hardly changes the face.

    Args:
        light: Picture in linear light, `(h, w)`.
        depth_m: Depth, `(h, w)`; occluders are left out.
        ellipse: Rim, `(5,)`.
        camera_matrix: Camera matrix, `(3, 3)`.
        plane: Plane of the face.
        center_m: Centre of the rim in camera coordinates, `(3,)`.
        radius_m: Its radius.
    """
    x, y, a, b = ellipse[:4]
    box = conic.bound_ellipse(ellipse, a * RING[1] + 2, light.shape)
    part = light[box].astype(np.float32)
    rows, columns = np.mgrid[box]
    radii = conic.measure_radii(ellipse, columns, rows)
    before = plane.find_nearer(depth_m[box], camera_matrix, columns, rows)
    free = cv2.dilate(before.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    inside = free & (radii < min(OUTERMOST, 1.0 - BRINK_PX / b))
    ring = free & (radii > RING[0]) & (radii < RING[1])
    if inside.sum() < LEAST_INSIDE or ring.sum() < LEAST_INSIDE:
        return WallLight(np.nan, np.nan)
    smooth = cv2.GaussianBlur(part, (0, 0), SMOOTH_PX)
    contrast = max(float(np.median(part[ring]) - np.percentile(smooth[inside], 25.0)), 1.0)
    pixels = np.column_stack([columns[inside], rows[inside], np.ones(int(inside.sum()))])
    rays = pixels @ np.linalg.inv(camera_matrix).T
    depths = _measure_wall_depths(rays, plane.normal, center_m, radius_m)
    dust = np.column_stack([np.ones(len(pixels)), (pixels[:, :2] - (x, y)) / a])
    sky, sky_std = _fit_sky(part[inside].astype(float), dust, depths / radius_m)
    return WallLight(sky / contrast, sky_std / contrast)


def _fit_sky(values: np.ndarray, dust: np.ndarray, depths: np.ndarray) -> tuple[float, float]:
    """Return the light of the sky at the rim and its standard deviation, NaN for no wall in sight.

    Args:
        values: Brightness, `(P,)`.
        dust: Light of the dust: offset and gradient, `(P, 3)`.
        depths: Of the wall at each pixel, `(P,)` radii.
    """
    lit = np.exp(-depths / FADE)
    values, lit = _remove_fit(dust, values), _remove_fit(dust, lit)
    # Seen along its axis a hole shows no wall.
    power = float(lit @ lit)
    if power < LEAST_POWER:
        return np.nan, np.nan
    glow = float(lit @ values) / power
    return glow, float(np.std(values - glow * lit)) / float(np.sqrt(power))


def _remove_fit(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return what a fit by columns leaves of values (Frisch and Waugh 1933)."""
    return values - columns @ np.linalg.solve(columns.T @ columns, columns.T @ values)


def _measure_wall_depths(
    rays: np.ndarray, normal: np.ndarray, center_m: np.ndarray, radius_m: float
) -> np.ndarray:
    """Return how far behind the face rays `(P, 3)` meet the wall of a hole, m, `(P,)`."""
    across = rays - np.outer(rays @ normal, normal)
    middle = center_m - (center_m @ normal) * normal
    square, mixed = (across**2).sum(1), across @ middle
    # A ray enters through the mouth, so it meets the cylinder at the farther of two places.
    root = np.sqrt(np.maximum(mixed**2 - square * (middle @ middle - radius_m**2), 0.0))
    places_m = ((mixed + root) / np.maximum(square, 1e-12))[:, None] * rays - center_m
    return np.maximum(-places_m @ normal, 0.0)
