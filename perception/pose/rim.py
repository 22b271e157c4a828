"""Rim of a hole: the circle on the face's plane along which brightness rises most steeply.

With the plane known, three numbers are left, which a third of a rim determines well. A free
ellipse in the picture has five, and would close the gap of an occluded rim along the occluder.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.calibrate.transforms import span_plane
from perception.ellipse import conic

# Each of these times 0.8 or 1.25 left every count of holes and discs in 8 rendered frames as it was,
# and changed their median error by 0.4 mm at most. STEP_PX, PEAKS, TRIPLES, DEGENERATE and WAVES were not varied.
SIGMA_PX, SIGMA_Y, STEP_PX = 0.5, 2.0, 0.5
"""Blur along a profile, px, and across profiles, in profiles; distance of samples, px."""
PEAKS = 3
"""Edges kept of each profile: the rim, its far end, and the edge of an occluder."""
FAINT = 0.25
"""Least steepness of an edge, as a part of the median one."""
TRIPLES = 120
"""Circles through three edges that are tried: with a third of the edges on the rim, four of them
are expected to lie on it."""
NEAR_PX, INLIER_PX = 0.7, 1.0
"""Largest distance of an edge from its circle: in the vote, and in the final fit."""
NARROW_PX = 2.0
"""Reach of the profiles across a known circle."""
ALIKE_PX, ALIKE_M = 8.0, 0.006
"""Correlation length of the errors along a rim, the sum of both: blur and profiles in px, chips
and grain in m."""
LEAST = 12
"""Least number of edges of a circle: four for each of its three numbers."""
DEGENERATE = 1e8
"""Condition number of the normal equations from which the edges determine no circle."""
WAVES = (2, 3, 4)
"""Waves around a rim by which light, chips and blur deform it; they move the centre of an
incomplete one."""
GAP, BESIDE = 5, 5
"""Profiles in a row without an edge that make a gap, hidden by an occluder; and profiles beside it
that the blur draws towards the occluder."""


@dataclass(frozen=True)
class RimCircle:
    """A circle on a plane.

    Attributes:
        center_m: Centre in camera coordinates, `(3,)`.
        radius_m: Radius.
        cov_m2: Covariance of the centre on the plane, `(3, 3)`, singular along its normal.
        rms_px: Root mean square distance of its edge points.
        coverage: Part of it that has edge points.
        ellipse: Its ellipse in the picture, `(5,)`.
    """

    center_m: np.ndarray
    radius_m: float
    cov_m2: np.ndarray
    rms_px: float
    coverage: float
    ellipse: np.ndarray


@dataclass(frozen=True)
class PlaneChart:
    """Coordinates `(x, y)` on a plane, m: the place `origin + x first + y second`."""

    origin: np.ndarray
    first: np.ndarray
    second: np.ndarray
    m: np.ndarray
    camera_matrix: np.ndarray

    def flat(self, pixels: np.ndarray) -> np.ndarray:
        """Return the coordinates on the plane seen at pixels, `(…, 2)`."""
        rays = (
            np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1)
            @ np.linalg.inv(self.camera_matrix).T
        )
        away = rays / (rays @ self.m)[..., None] - self.origin
        return np.stack([away @ self.first, away @ self.second], -1)

    @property
    def _homography(self) -> np.ndarray:
        return self.camera_matrix @ np.column_stack([self.first, self.second, self.origin])

    def flatten(self, ellipse: np.ndarray) -> np.ndarray:
        """Return the ellipse `(5,)` on the plane that is seen as one in the picture, NaN for none."""
        place = self._homography
        form = place.T @ conic.build_quadratic_forms(ellipse) @ place
        return conic.convert_forms_to_ellipses(form[None])[0]

    def seen(self, circle: np.ndarray) -> np.ndarray:
        """Return the ellipse `(5,)` in the picture of a circle `(x, y, radius)`."""
        x, y, radius = circle
        back = np.linalg.inv(self._homography)
        form = back.T @ conic.build_quadratic_forms(np.array([x, y, radius, radius, 0.0])) @ back
        return conic.convert_forms_to_ellipses(form[None])[0]

    def place_circle(
        self, circle: np.ndarray, cov_m2: np.ndarray, rms_px: float, coverage: float
    ) -> RimCircle:
        """Return a circle `(x, y, radius)` in camera coordinates; `cov_m2`, `(2, 2)`, is its centre's."""
        axes = np.column_stack([self.first, self.second])
        center_m, cov = self.origin + axes @ circle[:2], axes @ cov_m2 @ axes.T
        return RimCircle(center_m, float(circle[2]), cov, rms_px, coverage, self.seen(circle))


