"""Appearance of a hole beside a flat dark disc: darkness, slope and depth inside, light on the wall.

Dust adds light that changes slowly, so offset and gradient of the inside say nothing: they are fitted
along. The known circle and plane of the face give the place on the wall that each pixel would show.
Light of the sky fades there with depth, and is bright below the far part of the rim. Light of the sun
was looked for too, and changed no decision on 16 holes and 30 flat discs in haze.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from brokk_rl.signals import Frame
from perception.ellipse import conic
from perception.pose.plane import FacePlane
from perception.pose.rim import RimCircle
from perception.robust_fit import estimate_spread, fit_linear

# Each of these times 0.8 or 1.25 left every count of holes and discs in 8 rendered frames as it was,
# and changed their median error by 0.4 mm at most. RING was not varied.
INSIDE, RING = 0.8, (1.15, 1.8)
"""Radii of the inside without the rim's blur, and of the ring that shows the brightness of the
face."""
WIDE = 8.0
"""Radii of the surroundings, in which something else is dark too unless there is dust."""
FAINTEST = 0.1
"""Least logarithm of the contrast, so that a hole in dense dust has no boundless slope."""
CLEARLY_M = 0.03
"""Least distance behind the face at which depth belongs to the inside of a hole, whatever the
noise."""


@dataclass(frozen=True)
class Interior:
    """Appearance of the inside of an ellipse.

    Attributes:
        darkness: Brightness of its darkest quarter over that of the face around it.
        slope: Change of brightness over one radius, over the contrast between face and darkest
            quarter, in the direction in which the hole goes on behind the face; both of the
            logarithm, so that the exponent of the camera's tone curve cancels. The camera sees
            the lit end of the wall near the far rim and the dark depth at the near rim: clearly
            negative in a hole, about zero on a disc.
        deeper: Part of the known depth inside that lies clearly behind the face.
        unknown: Part of the inside without depth.
        nearer: Part of the inside whose depth is known and before the face.
        around: Brightness of the darkest hundredth of the surroundings over that of the face;
            occluders are left out, since there is less dust before them.
        contrast: Difference between the darker part of the face and the darkest quarter, in
            standard deviations of the grain.
    """

    darkness: float
    slope: float
    deeper: float
    unknown: float
    nearer: float
    around: float
    contrast: float


def measure_interior(
    gray: np.ndarray, frame: Frame, ellipse: np.ndarray, plane: FacePlane
) -> Interior:
    """Return the appearance inside an ellipse `(5,)` on a face."""
    x, y, a = ellipse[:3]
    box = conic.bound_ellipse(ellipse, a * RING[1] + 2, gray.shape)
    part = gray[box].astype(np.float32)
    rows, columns = np.mgrid[box]
    radii = conic.measure_radii(ellipse, columns, rows)
    inside, ring = radii < INSIDE, (radii > RING[0]) & (radii < RING[1])
    if inside.sum() < 8 or ring.sum() < 8:
        return Interior(*[np.nan] * 7)
    face = max(float(np.median(part[ring])), 1.0)
    blur_px = max(0.15 * float(np.sqrt(ellipse[2] * ellipse[3])), 0.6)
    smooth = cv2.GaussianBlur(part, (0, 0), blur_px)
    # Brighter pixels without depth show a lit arm before the hole.
    inside &= smooth < face
    depth, matrix = frame.depth_m[box], frame.camera_matrix
    known = np.isfinite(depth)
    behind = plane.inverse_depth(matrix, columns, rows) - 1.0 / np.where(known, depth, np.inf)
    # An occluder hides a part of the inside.
    before = (known & (behind < -4 * plane.sigma)).astype(np.uint8)
    nearer = float(np.mean(before[inside]))
    inside &= cv2.dilate(before, np.ones((5, 5), np.uint8)) == 0
    if inside.sum() < 8:
        return Interior(np.nan, np.nan, np.nan, np.nan, nearer, np.nan, np.nan)
    values = smooth[inside]
    darkness = float(np.percentile(values, 25.0)) / face
    unknown = float(np.mean(~known[inside]))
    middle = np.linalg.solve(matrix, np.array([x, y, 1.0]))
    clearly = max(4 * plane.sigma, CLEARLY_M * float(plane.m @ middle) ** 2)
    deeper = float(np.mean(behind[inside & known] > clearly)) if (inside & known).any() else 0.0
    into = matrix[:2, :2] @ (-plane.normal[:2] + plane.normal[2] * middle[:2])
    places = np.stack([columns - x, rows - y], -1)
    away = places[inside]
    along = away @ (into / max(float(np.linalg.norm(into)), 1e-9)) / a
    # Uneven light changes hole and face by the same factor: take the face's change off.
    level = np.log(part[ring] + 1.0)
    drift = _fit_brightness_gradient(level, places[ring])
    values = np.log(values + 1.0) - away @ drift
    contrast = float(np.log((face + 1.0) / (face * darkness + 1.0)))
    apart = along - along.mean()
    slope = float(apart @ values / max(float(apart @ apart), 1e-9))
    slope /= max(contrast, FAINTEST)
    around = _measure_darkest_around(gray, frame, ellipse, plane) / face
    grainy = _measure_contrast(smooth[ring], face * darkness)
    return Interior(darkness, slope, deeper, unknown, nearer, around, grainy)


def _measure_contrast(ring: np.ndarray, dark: float) -> float:
    """Return the difference between a ring and `dark`, in standard deviations of its grain.

    The edge of a shadow across the ring is no grain: only the darker of its two parts (Otsu 1979)
    counts.
    """
    levels = np.rint(ring).clip(0, 255).astype(np.uint8).reshape(-1, 1)
    limit, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    part = ring[ring <= limit + 0.5]
    part = part if len(part) > 0.2 * len(ring) else ring
    level = float(np.median(part))
    grain = estimate_spread(part - level)
    return (level - dark) / max(grain, 1.0)


def _measure_darkest_around(
    gray: np.ndarray, frame: Frame, ellipse: np.ndarray, plane: FacePlane
) -> float:
    """Return the grey level of the darkest hundredth of face and background around an ellipse.

    0 where occluders hide all of it.
    """
    x, y, wide = ellipse[0], ellipse[1], WIDE * ellipse[2]
    step = max(2, int(wide / 60))
    rows = np.arange(max(0, int(y - wide)), min(len(gray), int(y + wide)), step)
    columns = np.arange(max(0, int(x - wide)), min(len(gray[0]), int(x + wide)), step)
    near = gray[np.ix_(rows, columns)]
    here = plane.inverse_depth(frame.camera_matrix, columns[None, :], rows[:, None])
    # False where depth is unknown.
    behind = here - 1.0 / frame.depth_m[np.ix_(rows, columns)] > -4 * plane.sigma
    near = near[cv2.erode(behind.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0]
    return float(np.percentile(near, 1.0)) if near.size else 0.0


def _fit_brightness_gradient(values: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Fit the gradient of values `(P,)` over places `(P, 2)`, `(2,)` a pixel.

    Robust: outliers count nothing.
    """
    design = np.column_stack([away, np.ones(len(away))])
    # Not zero on a face without grain.
    return fit_linear(design, values.astype(float), 1e-3, num_rounds=3)[0][:2]


