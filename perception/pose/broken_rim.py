"""Rim of which pieces are broken off: the wall of the hole, which begins at several depths.

A chip lowers the edge of the hole. Seen through the plane of the face, a piece of edge that lies
deeper is displaced towards the camera, by its depth times the tangent of the obliquity. The nearer
lip of a steep chip is displaced the same way. No piece is displaced away from the camera. So the
edges form the circle of the rim where it is whole, and arcs of the same radius beside it on one
side. The centre follows from the posterior of this mixture on a grid, and its covariance from the
spread of that posterior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.pose import rim

# Chosen by hand on rendered scenes (benchmarks/perception/rims.py).
REACHES = 0.6, 0.45
"""Reach of the profiles across the first circle, in radii, and across the next one: the first one
may be off by a third of a radius, and chips displace edges by as much."""
NOISE_PX, NOISE_M = 0.4, 0.0004
"""Standard deviation of an edge across the rim, the sum of both: picture, roughness of the wall."""
WHOLE, OUTLIER = 0.4, 0.15
"""Prior part of a rim that is whole, and of its profiles without any edge of it."""
CHIP_M, DEEPEST_M = 0.010, 0.040
"""Mean depth of a chip's edge below the face, and the largest one."""
RADIUS_STD = 0.04
"""Standard deviation of the radius, relative: a drill wears."""
GRIDS, FINEST = ((7, 0.08), (5, 0.02)), (5, 0.006)
"""Steps on each side of the middle and their length in radii, of grids from coarse to fine."""
RADII = (0.0,), (-0.06, -0.03, 0.0, 0.03, 0.06)
"""Departures of the radius on these grids, relative."""
MOST_GRIDS = 4
"""Times that the finest grid may move or widen."""
STRAIGHT = 1e-6
"""Tangent of the obliquity from which the direction of a displacement is known."""


@dataclass(frozen=True)
class RimEdges:
    """Edges of profiles across a rim, relative to the direction in which chips displace them.

    Attributes:
        aside_m: Place across that direction, `(E,)`.
        along_m: Place along it.
        near: The edge lies on the side of the rim that is nearer to the camera.
        noise_m: Standard deviation across the rim.
        weight: Steepness, as a part of that of the profile's edges.
        profile: Number of its profile.
        num_profiles: Number of profiles.
        most_m: Largest displacement.
        mean_m: Mean displacement of a chipped edge.
        reach_m: Reach of the profiles.
        pixel_m: Length of a pixel on the face.
    """

    aside_m: np.ndarray
    along_m: np.ndarray
    near: np.ndarray
    noise_m: np.ndarray
    weight: np.ndarray
    profile: np.ndarray
    num_profiles: int
    most_m: float
    mean_m: float
    reach_m: float
    pixel_m: float

    def compute_likelihood(self, circles: np.ndarray) -> np.ndarray:
        """Return the likelihood of each profile by circles `(C, 3)`, over that of an outlier, `(C, P)`."""
        aside = self.aside_m - circles[:, :1]
        along = self.along_m - circles[:, 1:2]
        radius = circles[:, 2:]
        # Positive towards the camera: outwards on the near side, inwards on the far one.
        off = np.hypot(aside, along) - radius
        off = np.where(self.near, off, -off)
        inside = np.maximum(radius**2 - aside**2, 0.0)
        shift = np.where(self.near, along - np.sqrt(inside), along + np.sqrt(inside))
        shift = np.clip(shift, 0.0, self.most_m)
        # Beside the rim no displacement explains an edge.
        beyond = np.maximum(np.abs(aside) - radius, 0.0)
        whole = np.exp(-0.5 * (off / self.noise_m) ** 2) / (2.5066 * self.noise_m)
        chipped = np.exp(-shift / self.mean_m - 0.5 * (beyond / self.noise_m) ** 2) / self.mean_m
        # Smooth at the rim: an edge may be displaced by less than its noise.
        chipped /= 1.0 + np.exp(np.clip(-1.7 * off / self.noise_m, -50.0, 50.0))
        chipped *= off < self.most_m
        density = self.weight * (WHOLE * whole + (1.0 - WHOLE) * chipped)
        sums = np.zeros((len(circles), self.num_profiles))
        for place in range(len(density)):
            sums[place] = np.bincount(self.profile, density[place], self.num_profiles)
        return OUTLIER + (1.0 - OUTLIER) * 2.0 * self.reach_m * sums


@dataclass(frozen=True)
class _Posterior:
    """Posterior of circles `(aside, along, radius)` on a grid.

    Attributes:
        best: The likeliest circle, `(3,)`.
        mean: Mean, `(3,)`.
        spread: Covariance of the centre, `(2, 2)`.
        coverage: Part of the profiles that the likeliest circle explains better than chance does.
    """

    best: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    coverage: float


