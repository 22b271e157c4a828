"""Support of an ellipse: the edge points along it, and how its arc ends where something hides it.

Axes: `C` candidates, `P` places around each, `M` ends of arcs.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.ndimage import uniform_filter1d

from brokk_rl.contracts.vision import Ellipse
from perception.ellipse import conic
from perception.ellipse.edges import Edges

NUM_SAMPLES = 96
"""Places around an ellipse at which its support is searched; 1 px apart on a rim of 15 px
radius."""
WINDOW = NUM_SAMPLES // 8
"""Neighbouring places over which noise is averaged: an eighth of a turn."""
ANGLES = np.arange(NUM_SAMPLES) * (2 * np.pi / NUM_SAMPLES)


@dataclass(frozen=True)
class EllipseCandidates:
    """Ellipses to be judged, `C` of them.

    Attributes:
        ellipses: `(C, 5)`.
        polarity: +1 where it is brighter outside, -1 where it is brighter inside, `(C,)`.
        edges: Edges of the picture.
    """

    ellipses: np.ndarray
    polarity: np.ndarray
    edges: Edges

    def __getitem__(self, keep: np.ndarray | slice) -> EllipseCandidates:
        return EllipseCandidates(self.ellipses[keep], self.polarity[keep], self.edges)


@dataclass(frozen=True)
class CandidateFit:
    """Quality of fit of `C` candidates.

    Attributes:
        candidates: Ellipses and polarity.
        support: Number of the edge point at each place, `(C, NUM_SAMPLES)`, -1 for none.
        length: Arc length per radian at each place, `(C, NUM_SAMPLES)`.
        coverage: Part of the circumference with support, `(C,)`.
        off_px: Distance of the support at each place, `(C, NUM_SAMPLES)`.
        rms_px: Root mean square of these distances.
        spread_px: Robust standard deviation of these distances.
        spread_limit_px: Its limit.
        angle_rad: Robust standard deviation of the angles between gradient and normal.
        angle_limit_rad: Its limit.
    """

    candidates: EllipseCandidates
    support: np.ndarray
    length: np.ndarray
    coverage: np.ndarray
    off_px: np.ndarray
    rms_px: np.ndarray
    spread_px: np.ndarray
    spread_limit_px: np.ndarray
    angle_rad: np.ndarray
    angle_limit_rad: np.ndarray

    def __getitem__(self, keep: np.ndarray) -> CandidateFit:
        return CandidateFit(*(getattr(self, field.name)[keep] for field in fields(self)))


def measure_wholeness(coverage: np.ndarray) -> np.ndarray:
    """Return 1 at full coverage, falling to 0 at one half.

    A part of an ellipse must fit better than a whole one: the lobe of a heart nearly fits.
    """
    return np.clip(2 * coverage - 1, 0.0, 1.0)


def gather_support(
    candidates: EllipseCandidates, angles_rad: np.ndarray, reach_px: np.ndarray, angle_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edge points that support each candidate at each eccentric angle, `(C, P)` each.

    A supporting point lies within reach, and its gradient along the normal, with the candidate's
    polarity.

    Returns:
        Number of the point, -1 where there is none; its distance along the normal, px; and the
        cosine between gradient and normal.
    """
    edges = candidates.edges
    points, outward, _ = conic.sample_ellipses(candidates.ellipses, angles_rad)
    found = edges.at(points)
    apart = edges.points[found] - points
    off = conic.sum_products(apart, outward)
    along = conic.sum_products(edges.directions[found], outward) * candidates.polarity[:, None]
    side = np.abs(apart[..., 0] * outward[..., 1] - apart[..., 1] * outward[..., 0])
    # The nearest edge point may lie far along the ellipse; it then belongs to another place.
    good = (np.abs(off) < reach_px[:, None]) & (side < 2.0)
    good &= along > np.cos(angle_rad)
    return np.where(good, found, -1), off, along


def measure_strength(fit: CandidateFit) -> np.ndarray:
    """Return the mean gradient of each candidate's support, grey levels a pixel, `(C,)`."""
    there = fit.support >= 0
    strength = fit.candidates.edges.strength[fit.support]
    return (strength * there).sum(1) / np.maximum(there.sum(1), 1)


