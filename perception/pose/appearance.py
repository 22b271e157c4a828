"""Appearance of a hole beside a flat dark disc: darkness, and brightness and depth inside."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.ellipse import conic
from perception.pose.plane import FacePlane
from perception.robust_fit import fit_linear

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
    gray: np.ndarray,
    depth_m: np.ndarray,
    ellipse: np.ndarray,
    camera_matrix: np.ndarray,
    plane: FacePlane,
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
    smooth = cv2.GaussianBlur(
        part, (0, 0), max(0.15 * float(np.sqrt(ellipse[2] * ellipse[3])), 0.6)
    )
    # Brighter pixels without depth show a lit arm before the hole.
    inside &= smooth < face
    depth = depth_m[box]
    known = np.isfinite(depth)
    behind = plane.inverse_depth(camera_matrix, columns, rows) - 1.0 / np.where(
        known, depth, np.inf
    )
    # An occluder hides a part of the inside.
    before = (known & (behind < -4 * plane.sigma)).astype(np.uint8)
    nearer = float(np.mean(before[inside]))
    inside &= cv2.dilate(before, np.ones((5, 5), np.uint8)) == 0
    if inside.sum() < 8:
        return Interior(np.nan, np.nan, np.nan, np.nan, nearer, np.nan, np.nan)
    values = smooth[inside]
    darkness = float(np.percentile(values, 25.0)) / face
    unknown = float(np.mean(~known[inside]))
    middle = np.linalg.solve(camera_matrix, np.array([x, y, 1.0]))
    clearly = max(4 * plane.sigma, CLEARLY_M * float(plane.m @ middle) ** 2)
    deeper = float(np.mean(behind[inside & known] > clearly)) if (inside & known).any() else 0.0
    into = camera_matrix[:2, :2] @ (-plane.normal[:2] + plane.normal[2] * middle[:2])
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
    around = _measure_darkest_around(gray, depth_m, ellipse, camera_matrix, plane) / face
    return Interior(
        darkness,
        slope,
        deeper,
        unknown,
        nearer,
        around,
        _measure_contrast(smooth[ring], face * darkness),
    )


def _measure_contrast(ring: np.ndarray, dark: float) -> float:
    """Return the difference between a ring and `dark`, in standard deviations of its grain.

    The edge of a shadow across the ring is no grain: only the darker of its two parts (Otsu 1979)
    counts.
    """
    limit = cv2.threshold(
        np.rint(ring).clip(0, 255).astype(np.uint8).reshape(-1, 1),
        0,
        255,
        cv2.THRESH_BINARY + cv2.THRESH_OTSU,
    )[0]
    part = ring[ring <= limit + 0.5]
    part = part if len(part) > 0.2 * len(ring) else ring
    level = float(np.median(part))
    grain = 1.4826 * float(np.median(np.abs(part - level)))
    return (level - dark) / max(grain, 1.0)


def _measure_darkest_around(
    gray: np.ndarray,
    depth_m: np.ndarray,
    ellipse: np.ndarray,
    camera_matrix: np.ndarray,
    plane: FacePlane,
) -> float:
    """Return the grey level of the darkest hundredth of face and background around an ellipse.

    0 where occluders hide all of it.
    """
    x, y, wide = ellipse[0], ellipse[1], WIDE * ellipse[2]
    step = max(2, int(wide / 60))
    rows = np.arange(max(0, int(y - wide)), min(len(gray), int(y + wide)), step)
    columns = np.arange(max(0, int(x - wide)), min(len(gray[0]), int(x + wide)), step)
    near = gray[np.ix_(rows, columns)]
    here = plane.inverse_depth(camera_matrix, columns[None, :], rows[:, None])
    # False where depth is unknown.
    behind = here - 1.0 / depth_m[np.ix_(rows, columns)] > -4 * plane.sigma
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