def fit_broken_rim(
    gray: np.ndarray, chart: rim.PlaneChart, start_m: np.ndarray, radius_m: float, center_px: float
) -> rim.RimCircle | None:
    """Fit the circle of a rim with broken pieces; `None` without enough edges.

    Args:
        gray: Picture, `(h, w)` uint8.
        chart: Coordinates on the face.
        start_m: First centre on it, `(2,)`.
        radius_m: Expected radius.
        center_px: Standard deviation of the centre that no residual shows, px.
    """
    # The displacement of a point at unit depth, by the line of sight to the middle of the rim.
    away = np.array([chart.first @ chart.origin, chart.second @ chart.origin])
    away *= -np.linalg.norm(chart.m)
    slope = float(np.linalg.norm(away))
    along = away / slope if slope > STRAIGHT else np.array([1.0, 0.0])
    turn = np.array([[-along[1], along[0]], along])
    circle = np.array([*(turn @ start_m), radius_m])
    for reach, (half, step), radii in zip(REACHES, GRIDS, RADII, strict=True):
        edges = _collect_edges(gray, chart, circle, turn, slope, reach)
        if edges is None:
            return None
        posterior = _compute_posterior(edges, circle, half, step * radius_m, radius_m, radii)
        circle = posterior.best
    posterior = _refine_posterior(edges, circle, radius_m)
    center = turn.T @ posterior.mean[:2]
    cov = turn.T @ posterior.spread @ turn + np.eye(2) * (center_px * edges.pixel_m) ** 2
    axes = np.column_stack([chart.first, chart.second])
    return rim.RimCircle(
        chart.origin + axes @ center,
        float(posterior.mean[2]),
        axes @ cov @ axes.T,
        NOISE_PX,
        posterior.coverage,
        chart.seen(np.array([*center, posterior.mean[2]])),
    )


def _compute_posterior(
    edges: RimEdges,
    circle: np.ndarray,
    half: int,
    step_m: float,
    radius_m: float,
    radii: tuple[float, ...],
) -> _Posterior:
    """Return the posterior on a grid of `half` steps on each side of a circle."""
    offsets = np.arange(-half, half + 1) * step_m
    sizes = radius_m * (1.0 + np.array(radii))
    grid = np.stack(np.meshgrid(offsets, offsets, sizes, indexing="ij"), -1).reshape(-1, 3)
    grid[:, :2] += circle[:2]
    likelihood = edges.compute_likelihood(grid)
    # Neighbouring profiles share their error.
    spacing_m = 2 * np.pi * float(circle[2]) / edges.num_profiles
    alike = max((rim.ALIKE_PX * edges.pixel_m + rim.ALIKE_M) / spacing_m, 1.0)
    score = np.log(likelihood).sum(1) / alike
    score -= 0.5 * ((grid[:, 2] / radius_m - 1.0) / RADIUS_STD) ** 2
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    mean = weight @ grid
    off = grid[:, :2] - mean[:2]
    best = int(np.argmax(score))
    coverage = float(np.mean(likelihood[best] > 1.0))
    return _Posterior(grid[best], mean, off.T @ (off * weight[:, None]), coverage)


def _refine_posterior(edges: RimEdges, circle: np.ndarray, radius_m: float) -> _Posterior:
    """Return the posterior on a grid that holds it: moved and widened until it does."""
    (half, step), radii = FINEST, RADII[-1]
    for _ in range(MOST_GRIDS):
        posterior = _compute_posterior(edges, circle, half, step * radius_m, radius_m, radii)
        room_m = half * step * radius_m
        std_m = float(np.sqrt(np.diag(posterior.spread).max()))
        # A third of the grid on each side: three standard deviations.
        is_held = std_m < 0.35 * room_m
        if is_held and np.abs(posterior.mean - circle)[:2].max() < 0.5 * room_m:
            break
        circle = posterior.mean
        step *= 1.0 if is_held else 1.6
    return posterior


def _collect_edges(
    gray: np.ndarray,
    chart: rim.PlaneChart,
    circle: np.ndarray,
    turn: np.ndarray,
    slope: float,
    reach: float,
) -> RimEdges | None:
    """Return the edges around a circle; chips displace them along the second axis of `turn`."""
    seen = chart.seen(np.array([*(turn.T @ circle[:2]), circle[2]]))
    if not np.isfinite(seen).all():
        return None
    reach_px = max(rim.NARROW_PX, reach * float(np.sqrt(seen[2] * seen[3])))
    profiles = rim.find_profile_edges(gray, seen, reach_px, chart)
    if profiles is None:
        return None
    there = np.isfinite(profiles.edges[..., 0])
    number, _ = np.nonzero(there)
    if len(number) < rim.LEAST:
        return None
    aside, along = turn @ profiles.edges[there].T
    strength = profiles.strength[there]
    total = np.bincount(number, strength, len(there))
    pixel_m = profiles.pixel_m[number]
    return RimEdges(
        aside,
        along,
        along > circle[1],
        NOISE_PX * pixel_m + NOISE_M,
        strength / total[number],
        number,
        len(there),
        max(DEEPEST_M * slope, 0.002),
        max(CHIP_M * slope, 0.001),
        reach * float(circle[2]),
        float(np.median(pixel_m)),
    )