def average_inside(picture: np.ndarray, row: np.ndarray) -> float:
    """Return the mean of a picture within 0.8 of an ellipse."""
    # The semi-major axis bounds the ellipse, however it is turned.
    box = conic.bound_ellipse(row, row[2], picture.shape)
    rows, columns = np.ogrid[box]
    # 0.8 leaves out the blurred edge of the rim.
    inside = conic.measure_radii(row, columns, rows) < 0.8
    return float(picture[box][inside].mean()) if inside.any() else 0.0


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
    light: np.ndarray, frame: Frame, circle: RimCircle, plane: FacePlane
) -> WallLight:
    """Measure the light on the wall that a hole would have behind its rim, NaN for too few pixels.

    The gradient on the face does not tell that of the dust inside, since dust about as bright as
    the face hardly changes the face.

    Args:
        light: Picture in linear light, `(h, w)`.
        frame: Gives the depth; occluders are left out.
        circle: Rim.
        plane: Plane of the face.
    """
    ellipse, matrix = circle.ellipse, frame.camera_matrix
    x, y, a, b = ellipse[:4]
    box = conic.bound_ellipse(ellipse, a * RING[1] + 2, light.shape)
    part = light[box].astype(np.float32)
    rows, columns = np.mgrid[box]
    radii = conic.measure_radii(ellipse, columns, rows)
    before = plane.find_nearer(frame.depth_m[box], matrix, columns, rows)
    free = cv2.dilate(before.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    inside = free & (radii < min(OUTERMOST, 1.0 - BRINK_PX / b))
    ring = free & (radii > RING[0]) & (radii < RING[1])
    if inside.sum() < LEAST_INSIDE or ring.sum() < LEAST_INSIDE:
        return WallLight(np.nan, np.nan)
    smooth = cv2.GaussianBlur(part, (0, 0), SMOOTH_PX)
    contrast = max(float(np.median(part[ring]) - np.percentile(smooth[inside], 25.0)), 1.0)
    pixels = np.column_stack([columns[inside], rows[inside], np.ones(int(inside.sum()))])
    rays = pixels @ np.linalg.inv(matrix).T
    depths = _measure_wall_depths(rays, plane.normal, circle.center_m, circle.radius_m)
    dust = np.column_stack([np.ones(len(pixels)), (pixels[:, :2] - (x, y)) / a])
    sky, sky_std = _fit_sky(part[inside].astype(float), dust, depths / circle.radius_m)
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