def build_chart(origin: np.ndarray, m: np.ndarray, camera_matrix: np.ndarray) -> PlaneChart:
    """Return coordinates on the plane `m · P = 1` about one of its points, `(3,)`."""
    normal = m / np.linalg.norm(m)
    return PlaneChart(origin, *span_plane(normal), m, camera_matrix)


@dataclass(frozen=True)
class _CircleFit:
    """Result of `_fit_circle`.

    Attributes:
        circle: Centre and radius on the plane, m, `(3,)`.
        cov_m2: Covariance of the centre, `(2, 2)`.
        rms_px: Root mean square distance of the edges.
        coverage: Part of the profiles with an edge.
    """

    circle: np.ndarray
    cov_m2: np.ndarray
    rms_px: float
    coverage: float


def fit_rim_circle(
    gray: np.ndarray,
    ellipse: np.ndarray,
    chart: PlaneChart,
    radius_m: float,
    tolerance: float,
    center_px: float,
) -> RimCircle | None:
    """Fit the circle on a plane along which most edges run from dark to bright.

    Return `None` where no circle of a possible size has enough.

    Args:
        gray: Light, `(h, w)` float32; see `plane_conic.linearize`.
        ellipse: Start, `(5,)`.
        chart: Coordinates on the plane about the ellipse's centre.
        radius_m: Expected radius.
        tolerance: Allowed relative error of it.
        center_px: Least standard deviation of each wave of a rim, px: of the first one, which no
            residual shows, and of the `WAVES` beyond what the residuals show.
    """
    # The search reaches a quarter of the size: the first ellipse may be that wrong.
    size = float(np.sqrt(ellipse[2] * ellipse[3]))
    profiles = find_profile_edges(gray, ellipse, max(NARROW_PX, 0.25 * size), chart)
    if profiles is None:
        return None
    found, fit = _vote_for_circle(profiles.edges, profiles.pixel_m, radius_m, tolerance), None
    # Twice: profiles across the better circle find the rim more exactly.
    for _ in range(2):
        if found is None:
            return None
        seen = chart.seen(found)
        profiles = (
            find_profile_edges(gray, seen, NARROW_PX, chart) if np.isfinite(seen).all() else None
        )
        if profiles is None:
            return None
        fit = _fit_circle(found, profiles.edges, profiles.pixel_m, center_px)
        found = None if fit is None else fit.circle
        # Half as much more than the final limit, which the caller checks.
        if found is not None and abs(found[2] - radius_m) > 1.5 * tolerance * radius_m:
            return None
    if fit is None or found is None:
        return None
    return chart.place_circle(found, fit.cov_m2, fit.rms_px, fit.coverage)


@dataclass(frozen=True)
class ProfileEdges:
    """The steepest places of profiles across an ellipse, on a plane.

    Attributes:
        edges: Places, m, `(P, PEAKS, 2)`, NaN where there are fewer.
        strength: Their steepness, grey levels a sample, `(P, PEAKS)`.
        pixel_m: Length of a pixel on the plane along each profile, `(P,)`.
        pixels: The places in the picture, `(P, PEAKS, 2)`.
        outward: Direction of each profile in the picture, `(P, 2)`.
    """

    edges: np.ndarray
    strength: np.ndarray
    pixel_m: np.ndarray
    pixels: np.ndarray
    outward: np.ndarray