def measure_purity(fit: CandidateFit) -> np.ndarray:
    """Return the part of the supporting edges, corner to corner, that lies on each candidate, `(C,)`.

    The edge of an occluded ellipse ends in a corner; that of a spiral or a heart leaves smoothly.
    """
    edges, support = fit.candidates.edges, fit.support
    there = support >= 0
    run = np.where(there, edges.run[support], -1)
    known = run >= 0
    ds = fit.length * (2 * np.pi / support.shape[1])
    # One key for ellipse and run, so that all are summed in one pass.
    key = np.arange(len(support))[:, None] * (len(edges.run_length) + 1) + run + 1
    _, number, inverse = np.unique(key[known], return_index=True, return_inverse=True)
    whole = edges.run_length[run[known]][number]
    share = np.bincount(inverse, ds[known], minlength=len(number)) / whole
    each = np.ones(support.shape)
    each[known] = np.minimum(share, 1.3)[inverse]  # of short runs a sample more or less
    return np.minimum((each * ds * there).sum(1) / np.maximum((ds * there).sum(1), 1e-9), 1.0)


def measure_waviness(fit: CandidateFit) -> tuple[np.ndarray, np.ndarray]:
    """Return the waviness of each support in distance, px, and in angle, rad, `(C,)` each.

    It is the root mean square of the means over an eighth of a turn. Noise averages out of these
    means; the misfit of a curve that is no ellipse stays.
    """
    candidates, there = fit.candidates, fit.support >= 0
    outward = conic.sample_ellipses(candidates.ellipses, ANGLES)[1]
    bright = candidates.edges.directions[fit.support] * candidates.polarity[:, None, None]
    turn = np.arctan2(
        outward[..., 0] * bright[..., 1] - outward[..., 1] * bright[..., 0],
        conic.sum_products(outward, bright),
    )
    known = _sum_windows(there)
    # Windows with few points average too little noise away.
    enough = known >= 0.6 * WINDOW
    return tuple(
        np.sqrt(
            ((_sum_windows(value * there) / np.maximum(known, 1)) ** 2 * enough).sum(1)
            / np.maximum(enough.sum(1), 1)
        )
        for value in (fit.off_px, turn)
    )


def _sum_windows(values: np.ndarray) -> np.ndarray:
    """Return the sum of `WINDOW` neighbours around each place, `(C, P)`."""
    return WINDOW * uniform_filter1d(values.astype(float), WINDOW, mode="wrap", origin=-1)


def measure_largest_gap(fit: CandidateFit) -> np.ndarray:
    """Return the longest stretch without support, as a part of the circumference, `(C,)`."""
    there, length = fit.support >= 0, fit.length
    twice = np.concatenate([there, there], 1)  # around twice: a stretch may run over the end
    # Length along the ellipse, since equal angles are unequal stretches on a flat one.
    way = np.cumsum(np.concatenate([length, length], 1), 1)
    seen = np.maximum.accumulate(np.where(twice, way, 0.0), 1)
    return np.minimum((way - seen).max(1, initial=0.0) / length.sum(1), 1.0)


