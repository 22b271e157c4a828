"""The block's face around a hole: a plane fitted to inverse depth.

Inverse depth is linear in the picture on a plane, `1/z = m · (x, y, 1)` with `(x, y, 1)` the ray of
a pixel. The noise of a stereo matcher in it is the same at every distance, so that ordinary least
squares weigh all pixels rightly. The plane's normal is `m / |m|`, its distance `1 / |m|`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brokk_rl.signals import Frame
from perception.ellipse import conic
from perception.robust_fit import (
    TUKEY,
    compute_biweight,
    compute_psi_slope,
    estimate_sandwich_covariance,
    guess_plane,
    number_cells,
)

# Each of these times 0.8 or 1.25 left every count of holes and discs in 8 rendered frames as it was,
# and changed their median error by 0.4 mm at most. DEGENERATE and USUAL_PULL_PX_M were not varied.
GROWING = 3.0
"""Limit of the biweight, standard deviations, while the plane is grown: beyond an edge of the block
another face begins at the same depth, and a wider limit would follow it."""
NEARNESS, LEAN = 0.3, 0.4
"""Allowed relative error of inverse depth beside that of a circle of the ellipse's size, and
addition to the slope that its shape allows: occluders differ by more."""
DEGENERATE = 1e12
"""Condition number of a plane's normal equations from which its points lie on a line."""
CLEARLY = 4.0
"""Standard deviations by which an occluder is nearer than a face: no pixel of a face is by chance."""
LEAST = 60
"""Least number of points of a plane."""
USUAL_PULL_PX_M = 126.72
"""Focal length times baseline of the pair for which noise is configured: a ZED 2i at 1080p, 1056 px
and 0.12 m."""


def compare_pair(frame: Frame) -> float:
    """Return a pair's error of inverse depth for one of disparity, over that of the usual pair.

    1 for a camera whose baseline is unknown.
    """
    if frame.baseline_m is None:
        return 1.0
    return USUAL_PULL_PX_M / (float(frame.camera_matrix[0, 0]) * frame.baseline_m)


