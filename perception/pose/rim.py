"""The rim of a hole as a circle on the face's plane, placed where brightness rises most steeply across it.

With the plane known, three numbers are left, which a third of a rim determines well; an ellipse
free in the picture has five, and closes the gap where an arm hides the rest of the rim with the
arm's edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.ellipse import conic

SIGMA_PX, SIGMA_Y, STEP_PX = 0.5, 2.0, 0.5
"""Blur along a profile before its slope is taken, across profiles (in profiles), and what lies
between the samples of one."""
PEAKS = 3
"""Steepest places of a profile that are looked at: a rim, its far end, and the edge of what stands
before it."""
FAINT = 0.25
"""Part of the usual steepness below which a place is no edge."""
TRIPLES = 120
NEAR_PX, INLIER_PX = 0.7, 1.0
"""A profile speaks for a circle that has an edge so near to it; of the final one."""
NARROW_PX = 2.0
"""Reach of the profiles across a circle that is known already."""
ALIKE_PX, ALIKE_M = 8.0, 0.006
"""Points of a rim are alike over both lengths together: that of blur and profiles, and that of
chips and grain."""
LEAST = 12
WAVES = (2, 3, 4)
"""Waves around a rim by which it is no circle, of light, chips and blur; they move the centre of
one that is not whole."""
GAP, BESIDE = 5, 5
"""Profiles in a row without an edge of the circle that are a gap, where something stands before it;
and beside one, those whose edge is drawn towards what stands there by the blur across profiles."""


@dataclass(frozen=True)
class RimCircle:
    """A circle on a plane.

    Attributes:
        center_m: In camera coordinates, `(3,)`.
        radius_m: Radius.
        cov_m2: Covariance of the centre on the plane, `(3, 3)`, singular along its normal.
        rms_px: Root mean square distance of its edge points.
        coverage: Part of it that has any.
        ellipse: What it is in the picture, `(5,)`.
    """

    center_m: np.ndarray
    radius_m: float
    cov_m2: np.ndarray
    rms_px: float
    coverage: float
    ellipse: np.ndarray


@dataclass(frozen=True)
class PlaneChart:
    """Coordinates on a plane, m: the place `origin + x first + y second` for each `(x, y)`."""

    origin: np.ndarray
    first: np.ndarray
    second: np.ndarray
    m: np.ndarray
    camera_matrix: np.ndarray

    def flat(self, pixels: np.ndarray) -> np.ndarray:
        """Return the coordinates of what is seen at pixels, `(…, 2)`."""
        rays = (
            np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1)
            @ np.linalg.inv(self.camera_matrix).T
        )
        away = rays / (rays @ self.m)[..., None] - self.origin
        return np.stack([away @ self.first, away @ self.second], -1)

    def seen(self, circle: np.ndarray) -> np.ndarray:
        """Return the ellipse `(5,)` that a circle `(x, y, radius)` is in the picture."""
        x, y, radius = circle
        back = np.linalg.inv(
            self.camera_matrix @ np.column_stack([self.first, self.second, self.origin])
        )
        return conic.convert_forms_to_ellipses(
            (back.T @ conic.build_quadratic_forms(np.array([x, y, radius, radius, 0.0])) @ back)[
                None
            ]
        )[0]


def fit_rim_circle(
    gray: np.ndarray,
    ellipse: np.ndarray,
    camera_matrix: np.ndarray,
    m: np.ndarray,
    radius_m: float,
    tolerance: float,
    center_px: float,
    shape_px: float,
) -> RimCircle | None:
    """Return the circle on the plane `m · P = 1` whose rim has the most edges of dark to bright; `None` where nothing agrees.

    Args:
        gray: Picture, `(h, w)` uint8.
        ellipse: About where it is, `(5,)`.
        camera_matrix: `(3, 3)`.
        m: The plane, `(3,)`.
        radius_m: About how large it is.
        tolerance: By how much it may be larger or smaller, as a part of that.
        center_px: Standard deviation of the centre of a whole rim that no residual shows, px.
        shape_px: Standard deviation by which a rim departs from a circle at each of its `WAVES`,
            px.
    """
    ray = np.linalg.solve(camera_matrix, np.array([ellipse[0], ellipse[1], 1.0]))
    normal = m / np.linalg.norm(m)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    chart = PlaneChart(ray / (m @ ray), first, np.cross(normal, first), m, camera_matrix)
    size = float(np.sqrt(ellipse[2] * ellipse[3]))
    profiles = _find_profile_edges(gray, ellipse, max(NARROW_PX, 0.25 * size), chart)
    if profiles is None:
        return None
    found = _vote_for_circle(*profiles, radius_m, tolerance)
    for _ in range(2):
        if found is None:
            return None
        seen = chart.seen(found)
        profiles = (
            _find_profile_edges(gray, seen, NARROW_PX, chart) if np.isfinite(seen).all() else None
        )
        if profiles is None:
            return None
        found, cov, rms_px, coverage = _fit_circle(found, *profiles, center_px, shape_px)
        if found is not None and abs(found[2] - radius_m) > 1.5 * tolerance * radius_m:
            return None
    if found is None:
        return None
    axes = np.column_stack([chart.first, chart.second])
    return RimCircle(
        chart.origin + axes @ found[:2],
        float(found[2]),
        axes @ cov @ axes.T,
        rms_px,
        coverage,
        chart.seen(found),
    )


def _find_profile_edges(
    gray: np.ndarray, ellipse: np.ndarray, reach_px: float, chart: PlaneChart
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the steepest places of profiles across an ellipse on the plane, and how long a pixel is there.

    Returns:
        Places `(P, PEAKS, 2)` m, NaN where there are fewer, and the length on the plane of a pixel
        along each profile `(P,)`.
    """
    number = int(np.clip(2 * conic.compute_perimeter(ellipse[2], ellipse[3]), 48, 144))
    points, outward, _ = (
        value[0]
        for value in conic.sample_ellipses(ellipse[None], np.arange(number) * (2 * np.pi / number))
    )
    offset = np.arange(-reach_px - 2.0, reach_px + 2.0 + 1e-9, STEP_PX)
    place = points[:, None] + offset[None, :, None] * outward[:, None]
    height, width = gray.shape
    x, y = place[..., 0], place[..., 1]
    left, top = int(np.floor(x.min())) - 2, int(np.floor(y.min())) - 2
    part = gray[max(top, 0) : int(y.max()) + 4, max(left, 0) : int(x.max()) + 4]
    if min(part.shape) < 4:
        return None
    map_x, map_y = (
        (some - max(corner, 0)).astype(np.float32) for some, corner in ((x, left), (y, top))
    )
    profile = cv2.remap(
        part, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float32)
    smooth = cv2.GaussianBlur(profile, (0, 0), SIGMA_PX / STEP_PX, sigmaY=SIGMA_Y)
    slope = np.zeros_like(smooth)
    slope[:, 1:-1] = 0.5 * (smooth[:, 2:] - smooth[:, :-2])
    inner = slope[:, 1:-1]
    peak = (inner >= slope[:, :-2]) & (inner > slope[:, 2:]) & (np.abs(offset[1:-1]) <= reach_px)
    peak &= ((x > 1) & (y > 1) & (x < width - 2) & (y < height - 2))[:, 1:-1]
    strength = np.where(peak, inner, 0.0)
    steepest = strength.max(1)
    usual = float(np.median(steepest[steepest > 0])) if (steepest > 0).any() else 0.0
    chosen = np.argsort(-strength, 1)[:, :PEAKS]
    rows = np.arange(number)[:, None]
    good = strength[rows, chosen] > FAINT * usual
    at = chosen + 1
    before, here, after = (slope[rows, at + shift] for shift in (-1, 0, 1))
    bend = before - 2 * here + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0).clip(
        -0.5, 0.5
    )
    way = offset[at] + STEP_PX * shift
    edges = chart.flat(points[:, None] + way[..., None] * outward[:, None])
    edges[~good] = np.nan
    pixel_m = np.linalg.norm(
        chart.flat(points + 0.5 * outward) - chart.flat(points - 0.5 * outward), axis=1
    )
    return edges, pixel_m