def estimate_spread(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return a robust standard deviation of each row of `(C, P)`, from its smallest 70 %."""
    ordered = np.sort(np.where(there, values, np.inf), 1)
    place = np.maximum((0.7 * there.sum(1)).astype(int) - 1, 0)
    # 1.036 is the 70 % quantile of the absolute values of a standard normal distribution.
    return ordered[np.arange(len(values)), place] / 1.036


def compute_evidence(
    coverage: np.ndarray, angle_rms_rad: np.ndarray, perimeter_px: np.ndarray, angle_rad: float
) -> np.ndarray:
    """Return the decimal exponent of the odds against accidental support, `(C,)`.

    Chernoff's bound on the chance that so many random gradients point along the normal.
    """
    # The half-width of the angles that count, as a share of all directions; at least 0.1 rad, so
    # that a perfect fit is no proof.
    chance = np.clip(2.0 * angle_rms_rad, 0.1, angle_rad) / np.pi
    with np.errstate(divide="ignore", invalid="ignore"):
        absent = np.where(
            coverage < 1, (1 - coverage) * np.log10((1 - coverage) / (1 - chance)), 0.0
        )
        return np.where(
            coverage > chance,
            # Half of the pixels: neighbours are blurred together and no independent evidence.
            (coverage * np.log10(coverage / chance) + absent) * perimeter_px / 2,
            0.0,
        )


# Each of these times 0.8 or 1.25 left every count of 8 drawn patterns, 3 pictures of hidden discs and
# 6 negatives as it was. CHORD was not varied.
SAME_AREA = 0.6
"""Least ratio of areas of the two edges of one thin line."""
OPEN = 0.12
"""Part of the circumference without support from which its ends are examined."""
BACK_PX, STRIDE_PX = 4.0, 2.0
"""Start of the search before that end, and distance between its steps: beyond the
blur of a corner."""
NEAR_PX, LEAST_PX = 1.5, 0.5
"""Largest distance of the next edge point from a step, and least advance: where an edge ends, its
last point is found again."""
ALIKE = 1.5
"""Largest ratio of strengths along one edge: an occluder has edges of another strength."""
KINK_PX, KINK_RAD = 4.5, 0.4
"""Length over which an edge turns at a corner, and by how much more than the ellipse: a blurred
corner is about 4 px long."""
# The edge of an occluder, between the two ends of an arc.
CHORD = np.linspace(0.15, 0.85, 8)
"""Places on the chord, as parts of its length."""
CHORD_PX, CHORD_COSINE, CHORD_PART = 2.0, 0.85, 0.7
"""Largest distance of the edge from the chord, least cosine between its gradient and the chord's
normal, and part of the places that need it."""
BOW_PX, STROKE_PX = 0.6, 4.5
"""Largest bow of the edge, and least depth within the ellipse: the second edge of a bent line
follows the arc nearer than that."""


def find_smooth_continuations(fit: CandidateFit) -> np.ndarray:
    """Find candidates whose edge leaves them smoothly, `(C,)`: lobes of hearts, round corners, spirals.

    The edge of an occluded ellipse ends in a corner. An occluder of the same width may go on
    without a corner, but has an edge from one end of the arc to the other.
    """
    edges, support, length = fit.candidates.edges, fit.support, fit.length
    result = np.zeros(len(support), bool)
    ds = length * (2 * np.pi / support.shape[1])
    for side in (1, -1):  # by increasing and by decreasing angle
        row, end, hidden = _find_open_ends(fit, side)
        # Back beyond the corner, where the blur has already turned the edge.
        back = (end - side * np.ceil(BACK_PX / ds[row, end]).astype(int)) % NUM_SAMPLES
        start = np.where(support[row, back] >= 0, back, end)
        e = fit.candidates.ellipses[row]
        outward = conic.measure_sampson_distance(e, edges.points[support[row, start]][:, None])[1][
            :, 0
        ]
        onward = side * np.column_stack([-outward[:, 1], outward[:, 0]])
        size = np.sqrt(e[:, 2] * e[:, 3])
        # At least 6 px, beyond the blur, and at most 16 px.
        reach = np.clip(0.35 * size, 6.0, 16.0) + BACK_PX
        # Curvature of the ellipse at the end of the arc.
        bend = size**2 / length[row, end] ** 3
        goes_on = _follow_edges(edges, support[row, start], onward, reach, bend)
        result[row[goes_on & ~hidden]] = True
    return result


def find_occluded(fit: CandidateFit) -> np.ndarray:
    """Find candidates with the straight edge of an occluder between the ends of their arc, `(C,)`."""
    row, _, hidden = _find_open_ends(fit, 1)
    result = np.zeros(len(fit.support), bool)
    result[row[hidden]] = True
    return result


def _find_open_ends(fit: CandidateFit, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return candidate and last supported place before each wide gap, `(M,)` each.

    Also return whether the edge of an occluder leads to the first supported place after it. Before and
    after are meant by increasing angle for `side` 1, by decreasing angle for -1.
    """
    support, length = fit.support, fit.length
    there = support >= 0
    # A place with support whose next one has none.
    row, end = np.nonzero(there & ~np.roll(there, -side, 1))
    ahead = (end[:, None] + side * np.arange(1, NUM_SAMPLES)) % NUM_SAMPLES
    # Stops counting at the first place with support.
    free = np.cumprod(~there[row[:, None], ahead], axis=1)
    wide = (free * length[row[:, None], ahead]).sum(1) > OPEN * length.sum(1)[row]
    # The first supported place behind the gap.
    other = ((end + side * (1 + free.sum(1))) % NUM_SAMPLES)[wide]
    row, end = row[wide], end[wide]
    ends = support[row, end], support[row, other]
    candidates = fit.candidates
    return row, end, _find_occluding_edges(candidates.ellipses[row], candidates.edges, *ends)


def _find_occluding_edges(
    ellipses: np.ndarray, edges: Edges, one: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Find ellipses `(M, 5)` that a straight edge crosses between two of their edge points, `(M,)`.

    It must be fainter than the ellipse's own edge: as strong, it is the second edge of a thin bent
    object.

    Args:
        ellipses: `(M, 5)`.
        edges: Edges.
        one: Number of the first edge point, `(M,)`.
        other: Number of the second one, `(M,)`.
    """
    # The weaker of the two ends: the occluder must be fainter than both.
    usual = np.minimum(edges.strength[one], edges.strength[other])
    one, other = edges.points[one], edges.points[other]
    chord = other - one
    chord = chord / np.maximum(np.linalg.norm(chord, axis=1), 1e-9)[:, None]
    normal = np.column_stack([-chord[:, 1], chord[:, 0]])[:, None]
    places = one[:, None] + CHORD[:, None] * (other - one)[:, None]
    number = edges.at(places)
    off = conic.sum_products(edges.points[number] - places, normal)
    near = (number >= 0) & (np.abs(off) < CHORD_PX)
    near &= np.abs(conic.sum_products(edges.directions[number], normal)) > CHORD_COSINE
    # Positive inside the ellipse.
    deep = -conic.measure_sampson_distance(ellipses, edges.points[number])[0]
    near &= deep > CHORD_PX  # nearer it may be the ellipse's own edge
    inner, outer = np.s_[2:-2], np.array([0, 1, -2, -1])
    middle = (off * near)[:, inner].sum(1) / np.maximum(near[:, inner].sum(1), 1)
    ends = (off * near)[:, outer].sum(1) / np.maximum(near[:, outer].sum(1), 1)
    near &= edges.strength[number] < usual[:, None] / ALIKE
    return (
        (near.mean(1) >= CHORD_PART)
        & (np.abs(middle - ends) < BOW_PX)
        & (deep.max(1, initial=0.0, where=near) > STROKE_PX)
    )


def _follow_edges(
    edges: Edges, start: np.ndarray, onward: np.ndarray, reach_px: np.ndarray, bend: np.ndarray
) -> np.ndarray:
    """Find edges that go on without a corner and at the same strength, `(M,)`.

    Args:
        edges: Edges.
        start: Number of the first edge point, `(M,)`.
        onward: Direction of the edge there, `(M, 2)`.
        reach_px: Distance to follow, `(M,)`.
        bend: Curvature of the ellipse there, 1/px, `(M,)`; a turn by `KINK_RAD` more over `KINK_PX`
            is a corner.
    """
    place, along = edges.points[start], onward
    first = edges.directions[start]
    # On which hand the bright side is: it stays there along one edge.
    hand = np.sign(along[:, 0] * first[:, 1] - along[:, 1] * first[:, 0])
    seen, alive = [first], np.ones(len(start), bool)
    strength = np.zeros(len(start))
    for step in range(int(np.ceil(reach_px.max(initial=0.0) / STRIDE_PX))):
        # One stride ahead, then to the nearest edge there.
        onto = place + STRIDE_PX * along
        number = edges.at(onto)
        came = ((edges.points[number] - place) * along).sum(1)
        place = edges.points[number]
        bright = edges.directions[number]
        along = np.column_stack([bright[:, 1], -bright[:, 0]]) * hand[:, None]
        needed = step * STRIDE_PX < reach_px
        near = (np.linalg.norm(place - onto, axis=1) < NEAR_PX) & (came > LEAST_PX)
        # The direction some strides ago: a corner is a turn over a length, not at a point.
        earlier = seen[max(0, len(seen) - round(KINK_PX / STRIDE_PX))]
        turn = np.arccos(np.clip(conic.sum_products(bright, earlier), -1.0, 1.0))
        alive &= ~needed | (near & (turn < KINK_PX * bend + KINK_RAD))
        strength = np.where(needed, edges.strength[number], strength)
        seen.append(bright)
    alike = np.abs(np.log(np.maximum(strength, 1e-6) / edges.strength[start])) < np.log(ALIKE)
    return alive & alike


def is_other_side_of_line(row: np.ndarray, others: list[Ellipse]) -> bool:
    """Return whether an ellipse and one of the others are the two edges of a thin line."""
    for other in others:
        apart = np.abs(conic.as_row(other) - row)
        areas = row[2] * row[3], other.a * other.b
        is_near = apart[:2].max() < 0.5 * STROKE_PX and apart[2:4].max() < STROKE_PX
        if is_near and min(areas) > SAME_AREA * max(areas):
            return True
    return False