def find_profile_edges(
    gray: np.ndarray, ellipse: np.ndarray, reach_px: float, chart: PlaneChart
) -> ProfileEdges | None:
    """Find the steepest places of profiles across an ellipse; `None` beside the picture."""
    # At most 144 profiles limit the time; their edges are correlated beyond that number.
    number = int(np.clip(2 * conic.compute_perimeter(ellipse[2], ellipse[3]), 48, 144))
    points, outward, _ = (
        value[0]
        for value in conic.sample_ellipses(ellipse[None], np.arange(number) * (2 * np.pi / number))
    )
    # Two pixels more on each side for the blur and the gradient.
    offset = np.arange(-reach_px - 2.0, reach_px + 2.0 + 1e-9, STEP_PX)
    place = points[:, None] + offset[None, :, None] * outward[:, None]
    height, width = gray.shape
    x, y = place[..., 0], place[..., 1]
    # Only the part around the ellipse is sampled, since `remap` is proportional to its sources.
    left, top = int(np.floor(x.min())) - 2, int(np.floor(y.min())) - 2
    part = gray[max(top, 0) : int(y.max()) + 4, max(left, 0) : int(x.max()) + 4]
    if min(part.shape) < 4:
        return None
    map_x = (x - max(left, 0)).astype(np.float32)
    map_y = (y - max(top, 0)).astype(np.float32)
    profile = cv2.remap(
        part, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float32)
    smooth = cv2.GaussianBlur(profile, (0, 0), SIGMA_PX / STEP_PX, sigmaY=SIGMA_Y)
    slope = np.zeros_like(smooth)
    # Central differences along the profile.
    slope[:, 1:-1] = 0.5 * (smooth[:, 2:] - smooth[:, :-2])
    inner = slope[:, 1:-1]
    # Only rises count: a rim is dark inside.
    peak = (inner >= slope[:, :-2]) & (inner > slope[:, 2:]) & (np.abs(offset[1:-1]) <= reach_px)
    peak &= ((x > 1) & (y > 1) & (x < width - 2) & (y < height - 2))[:, 1:-1]
    strength = np.where(peak, inner, 0.0)
    steepest = strength.max(1)
    # The median of the steepest edges is the rim's; faint texture lies far below it.
    usual = float(np.median(steepest[steepest > 0])) if (steepest > 0).any() else 0.0
    chosen = np.argsort(-strength, 1)[:, :PEAKS]
    rows = np.arange(number)[:, None]
    good = strength[rows, chosen] > FAINT * usual
    at = chosen + 1
    before = slope[rows, at - 1]
    here = slope[rows, at]
    after = slope[rows, at + 1]
    # A parabola through three samples gives the place between them.
    bend = before - 2 * here + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0).clip(
        -0.5, 0.5
    )
    way = offset[at] + STEP_PX * shift
    pixels = points[:, None] + way[..., None] * outward[:, None]
    edges = chart.flat(pixels)
    # NaN marks the missing edges, which comparisons leave out.
    edges[~good] = np.nan
    # Pixels on the plane are longer where the face is seen obliquely.
    pixel_m = np.linalg.norm(
        chart.flat(points + 0.5 * outward) - chart.flat(points - 0.5 * outward), axis=1
    )
    return ProfileEdges(edges, strength[rows, chosen], pixel_m, pixels, outward)


def _vote_for_circle(
    edges: np.ndarray, pixel_m: np.ndarray, radius_m: float, tolerance: float
) -> np.ndarray | None:
    """Return the circle `(x, y, radius)` through three edges that most profiles support."""
    places = edges.reshape(-1, 2)
    places = places[np.isfinite(places[:, 0])]
    if len(places) < LEAST:
        return None
    # A fixed seed: the same picture gives the same circle.
    triples = places[np.random.default_rng(0).integers(len(places), size=(TRIPLES, 3))]
    with np.errstate(all="ignore"):
        one, two = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
        # Twice the area of the triangle; zero for three points on a line.
        double = 2 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        square_one, square_two = (one**2).sum(1), (two**2).sum(1)
        x = (two[:, 1] * square_one - one[:, 1] * square_two) / double
        y = (one[:, 0] * square_two - two[:, 0] * square_one) / double
        radius = np.hypot(x, y)
        circles = np.column_stack([triples[:, 0, 0] + x, triples[:, 0, 1] + y, radius])
    circles = circles[
        np.isfinite(circles).all(1) & (np.abs(radius - radius_m) < tolerance * radius_m)
    ]
    if not len(circles):
        return None
    dx = edges[None, ..., 0] - circles[:, 0, None, None]
    dy = edges[None, ..., 1] - circles[:, 1, None, None]
    off = np.abs(np.sqrt(dx * dx + dy * dy) - circles[:, 2, None, None])
    # `fmin` leaves out the NaN of profiles with fewer edges.
    near = np.fmin.reduce(off, 2, initial=np.inf) / pixel_m
    # A smooth vote: points near the limit count little, so that the best circle does not jump.
    return circles[np.argmax(np.maximum(1 - (near / NEAR_PX) ** 2, 0.0).sum(1))]