def _vote_for_circle(
    edges: np.ndarray, pixel_m: np.ndarray, radius_m: float, tolerance: float
) -> np.ndarray | None:
    """Return the circle `(x, y, radius)` through three edges that most profiles speak for."""
    places, owner = edges.reshape(-1, 2), np.repeat(np.arange(len(edges)), edges.shape[1])
    known = np.isfinite(places[:, 0])
    places, owner = places[known], owner[known]
    if len(places) < LEAST:
        return None
    triples = places[np.random.default_rng(0).integers(len(places), size=(TRIPLES, 3))]
    with np.errstate(all="ignore"):
        one, two = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
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
    dx, dy = (edges[None, ..., k] - circles[:, k, None, None] for k in (0, 1))
    off = np.abs(np.sqrt(dx * dx + dy * dy) - circles[:, 2, None, None])
    near = (
        np.fmin.reduce(off, 2, initial=np.inf) / pixel_m
    )  # where there are fewer edges, the others count
    return circles[np.argmax(np.maximum(1 - (near / NEAR_PX) ** 2, 0.0).sum(1))]


def _fit_circle(
    start: np.ndarray, edges: np.ndarray, pixel_m: np.ndarray, center_px: float, shape_px: float
) -> tuple[np.ndarray | None, np.ndarray, float, float]:
    """Return the circle that fits the edges nearest to one, the covariance of its centre, its residual in px and its coverage."""
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
            return None, np.zeros((2, 2)), 0.0, 0.0
        slope = np.column_stack([-away / distance[:, None], -np.ones(len(rows))]) / pixel_m[:, None]
        heavy = slope[on] * weight[on, None]
        normal = heavy.T @ slope[on]
        if np.linalg.cond(normal) > 1e8:
            return None, np.zeros((2, 2)), 0.0, 0.0
        found = found - np.linalg.solve(normal, heavy.T @ off[on])
    rms_px = float(np.sqrt(np.average(off[on] ** 2, weights=weight[on])))
    spacing_m = 2 * np.pi * float(found[2]) / len(rows)
    alike = max((ALIKE_PX * float(np.median(pixel_m)) + ALIKE_M) / spacing_m, 1.0)
    angle = np.arctan2(away[on, 1], away[on, 0])
    waves = [(center_px, 1.0)] + [(shape_px, number) for number in WAVES]
    moves = np.column_stack(
        [size * wave(number * angle) for size, number in waves for wave in (np.cos, np.sin)]
    )
    moved = np.linalg.solve(normal, heavy.T @ moves)[:2]
    cov = np.linalg.inv(normal)[:2, :2] * rms_px**2 * alike + moved @ moved.T
    return found, cov, rms_px, coverage


def _find_profiles_beside_gaps(on: np.ndarray) -> np.ndarray:
    """Says which of the profiles around a circle, `(P,)` bool, lie in gaps of it or beside one."""
    place = np.arange(len(on))[:, None]
    gap = (
        np.count_nonzero(on[(place - np.arange(GAP)) % len(on)], axis=1) == 0
    )  # the last ones of as many without an edge
    return np.count_nonzero(gap[(place + np.arange(-BESIDE, GAP + BESIDE)) % len(on)], axis=1) > 0
