"""Light on the wall of a hole in dust, which a flat disc does not have.

Dust adds light that changes slowly, so offset and gradient of the inside say nothing: they are
fitted along. The known circle and plane of the face give the place on the wall that each pixel
would show. Two kinds of light are looked for there. Light of the sky fades with depth, and is bright
below the far part of the rim. Light of the sun ends where the shadow of the near rim falls on the
wall; its direction is searched.
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
# and changed their median error by 0.4 mm at most. Pairs, SUN_DIRECTIONS and MOST_PIXELS were not varied.
LEAST_INSIDE, LEAST_POWER, SMOOTH_PX = 60, 0.1, 1.5
"""Least pixels inside and on the face; least sum of squares of the expected light, in pixels that
are fully lit; blur before the darkest quarter is taken, px."""
WALL_SKY, DISC_SKY = (0.27, 0.13), (0.0, 0.035)
"""Mean and standard deviation of the share of the sky on the wall of holes and on flat discs in
dust, for 120 holes and 232 discs at 1 to 4 m of seed 1001 of dust.py (commit 1bfbfc41); half of
them give the same within 0.02."""
SUN_DIRECTIONS, SUN_HEIGHTS = 24, (0.15, 0.3, 0.6, 1.0, 1.7, 3.0)
"""Directions of the sun around the axis that are tried, and tangents of its height over the face."""
SUN_PX, MOST_PIXELS, LEAST_LIT = 1.0, 1500, 0.002
"""Blur of the picture; pixels that are looked at, enough for lit parts, which are wide; least mean
square of the expected light: a few lit pixels are an accident of the noise."""
WALL_SUN, DISC_SUN = (-1.78, 0.60), (-2.86, 0.57)
"""Mean and standard deviation of the logarithm of the share of the sun: the best of all directions
is above 0 on discs too. Of 187 holes and 166 discs at 1 to 4 m in the first 12 scenes of seed 1001,
both sensors, bounced light, with two or three holes in a scene instead of one."""
WALL_EXPLAINED, DISC_EXPLAINED = (-1.35, 0.68), (-2.49, 0.86)
"""The same of the part of the variance that the sun explains."""


@dataclass(frozen=True)
class WallLight:
    """Light on the wall inside a rim.

    Attributes:
        sky: Brightness of the wall at the rim over that of the depth of the hole, in parts of the
            contrast between face and darkest quarter of the inside.
        sky_std: Its standard deviation by the noise of the picture.
        sun: Brightness by the sun in the direction that explains most, in the same parts.
        explained: Part of the variance inside that it explains.
    """

    sky: float
    sky_std: float
    sun: float = 0.0
    explained: float = 0.0

    @property
    def log_ratio(self) -> float:
        """Log-likelihood ratio of a hole to a flat disc; 0 where the share of the sky is impossible.

        By the light that tells more: a wall in the shade shows the sky, and a sunlit one hides it.
        Both signs of the sun have to agree. No wall is brighter than the face, and none is darker
        than the depth below it.
        """
        if not abs(self.sky) <= 1.0:
            return 0.0
        wall, disc = (
            (mean, float(np.hypot(std, self.sky_std))) for mean, std in (WALL_SKY, DISC_SKY)
        )
        by_sky = _compute_log_ratio(self.sky, wall, disc)
        if not (0.0 < self.sun <= 1.0 and self.explained > 0.0):
            return by_sky
        by_share = _compute_log_ratio(float(np.log(self.sun)), WALL_SUN, DISC_SUN)
        by_part = _compute_log_ratio(float(np.log(self.explained)), WALL_EXPLAINED, DISC_EXPLAINED)
        return max(by_sky, min(by_share, by_part))


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
    reach = a * RING[1] + 2
    top, left = max(0, int(y - reach)), max(0, int(x - reach))
    bottom, right = min(len(light), int(y + reach) + 2), min(len(light[0]), int(x + reach) + 2)
    part = light[top:bottom, left:right].astype(np.float32)
    rows, columns = np.mgrid[top:bottom, left:right]
    radii = conic.measure_radii(ellipse, columns, rows)
    with np.errstate(invalid="ignore", divide="ignore"):
        nearer = 1.0 / depth_m[top:bottom, left:right] - plane.inverse_depth(
            camera_matrix, columns, rows
        )
    before = (nearer > 4 * plane.sigma).astype(np.uint8)
    free = cv2.dilate(before, np.ones((5, 5), np.uint8)) == 0
    inside = free & (radii < min(OUTERMOST, 1.0 - BRINK_PX / b))
    ring = free & (radii > RING[0]) & (radii < RING[1])
    if inside.sum() < LEAST_INSIDE or ring.sum() < LEAST_INSIDE:
        return WallLight(np.nan, np.nan)
    smooth = cv2.GaussianBlur(part, (0, 0), SMOOTH_PX)
    contrast = max(float(np.median(part[ring]) - np.percentile(smooth[inside], 25.0)), 1.0)
    pixels = np.column_stack([columns[inside], rows[inside], np.ones(int(inside.sum()))])
    rays = pixels @ np.linalg.inv(camera_matrix).T
    depths, around = _find_wall_places(rays, plane.normal, center_m, radius_m)
    dust = np.column_stack([np.ones(len(pixels)), (pixels[:, :2] - (x, y)) / a])
    sky, sky_std = _fit_sky(part[inside].astype(float), dust, depths / radius_m)
    # A regular grid of the pixels is enough for the sun.
    step = max(1, int(np.sqrt(len(pixels) / MOST_PIXELS)))
    some = (pixels[:, 0] % step == 0) & (pixels[:, 1] % step == 0)
    values = cv2.GaussianBlur(part, (0, 0), SUN_PX)[inside][some].astype(float)
    sun, explained = _fit_sun(values, dust[some], depths[some] / radius_m, around[some])
    return WallLight(sky / contrast, sky_std / contrast, sun / contrast, explained)


def _compute_log_ratio(value: float, wall: tuple[float, float], disc: tuple[float, float]) -> float:
    """Return the log ratio of two normal densities, given by mean and standard deviation."""
    log_density = [-0.5 * ((value - mean) / std) ** 2 - np.log(std) for mean, std in (wall, disc)]
    return float(log_density[0] - log_density[1])


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


def _fit_sun(
    values: np.ndarray, dust: np.ndarray, depths: np.ndarray, around: np.ndarray
) -> tuple[float, float]:
    """Return the light of the sun that explains most, and the part of the variance that it does.

    A place on the wall is lit if its ray to the sun leaves through the mouth: where its depth is
    below `2 c tan(height)` radii, with `c` the cosine between its own direction and that away from
    the sun. `c` is the cosine of incidence too, but for a constant.

    Args:
        values: Brightness, `(P,)`.
        dust: Light of the dust: offset and gradient, `(P, 3)`.
        depths: Of the wall at each pixel, `(P,)` radii.
        around: Direction of the wall from the axis, `(P, 2)`.
    """
    angles = np.linspace(0.0, 2 * np.pi, SUN_DIRECTIONS, endpoint=False)
    facing = np.maximum(around @ np.stack([np.cos(angles), np.sin(angles)]), 0.0)
    lit = []
    for height in SUN_HEIGHTS:
        lit.append(facing * (depths[:, None] <= 2.0 * height * facing))
    values, patterns = _remove_fit(dust, values), _remove_fit(dust, np.concatenate(lit, axis=1))
    power = (patterns**2).sum(0)
    counted = power > LEAST_LIT * len(values)
    whole = float(values @ values)
    if not counted.any() or whole <= 0.0:
        return 0.0, 0.0
    light = np.maximum(patterns[:, counted].T @ values, 0.0) / power[counted]
    gains = light**2 * power[counted]
    best = int(gains.argmax())
    return float(light[best]), float(gains[best]) / whole


def _remove_fit(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return what a fit by columns leaves of values (Frisch and Waugh 1933)."""
    return values - columns @ np.linalg.solve(columns.T @ columns, columns.T @ values)


def _find_wall_places(
    rays: np.ndarray, normal: np.ndarray, center_m: np.ndarray, radius_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays `(P, 3)` meet the wall of a hole.

    Returns:
        Depth behind the face, m, `(P,)`, and the direction from the axis, `(P, 2)`, in two
        fixed coordinates on the face.
    """
    across = rays - np.outer(rays @ normal, normal)
    middle = center_m - (center_m @ normal) * normal
    square, mixed = (across**2).sum(1), across @ middle
    # A ray enters through the mouth, so it meets the cylinder at the farther of two places.
    root = np.sqrt(np.maximum(mixed**2 - square * (middle @ middle - radius_m**2), 0.0))
    places_m = ((mixed + root) / np.maximum(square, 1e-12))[:, None] * rays - center_m
    axes = np.linalg.svd(normal[None])[2][1:]
    return np.maximum(-places_m @ normal, 0.0), places_m @ axes.T / radius_m
