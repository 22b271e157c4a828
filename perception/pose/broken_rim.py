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

import cv2
import numpy as np

from perception.pose import rim
from perception.pose.alignment import StereoPatch

# Chosen by hand on rendered scenes (rims.py of commit 1bfbfc41).
REACHES = 0.6, 0.45
"""Reach of the profiles across the first circle, in radii, and across the next one: the first one
may be off by a third of a radius, and chips displace edges by as much."""
NOISE_PX, NOISE_M = 0.1, 0.0003
"""Standard deviation of an edge across the rim, the sum of both: picture, roughness of the wall."""
WHOLE, LEAST_WHOLE, FADING_M = 0.5, 0.02, 0.006
"""Prior part of a rim that is whole where chips are shallow, and where they are deep; mean depth at
which the first has fallen by a factor of e."""
OUTLIER = 0.15
"""Prior part of the profiles without any edge of the rim."""
MEANS_M, USUAL_M, DEEPEST_M = (0.001, 0.003, 0.006, 0.010, 0.015, 0.021), 0.03, 0.040
"""Mean depths of a rim's edge that are tried; scale of their prior; largest depth of an edge."""
DEPTHS_M = tuple(0.002 * k for k in range(18))
"""Depths below the face at which both pictures are compared beside the edges."""
BESIDE_PX, BESIDE = 0.0, 0.3
"""Range of that comparison beyond an edge: from so many px to a part of the radius."""
SECTORS, ALIKE_PX2 = 12, 20.0
"""Sectors around the rim, each compared alone; pixels that share their error, by the blur."""
STRIP = 0.25
"""Standard deviation of the depth of an edge by that beside it, relative."""
STEEP = 0.5
"""Least part of the radius along the displacement from which an edge tells its depth."""
ALIKE_M = 0.02
"""Length along a rim within which errors are correlated, beside `rim.ALIKE_PX`: that of a chip."""
RADIUS_STD = 0.04
"""Standard deviation of the radius, relative: a drill wears."""
GRIDS, FINEST = ((7, 0.08), (6, 0.02)), (5, 0.005)
"""Steps on each side of the middle and their length in radii, of grids from coarse to fine."""
RADII = (0.0,), (-0.06, -0.03, 0.0, 0.03, 0.06)
"""Departures of the radius on these grids, relative."""
MOST_GRIDS = 4
"""Largest number of moves and widenings of the finest grid."""
STRAIGHT, SHALLOW = 1e-6, 0.1
"""Tangent of the obliquity from which the direction of a displacement is known, and from which it
matters."""
ON_RIM, SURE_WHOLE, LEAST_DOUBT = 2.0, 0.5, 0.3
"""Standard deviations within which an edge lies on the rim itself; part of a rim with such edges
from which its place hardly rests on the depth of the others; a break of even depth looks as whole,
so a part of the doubt stays."""
CLEARLY_M, CLEARLY_ODDS = 0.006, 10.0
"""Least depth of the surroundings of a rim, and its least log odds over the depth of the face, from
which a rim that looks whole is broken all around."""
LEAST_UNLIKE = 0.02
"""Part of the variance in which both pictures differ anyway, by interpolation."""