def _fit_circle(
    start: np.ndarray, edges: np.ndarray, pixel_m: np.ndarray, center_px: float
) -> _CircleFit | None:
    """Fit a circle to the edges nearest to one; `None` where too few determine it."""
    found = start
    for scale_px in (NARROW_PX, INLIER_PX, 0.6 * INLIER_PX):
        away = edges - found[:2]
        distance = np.sqrt(conic.sum_products(away, away))
        off = (distance - found[2]) / pixel_m[:, None]
        best = np.argmin(np.where(np.isfinite(off), np.abs(off), np.inf), 1)
        rows = np.arange(len(edges))
        off, away, distance = off[rows, best], away[rows, best], distance[rows, best]
        off = np.where(np.isfinite(off), off, np.inf)
        weight = np.maximum(1 - (off / scale_px) ** 2, 0.0) ** 2
        coverage = float(np.mean(weight > 0))
        beside = _find_profiles_beside_gaps(weight > 0)
        if np.count_nonzero(weight[~beside]) >= LEAST:
            weight[beside] = 0.0
        on = weight > 0
        if on.sum() < LEAST:
            return None
        slope = np.column_stack([-away / distance[:, None], -np.ones(len(rows))]) / pixel_m[:, None]
        heavy = slope[on] * weight[on, None]
        normal = heavy.T @ slope[on]
        if np.linalg.cond(normal) > DEGENERATE:
            return None
        found = found - np.linalg.solve(normal, heavy.T @ off[on])
    rms_px = float(np.sqrt(np.average(off[on] ** 2, weights=weight[on])))
    spacing_m = 2 * np.pi * float(found[2]) / len(rows)
    alike = max((ALIKE_PX * float(np.median(pixel_m)) + ALIKE_M) / spacing_m, 1.0)
    angle = np.arctan2(away[on, 1], away[on, 0])
    # Systematic errors: the first wave moves the centre itself, the others deform the rim.
    wave_px = float(np.hypot(_measure_waves(off[on], angle, weight[on], alike), center_px))
    moves = []
    for number in (1, *WAVES):
        moves += [wave_px * np.cos(number * angle), wave_px * np.sin(number * angle)]
    moved = np.linalg.solve(normal, heavy.T @ np.column_stack(moves))[:2]
    cov = np.linalg.inv(normal)[:2, :2] * rms_px**2 * alike + moved @ moved.T
    return _CircleFit(found, cov, rms_px, coverage)


def _measure_waves(
    off_px: np.ndarray, angle: np.ndarray, weight: np.ndarray, alike: float
) -> float:
    """Return the standard deviation of a coefficient of the `WAVES` of a rim, px, beyond its noise.

    No residual shows the first wave, which is a shift of the circle. Light, chips and lens make it
    about as large as the next ones.
    """
    columns = []
    for number in WAVES:
        columns += [np.cos(number * angle), np.sin(number * angle)]
    design = np.column_stack(columns)
    root = np.sqrt(weight)
    waves, *_ = np.linalg.lstsq(design * root[:, None], off_px * root, rcond=1e-3)
    rest = off_px - design @ waves
    noise = float(np.average(rest**2, weights=weight)) * alike * 2.0 / len(off_px)
    return float(np.sqrt(max(float(np.mean(waves**2)) - noise, 0.0)))


def _find_profiles_beside_gaps(on: np.ndarray) -> np.ndarray:
    """Find profiles around a circle, `(P,)` bool, that lie in a gap or beside one."""
    place = np.arange(len(on))[:, None]
    # True at the last profile of each `GAP` in a row without an edge.
    gap = np.count_nonzero(on[(place - np.arange(GAP)) % len(on)], axis=1) == 0
    return np.count_nonzero(gap[(place + np.arange(-BESIDE, GAP + BESIDE)) % len(on)], axis=1) > 0