@dataclass(frozen=True)
class FacePlane:
    """A plane in camera coordinates.

    Attributes:
        m: `(3,)` 1/m; the points `P` with `m · P = 1`.
        cov: Covariance of `m`, `(3, 3)`.
        sigma: Standard deviation of the residuals of inverse depth, 1/m.
        extent: Extent of the support around the ellipse, in radii.
    """

    m: np.ndarray
    cov: np.ndarray
    sigma: float
    extent: float

    @property
    def normal(self) -> np.ndarray:
        """Unit normal towards the camera, `(3,)`."""
        return -self.m / np.linalg.norm(self.m)

    def normal_cov_rad2(self) -> np.ndarray:
        """Return the covariance of the normal, `(3, 3)`, singular along it."""
        length = np.linalg.norm(self.m)
        # Only the direction of `m` matters for the normal, not its length.
        project = (np.eye(3) - np.outer(self.normal, self.normal)) / length
        return project @ self.cov @ project

    def point_cov_m2(self, point_m: np.ndarray, bias_per_m: float) -> np.ndarray:
        """Return the covariance of a point of it, `(3, 3)`, where a ray meets it.

        A small error of inverse depth, of the plane and of `bias_per_m` besides, moves the point by
        depth squared.
        """
        ray = point_m / point_m[2]
        variance = float(ray @ self.cov @ ray) + bias_per_m**2
        return np.outer(ray, ray) * (point_m[2] ** 4 * variance)

    def inverse_depth(self, camera_matrix: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return inverse depth at columns and rows of a picture, which are broadcast."""
        return compute_inverse_depth(self.m, camera_matrix, u, v)

    def find_nearer(
        self, depth_m: np.ndarray, camera_matrix: np.ndarray, u: np.ndarray, v: np.ndarray
    ) -> np.ndarray:
        """Find pixels at columns `u` and rows `v` whose depth lies before it; unknown depth does not."""
        with np.errstate(invalid="ignore", divide="ignore"):
            away = 1.0 / depth_m - self.inverse_depth(camera_matrix, u, v)
            return away > CLEARLY * self.sigma

    def point(self, ray: np.ndarray) -> np.ndarray:
        """Return the point at which a ray `(3,)` with z = 1 meets the plane."""
        return ray / float(self.m @ ray)


@dataclass(frozen=True)
class FaceSupport:
    """Pixels of the face around an ellipse, ordered outwards.

    Attributes:
        rays: `(P, 3)`, z = 1.
        inverse: Inverse depth, `(P,)` 1/m.
        radii: Distance from the ellipse's centre in its own radii, `(P,)`, increasing.
        cell: Number of each pixel's square of the picture, `(P,)`; noise is correlated within one.
    """

    rays: np.ndarray
    inverse: np.ndarray
    radii: np.ndarray
    cell: np.ndarray


def compute_inverse_depth(
    m: np.ndarray, camera_matrix: np.ndarray, u: np.ndarray, v: np.ndarray
) -> np.ndarray:
    """Return inverse depth on the plane `m · P = 1` at columns and rows, which are broadcast."""
    # The plane in pixel coordinates: solved once for all pixels.
    across, down, middle = np.linalg.solve(camera_matrix.T, m)
    return across * u + (down * v + middle)


def collect_support(
    depth_m: np.ndarray,
    allowed: np.ndarray,
    camera_matrix: np.ndarray,
    ellipse: np.ndarray,
    radius_m: float,
    inner: float,
    certain: float,
    outer: float,
    most: int,
    cell_px: int,
) -> FaceSupport:
    """Return the pixels with known depth between `inner` and `outer` radii of an ellipse `(5,)`.

    An ellipse of a circle of known radius tells its distance and slope roughly. Pixels much nearer
    belong to an occluder, much farther ones lie behind the block.

    Args:
        depth_m: `(h, w)`.
        allowed: Pixels of the face, `(h, w)` bool.
        camera_matrix: `(3, 3)`.
        ellipse: Centre, semi-axes, direction.
        radius_m: Radius of the circle.
        inner: Inner limit in radii of the ellipse; leaves out the bleeding of the rim.
        certain: Radii up to which the face surely goes on, whatever `allowed` says.
        outer: Outer limit in radii.
        most: Largest number of pixels; of more, a regular grid is taken.
        cell_px: Side of the squares within which noise is correlated.
    """
    down, across = conic.bound_ellipse(ellipse, ellipse[2] * outer, depth_m.shape)
    # A regular grid keeps the coverage and limits the number of pixels.
    step = max(1, int(np.sqrt(depth_m[down, across].size / most)))
    grid = slice(down.start, down.stop, step), slice(across.start, across.stop, step)
    rows, columns = np.ogrid[grid]
    depth = depth_m[grid]
    radii = conic.measure_radii(ellipse, columns, rows)
    good = (allowed[grid] | (radii < certain)) & np.isfinite(depth) & (depth > 0)
    # The size of the circle in units of the focal length gives its distance roughly.
    size = ellipse[2] / float(np.sqrt(camera_matrix[0, 0] * camera_matrix[1, 1]))
    # The axes' ratio bounds the slope of the face.
    lean = np.sqrt(max((ellipse[2] / ellipse[3]) ** 2 - 1.0, 0.0)) + LEAN
    with np.errstate(divide="ignore", invalid="ignore"):
        good &= np.abs(radius_m / (size * depth) - 1.0) < NEARNESS + radii * size * lean
    good &= (radii > inner) & (radii < outer)
    line, place = np.nonzero(good)
    radii, inverse = radii[good], 1.0 / depth[good].astype(float)
    v, u = rows[line, 0], columns[0, place]
    # A number for each cell: row times columns plus column.
    cell = number_cells(v // cell_px * (depth_m.shape[1] // cell_px + 1) + u // cell_px)
    outwards = np.argsort(radii)
    pixels = np.column_stack([u, v, np.ones(len(u))])[outwards]
    rays = pixels @ np.linalg.inv(camera_matrix).T
    return FaceSupport(rays, inverse[outwards], radii[outwards], cell[outwards])


def fit_plane(
    points: FaceSupport, rings: tuple[float, ...], floor: float, generator: np.random.Generator
) -> FacePlane | None:
    """Fit a plane to the points around an ellipse, grown outwards from the innermost ring.

    Return `None` where they determine none: too few, on a line, or nearly all in one cell.

    Args:
        points: Support.
        rings: Outer limits of the rings in radii, the innermost first.
        floor: Least standard deviation of inverse depth, 1/m: the residuals of a matcher that
            smooths can be 0.
        generator: Draws the triples of the first guess.
    """
    # Near an occluder a matcher is blind: the plane may begin in a later ring.
    rings = tuple(ring for ring in rings if np.searchsorted(points.radii, ring) >= LEAST)
    if not rings:
        return None
    number = int(np.searchsorted(points.radii, rings[0]))
    # A robust start: least squares would follow an occluder.
    m = guess_plane(points.rays[:number], points.inverse[:number], generator)
    extent = rings[0]
    first = sigma = reach = floor
    rays = weight = points.rays[:0]
    for ring in rings:
        number = int(np.searchsorted(points.radii, ring))
        rays, inverse = points.rays[:number], points.inverse[:number]
        # Three rounds of reweighting; more change the plane by less than its uncertainty. Chosen
        # by hand; not searched.
        for _ in range(3):
            residual = inverse - rays @ m
            tight = np.abs(residual)
            # Gross errors are left out of the scale, or they would widen their own limit.
            tight = tight[tight < max(8 * sigma, compute_upper_median(tight) * 1.5)]
            scale = max(1.4826 * compute_upper_median(tight), floor)
            # Other faces that come into reach are no noise.
            sigma = scale if ring == rings[0] else min(scale, 1.2 * first)
            reach = (TUKEY if ring == rings[0] else GROWING) * sigma
            weight = compute_biweight(residual, reach)
            # Half of the least number: with fewer the plane rests on an accident.
            if np.count_nonzero(weight) < LEAST // 2:
                return None
            heavy = rays.T * weight
            # Weighted normal equations, three by three.
            sums = heavy @ rays
            if np.linalg.cond(sums) > DEGENERATE:
                return None
            m = np.linalg.solve(sums, heavy @ inverse)
        first = sigma if ring == rings[0] else first
        extent = ring
    # Residuals of the last plane, and their own weights: with those of the step before, points that
    # left the reach would count.
    residual = points.inverse[:number] - rays @ m
    weight = compute_biweight(residual, reach)
    cov = estimate_sandwich_covariance(
        rays * compute_psi_slope(residual / reach)[:, None],
        rays * weight[:, None],
        residual,
        points.cell[:number],
    )
    if cov is None:
        return None
    return FacePlane(m, cov, sigma, extent)


def compute_upper_median(values: np.ndarray) -> float:
    """Return the median of values `(P,)`, the upper one of an even number; faster than `np.median`."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])