@dataclass(frozen=True)
class RimEdges:
    """Edges of profiles across a rim, relative to the direction in which chips displace them.

    Attributes:
        aside_m: Place across that direction, `(E,)`.
        along_m: Place along it.
        near: The edge lies on the side of the rim that is nearer to the camera.
        noise_m: Standard deviation across the rim.
        weight: Steepness, as a part of that of the profile's edges.
        first: First edge of each profile that has any, `(P,)`.
        num_profiles: Number of all profiles.
        slope: Displacement of an edge by its depth.
        most_m: Largest displacement.
        reach_m: Reach of the profiles.
        pixel_m: Length of a pixel on the face.
        depth_odds: Odds of each edge for the `DEPTHS_M` by both pictures, of mean 1, `(E, D)`.
        mean_log_odds: Logarithmic odds of the `MEANS_M` by both pictures, `(K,)`.
        depth_std_m: Standard deviation of the mean depth by both pictures.
    """

    aside_m: np.ndarray
    along_m: np.ndarray
    near: np.ndarray
    noise_m: np.ndarray
    weight: np.ndarray
    first: np.ndarray
    num_profiles: int
    slope: float
    most_m: float
    reach_m: float
    pixel_m: float
    depth_odds: np.ndarray
    mean_log_odds: np.ndarray
    depth_std_m: float

    def compute_likelihood(self, circles: np.ndarray, step_m: float) -> np.ndarray:
        """Return the likelihood of profiles by circles and mean depths, over chance, `(K, C, P)`.

        Noise below the step of a grid would hide a circle between its nodes.
        """
        noise_m = np.maximum(self.noise_m, step_m)
        aside = self.aside_m - circles[:, :1]
        along = self.along_m - circles[:, 1:2]
        radius = circles[:, 2:]
        # Positive towards the camera: outwards on the near side, inwards on the far one.
        off = np.hypot(aside, along) - radius
        off = np.where(self.near, off, -off)
        inside = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
        shift = np.where(self.near, along - inside, along + inside).clip(0.0, self.most_m)
        # Beside the rim no displacement explains an edge.
        beyond = np.maximum(np.abs(aside) - radius, 0.0)
        whole = np.exp(-0.5 * (off / noise_m) ** 2) / (2.5066 * noise_m)
        whole *= self.weight * self.depth_odds[:, 0]
        # Smooth at the rim: an edge may be displaced by less than its noise.
        broken = np.exp(-0.5 * (beyond / noise_m) ** 2)
        broken /= 1.0 + np.exp(np.clip(-1.7 * off / noise_m, -50.0, 50.0))
        broken *= self.weight * (off < self.most_m)
        place = np.rint(shift / (self.slope * DEPTHS_M[1])).astype(int).clip(0, len(DEPTHS_M) - 1)
        broken *= self.depth_odds[np.arange(len(self.aside_m)), place]
        found = []
        for mean_m in MEANS_M:
            scale_m = max(0.5 * mean_m * self.slope, 0.5 * float(np.median(noise_m)))
            part = max(WHOLE * np.exp(-mean_m / FADING_M), LEAST_WHOLE)
            # A gamma distribution of shape 2: of deep chips few edges lie near the face.
            density = (shift + noise_m) / scale_m**2 * np.exp(-shift / scale_m)
            density = part * whole + (1.0 - part) * broken * density
            sums = np.add.reduceat(density, self.first, axis=1)
            found.append(OUTLIER + (1.0 - OUTLIER) * 2.0 * self.reach_m * sums)
        return np.stack(found)

    def measure_whole_part(self, circle: np.ndarray) -> float:
        """Return the part of the profiles with an edge on a circle itself."""
        off = np.hypot(self.aside_m - circle[0], self.along_m - circle[1]) - circle[2]
        on = np.logical_or.reduceat(np.abs(off) < ON_RIM * self.noise_m, self.first)
        return float(np.count_nonzero(on)) / self.num_profiles


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
    gray: np.ndarray,
    chart: rim.PlaneChart,
    both: StereoPatch | None,
    start_m: np.ndarray,
    radius_m: float,
    center_px: float,
) -> rim.RimCircle | None:
    """Fit the circle of a rim with broken pieces; `None` without enough edges.

    Args:
        gray: Light, `(h, w)` float32; see `plane_conic.linearize`.
        chart: Coordinates on the face.
        both: Both pictures around the rim; `None` without a right one.
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
        edges = _collect_edges(gray, chart, both, circle, turn, slope, reach)
        if edges is None:
            return None
        posterior = _compute_posterior(edges, circle, half, step * radius_m, radius_m, radii)
        circle = posterior.best
    posterior = _refine_posterior(edges, circle, radius_m)
    center = turn.T @ posterior.mean[:2]
    # Without whole pieces the place along the displacement rests on the depth of the edges.
    whole = edges.measure_whole_part(posterior.mean)
    doubt_m = slope * edges.depth_std_m * max(1.0 - whole / SURE_WHOLE, LEAST_DOUBT)
    spread = posterior.spread + np.diag([0.0, doubt_m**2])
    cov = turn.T @ spread @ turn + np.eye(2) * (center_px * edges.pixel_m) ** 2
    circle = np.array([*center, posterior.mean[2]])
    return chart.place_circle(circle, cov, NOISE_PX, posterior.coverage)


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
    likelihood = edges.compute_likelihood(grid, 0.6 * step_m)
    # Neighbouring profiles share their error.
    spacing_m = 2 * np.pi * float(circle[2]) / edges.num_profiles
    alike = max((rim.ALIKE_PX * edges.pixel_m + ALIKE_M) / spacing_m, 1.0)
    scores = np.log(likelihood).sum(2) / alike
    scores += (edges.mean_log_odds - np.array(MEANS_M) / USUAL_M)[:, None]
    # The mean depth of the edges is not of interest: a sum over all of them.
    score = np.logaddexp.reduce(scores, axis=0)
    score -= 0.5 * ((grid[:, 2] / radius_m - 1.0) / RADIUS_STD) ** 2
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    mean = weight @ grid
    off = grid[:, :2] - mean[:2]
    best = int(np.argmax(score))
    explained = likelihood[int(np.argmax(scores[:, best])), best] > 1.0
    coverage = float(np.count_nonzero(explained)) / edges.num_profiles
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
    both: StereoPatch | None,
    circle: np.ndarray,
    turn: np.ndarray,
    slope: float,
    reach: float,
) -> RimEdges | None:
    """Return the edges around a circle; chips displace them along the second axis of `turn`."""
    seen = chart.seen(np.array([*(turn.T @ circle[:2]), circle[2]]))
    if not np.isfinite(seen).all():
        return None
    radius_px = float(np.sqrt(seen[2] * seen[3]))
    reach_px = max(rim.NARROW_PX, reach * radius_px)
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
    odds = np.zeros((SECTORS, len(DEPTHS_M)))
    if both is not None and slope > SHALLOW:
        odds = compare_depths(both, chart, profiles, radius_px)
    # Each edge has the odds of its sector, unless it lies beside the rim, where it tells no depth.
    own = odds - np.logaddexp.reduce(odds, axis=1, keepdims=True) + np.log(len(DEPTHS_M))
    own = np.exp(own)[number * SECTORS // len(there)]
    own[np.abs(along - circle[1]) < STEEP * circle[2]] = 1.0
    mean_log_odds = np.array([np.interp(mean, DEPTHS_M, odds.sum(0)) for mean in MEANS_M])
    return RimEdges(
        aside,
        along,
        along > circle[1],
        NOISE_PX * pixel_m + NOISE_M,
        strength / total[number],
        np.flatnonzero(np.diff(number, prepend=-1)),
        len(there),
        max(slope, STRAIGHT),
        max(DEEPEST_M * slope, 0.002),
        reach * float(circle[2]),
        float(np.median(pixel_m)),
        own,
        mean_log_odds - mean_log_odds.max(),
        _measure_spread(odds.sum(0)),
    )


def is_below_face(
    gray: np.ndarray, chart: rim.PlaneChart, both: StereoPatch, ellipse: np.ndarray
) -> bool:
    """Return whether the surroundings of a rim, an ellipse `(5,)`, lie clearly below the face.

    A break of even depth all around looks like a whole rim in one picture.
    """
    profiles = rim.find_profile_edges(gray, ellipse, rim.NARROW_PX, chart)
    if profiles is None:
        return False
    odds = compare_depths(both, chart, profiles, float(np.sqrt(ellipse[2] * ellipse[3]))).sum(0)
    is_deep = DEPTHS_M[int(np.argmax(odds))] >= CLEARLY_M
    return bool(is_deep and odds.max() - odds[0] > CLEARLY_ODDS)


def compare_depths(
    both: StereoPatch, chart: rim.PlaneChart, profiles: rim.ProfileEdges, radius_px: float
) -> np.ndarray:
    """Return the log odds of `DEPTHS_M` beside the edges of each sector, `(SECTORS, D)`.

    A plane sweep (Collins 1996): both pictures are compared on planes parallel to the face. The
    residuals of the best agreement give the noise.
    """
    strongest = np.argmax(np.where(np.isfinite(profiles.edges[..., 0]), profiles.strength, -1), 1)
    edge = profiles.pixels[np.arange(len(strongest)), strongest]
    away = np.arange(BESIDE_PX, max(BESIDE_PX + 3.0, BESIDE * radius_px)) * max(1, both.shrink)
    places = edge[:, None] + away[None, :, None] * profiles.outward[:, None]
    u, v = places[..., 0], places[..., 1]
    column, row = both.locate(u, v)
    mine = _sample(both.left, column, row)
    sector = np.arange(len(edge)) * SECTORS // len(edge)
    # Pixels of the patch to a sector, over those that share their error.
    area = 2 * np.pi * radius_px * (away[-1] - away[0] + 1.0) / SECTORS / both.shrink**2
    pictures = []
    for depth_m in DEPTHS_M:
        m = chart.m / (1.0 + depth_m * float(np.linalg.norm(chart.m)))
        pictures.append(_sample(both.right, both.on_plane(u, v, m), row))
    seen = np.stack(pictures)
    begins = np.flatnonzero(np.diff(sector, prepend=-1))
    count = np.bincount(sector) * len(away)

    def add_up(values: np.ndarray) -> np.ndarray:
        """Return the sums of values, `(…, P, A)`, over each sector, `(…, SECTORS)`."""
        return np.add.reduceat(values.sum(-1), begins, axis=-1)

    # Gain and offset are free: what remains is 1 - r² of the variance.
    shared = add_up(mine * seen) - add_up(mine) * add_up(seen) / count
    power = add_up(mine**2) - add_up(mine) ** 2 / count
    power = power * (add_up(seen**2) - add_up(seen) ** 2 / count)
    unlike = 1.0 - np.maximum(shared, 0.0) ** 2 / np.maximum(power, 1e-6)
    odds = -0.5 * area / ALIKE_PX2 * np.log(unlike + LEAST_UNLIKE).T
    return odds - odds.max(axis=1, keepdims=True)


def _measure_spread(log_odds: np.ndarray) -> float:
    """Return the standard deviation of a depth with log odds for each of `DEPTHS_M`, m."""
    weight = np.exp(log_odds - log_odds.max())
    weight /= weight.sum()
    depths_m = np.array(DEPTHS_M)
    mean_m = float(weight @ depths_m)
    # Beside an edge the break is less deep than at it.
    return float(np.hypot(np.sqrt(weight @ (depths_m - mean_m) ** 2), STRIP * mean_m))


def _sample(picture: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    return cv2.remap(
        picture, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR
    ).astype(float)
