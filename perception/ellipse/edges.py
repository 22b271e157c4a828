"""Edges of a picture at sub-pixel places, chained into convex arcs, and groups of these arcs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

SCALE = 16.0
"""Canny takes whole numbers: steps of 1/16 grey level a pixel, for pictures as dark as 2 of 255."""

# Each of these times 0.8 or 1.25 left every count of 8 drawn patterns, 3 pictures of hidden discs and
# 6 negatives as it was. MANY, SCALE, NUM_SEEDS and BACKWARD_RAD were not varied.
PERCENTILE, NOISE, LOW = 85.0, 4.0, 0.4
"""Upper threshold of edges: percentile of the gradient, and least value in standard deviations of
noise; lower threshold as a part of the upper one."""
END_PX = 3.0
"""Length at both ends of an arc that the blur bends towards the edge it meets, px."""
BLUNT_PX = 5.0
"""A polygon side shorter than this may be a corner cut off by the blur, px."""
MANY = 200_000
"""Pixels from which a sixteenth of them gives the quantiles of the gradient; below, a quarter."""
WEAK = 2.5
"""Lower threshold of edges, in standard deviations of noise: below it noise forms chains."""
LONG_PX, LONG = 25.0, 6.0
"""A side longer than this, px, and so many times longer than the next, is a straight line that
continues as a curve: the arc ends there."""
CLOSE = 4
"""Points from the ends of a closed line at which its directions are compared."""
NO_SPANS = np.empty((0, 2), int)
RAYLEIGH_MEDIAN = 1.18
"""Median of a Rayleigh distribution, the magnitude of pure noise, over its scale: sqrt(2 ln 2)."""


@dataclass(frozen=True)
class Edges:
    """Edge points, `E` of them, in the order of their chains.

    Attributes:
        points: Sub-pixel places `(E, 2)`.
        directions: Unit gradients `(E, 2)`, from dark to bright.
        strength: Length of the gradient `(E,)`, grey levels a pixel.
        nearest: Number of the edge point nearest to each pixel, `(h, w)`, -1 for none.
        spans: Pieces of chains without a branch, `(S, 2)`: first point and one past the last.
        arcs: Convex arcs, spans too, `(A, 2)`.
        run: Number of the piece from corner to corner around each point, `(E,)`, -1 for a short
            one.
        run_length: Length of each such piece, px.
    """

    points: np.ndarray
    directions: np.ndarray
    strength: np.ndarray
    nearest: np.ndarray
    spans: np.ndarray
    arcs: np.ndarray
    run: np.ndarray
    run_length: np.ndarray

    def cut(self, tolerance_px: float, corner_rad: float, least: int) -> Edges:
        """Return the same edges with convex arcs and runs from corner to corner.

        See `_split_chains` for the arguments.
        """
        arcs, runs = _split_chains(self, tolerance_px, corner_rad, least)
        step = np.zeros(len(self.points))
        # Over four points, since single ones scatter.
        step[2:-2] = np.linalg.norm(self.points[4:] - self.points[:-4], axis=1) / 4
        # At most 1.5 px a step: a jump between two chains is no way.
        way = np.cumsum(np.minimum(step, 1.5))
        run = np.full(len(self.points), -1)
        for number, (start, stop) in enumerate(runs.tolist()):
            run[start:stop] = number
        # The blurred end of a run belongs to the edge that it meets.
        length = way[runs[:, 1] - 1] - way[runs[:, 0]] - END_PX
        # The point at which a closed line begins is no corner: both its runs are one.
        for start, stop in self._find_closed_spans().tolist():
            first, last = run[start], run[stop - 1]
            if first != last and min(first, last) >= 0:
                run[run == last] = first
                length[first] += length[last]
        return replace(self, arcs=arcs, run=run, run_length=np.maximum(length, 1.0))

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the number of the edge point nearest to each place `(…, 2)`, -1 where none is near."""
        height, width = self.nearest.shape
        x, y = np.rint(points[..., 0]), np.rint(points[..., 1])
        place = (y * width + x).astype(np.intp)
        # Places outside get the corner pixel: the border of the picture has no edges.
        place[(x < 0) | (y < 0) | (x >= width) | (y >= height)] = 0
        return self.nearest.ravel().take(place)

    def _find_closed_spans(self) -> np.ndarray:
        """Return the spans that end where they begin, without a corner there, `(S, 2)`."""
        # Too short a line has no two ends to compare.
        start, stop = self.spans[self.spans[:, 1] - self.spans[:, 0] > 4 * CLOSE].T
        near = np.linalg.norm(self.points[start] - self.points[stop - 1], axis=1) < 3
        # A cosine of 0.8 allows a turn of 37 degrees.
        smooth = (self.directions[start + CLOSE] * self.directions[stop - 1 - CLOSE]).sum(1) > 0.8
        return np.column_stack([start, stop])[near & smooth]


def detect_edges(
    gray: np.ndarray, roi: np.ndarray | None, sigma_px: float, least: int, near_px: int
) -> Edges | None:
    """Return the edges of a picture, `None` where there are none.

    The thresholds adapt to dark and hazy pictures. The upper one is a percentile of the gradient,
    at least `NOISE` times the gradient of noise, and at least 1 grey level a pixel.

    Args:
        gray: `(h, w)` uint8.
        roi: `(h, w)` bool, `None` for everywhere.
        sigma_px: Gaussian blur before the gradient.
        least: Least number of points of a contour.
        near_px: Largest distance at which `Edges.nearest` names an edge point.
    """
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma_px)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    magnitude = cv2.magnitude(gx, gy)
    # A subsample of a regular grid gives the same quantiles at a fraction of the time.
    some = np.s_[::2, ::2] if magnitude.size < MANY else np.s_[::4, ::4]
    looked = magnitude[some].ravel() if roi is None else magnitude[some][roi[some]]
    if not looked.size:
        return None
    ranks = [round(part / 100.0 * (looked.size - 1)) for part in (50.0, PERCENTILE)]
    median, upper = np.partition(looked, ranks)[ranks]
    # The median gradient is nearly all noise, since edges are rare.
    sigma = float(median) / RAYLEIGH_MEDIAN
    upper = max(float(upper), NOISE * sigma, 1.0)
    # Below the lower threshold, chains of noise would connect edges.
    weak = max(LOW * upper, WEAK * sigma)
    # Canny accepts own gradients as 16-bit integers only.
    whole = [cv2.addWeighted(g, SCALE, g, 0.0, 0.0, dtype=cv2.CV_16S) for g in (gx, gy)]
    canny = cv2.Canny(whole[0], whole[1], weak * SCALE, max(upper, weak) * SCALE, L2gradient=True)
    if roi is not None:
        canny = cv2.bitwise_and(canny, canny, mask=roi.view(np.uint8))
    # The border has no neighbours for sub-pixel places.
    canny[[0, -1]] = canny[:, [0, -1]] = 0
    contours = []
    for c in cv2.findContours(canny, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        if len(c) >= least:
            contours.append(c)
    if not contours:
        return None
    pixels, spans = _chain_pixels(contours, gray.shape, least)
    if not len(pixels):
        return None
    points, directions = _refine_points(pixels, gx, gy, magnitude)
    # Strength of the pixel, not of the refined place: ratios of it are compared only roughly.
    strength = magnitude[pixels[:, 1], pixels[:, 0]]
    return Edges(
        points, directions, strength, _map_nearest_edges(pixels, gray.shape, near_px), spans, NO_SPANS,
        np.full(len(points), -1), np.empty(0),
    )  # fmt: skip


def _split_chains(
    edges: Edges, tolerance_px: float, corner_rad: float, least: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return convex arcs and runs as spans of edge points, `(A, 2)` each.

    Both are cut at corners, arcs also where they bend back. A polygon that follows a circle within
    the tolerance turns by 8 tolerances per side length at each vertex. A turn larger than that by
    `corner_rad` is a corner.

    Args:
        edges: Edges.
        tolerance_px: Tolerance of the polygon along a chain.
        corner_rad: Turn in excess of a circle's at a corner.
        least: Least number of points of a piece.
    """
    spans = edges.spans[edges.spans[:, 1] - edges.spans[:, 0] >= least]
    if not len(spans):
        return NO_SPANS, NO_SPANS
    # Sixteenths of a pixel: the polygon's algorithm needs integers and keeps sub-pixel places.
    fine = np.round(edges.points * 16).astype(np.int32)
    polygons = []
    for start, stop in spans.tolist():
        polygons.append(cv2.approxPolyDP(fine[start:stop, None], tolerance_px * 16, False)[:, 0])
    owner = np.repeat(np.arange(len(spans)), [len(polygon) for polygon in polygons])
    corners = np.concatenate(polygons)
    steps = np.diff(corners / 16.0, axis=0)
    # The signed turn at each corner, in (-pi, pi].
    turn = np.arctan2(
        steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0], (steps[:-1] * steps[1:]).sum(1)
    )
    size = np.linalg.norm(steps, axis=1)
    # Corners of two different polygons are no turn.
    inner = owner[2:] == owner[:-2]
    # Half the turn of a circle at the ends of a chord of this length.
    half = 4 * tolerance_px / np.maximum(size, 1.0)
    sharp = np.abs(turn) > corner_rad + half[1:] + half[:-1]
    # A corner cut off by the blur: a short side with large turns at both ends.
    cut_off = (size[1:-1] < BLUNT_PX) & inner[1:] & inner[:-1]
    cut_off &= np.abs(turn[1:] + turn[:-1]) > corner_rad + half[2:] + half[:-2]
    sharp[:-1] |= cut_off
    sharp[1:] |= cut_off
    # A long straight side next to a short one is a line that runs into a curve.
    straight = (np.maximum(size[1:], size[:-1]) > LONG_PX) & (
        np.maximum(size[1:], size[:-1]) > LONG * np.minimum(size[1:], size[:-1])
    )
    # A change of sign of the turn: the arc bends the other way.
    back = np.concatenate([[False], (turn[1:] * turn[:-1] < 0) & inner[1:] & inner[:-1]])
    found = []
    place = _locate_corners(fine, spans, corners, owner)
    # Arcs end at bends too, runs only at corners.
    for cuts in ((sharp | back | straight) & inner, (sharp | straight) & inner):
        bounds = np.unique(np.concatenate([spans.ravel(), place[np.flatnonzero(cuts) + 1]]))
        pieces = np.column_stack([bounds[:-1], bounds[1:]])
        # The span of each piece: a piece must not reach across two of them.
        within = np.searchsorted(spans[:, 0], pieces[:, 0], side="right") - 1
        found.append(
            pieces[(pieces[:, 1] <= spans[within, 1]) & (pieces[:, 1] - pieces[:, 0] >= least)]
        )
    return found[0], found[1]


def _locate_corners(
    fine: np.ndarray, spans: np.ndarray, corners: np.ndarray, owner: np.ndarray
) -> np.ndarray:
    """Return the number of the edge point at each corner of the polygons of spans."""
    member = np.concatenate([np.arange(start, stop) for start, stop in spans.tolist()])
    span = np.repeat(np.arange(len(spans)), spans[:, 1] - spans[:, 0])

    # One integer for span and place, so that all corners are found by a single sorted search.
    def key(number: np.ndarray, points: np.ndarray) -> np.ndarray:
        return (
            (number.astype(np.int64) << 40)
            + (points[:, 1].astype(np.int64) + 64 << 20)
            + points[:, 0]
            + 64
        )

    keys = key(span, fine[member])
    order = np.argsort(keys, kind="stable")
    return member[order[np.searchsorted(keys[order], key(owner, corners))]]


def _chain_pixels(contours: Sequence, shape: tuple, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Return edge pixels `(E, 2)` in order, each once, and unbranched spans.

    A contour runs around a line of edge pixels: along both sides of an open one, inside and outside
    of a closed one. Each pixel is kept where it comes first. This leaves the line, cut at its ends
    and branches. An open line whose topmost pixel is no end comes in two halves, which are joined.
    """
    lengths = np.array([len(c) for c in contours])
    # Longest contours first: a pixel of two contours belongs to the longer one.
    order = np.argsort(-lengths, kind="stable")
    pixels = np.concatenate([contours[i][:, 0] for i in order])
    contour = np.repeat(np.arange(len(contours)), lengths[order])
    first = np.sort(
        np.unique(pixels[:, 1].astype(np.int64) * shape[1] + pixels[:, 0], return_index=True)[1]
    )
    pixels, contour = pixels[first], contour[first]
    # Neighbouring pixels differ by one at most; a larger step is a break.
    step = np.abs(np.diff(pixels.astype(int), axis=0)).max(1)
    cut = np.flatnonzero((step > 1) | (np.diff(contour) != 0)) + 1
    bounds = np.concatenate([[0], cut, [len(pixels)]])
    pieces = np.column_stack([bounds[:-1], bounds[1:]])
    pieces = pieces[pieces[:, 1] > pieces[:, 0]]
    start, following = pieces[:-1, 0], pieces[1:, 0]
    # Both halves begin at the same pixel, and the first is turned round.
    halves = (contour[start] == contour[following]) & (
        np.abs(pixels[start].astype(int) - pixels[following]).max(1) <= 1
    )
    halves &= pieces[:-1, 1] - start > 1
    # A piece is joined once at most.
    halves[1:] &= ~halves[:-1]
    place = np.arange(len(pixels))
    for begin, end in pieces[:-1][halves].tolist():
        place[begin:end] = place[begin:end][::-1]
    ends = np.append(pieces[:-1, 1], pieces[-1:, 1])
    ends[:-1][halves] = pieces[1:, 1][halves]
    joined = np.column_stack([pieces[:, 0], ends])[np.append(True, ~halves)]
    length = joined[:, 1] - joined[:, 0]
    long = length >= least  # the rest of a line two pixels wide is no edge
    pixels = pixels[place][np.repeat(long, length)]
    ends = np.cumsum(length[long])
    joined = np.column_stack([ends - length[long], ends])
    return pixels, joined


def _refine_points(
    pixels: np.ndarray, gx: np.ndarray, gy: np.ndarray, magnitude: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the place of the strongest gradient along each edge pixel's gradient, and its direction.

    By a parabola through three samples, 1 px apart.
    """
    x, y = pixels[:, 0], pixels[:, 1]
    here = np.maximum(magnitude[y, x], 1e-6)
    direction = np.column_stack([gx[y, x], gy[y, x]]) / here[:, None]
    # A parabola needs a sample on each side of the maximum.
    before, after = (
        map_coordinates(magnitude, (pixels + way * direction)[:, ::-1].T, float, order=1)
        for way in (-1, 1)
    )
    bend = before - 2 * here + after
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = np.where(bend < 0, 0.5 * (before - after) / bend, 0.0)
    # Three quarters of a pixel: farther away the pixel beside it is the maximum.
    return pixels + np.clip(shift, -0.75, 0.75)[:, None] * direction, direction


def _map_nearest_edges(pixels: np.ndarray, shape: tuple, near_px: int) -> np.ndarray:
    """Return the number of the edge pixel nearest to each pixel within `near_px`, `(h, w)`, else -1.

    Each edge pixel writes its number around itself, the farthest place first. This costs less than
    a distance transform of the whole picture.
    """
    # A margin of `near_px` spares the test for the border in the inner loop.
    height, width = shape[0] + 2 * near_px, shape[1] + 2 * near_px
    number = np.full(height * width, -1, np.int32)
    down, across = np.mgrid[-near_px : near_px + 1, -near_px : near_px + 1].reshape(2, -1)
    away = down**2 + across**2
    place = (pixels[:, 1].astype(np.intp) + near_px) * width + pixels[:, 0] + near_px
    mine = np.arange(len(pixels), dtype=np.int32)
    # Nearest last: it overwrites the farther ones.
    for k in np.argsort(-away, kind="stable")[np.count_nonzero(away > near_px**2) :].tolist():
        number[place + (down[k] * width + across[k])] = mine
    return np.ascontiguousarray(number.reshape(height, width)[near_px:-near_px, near_px:-near_px])


NUM_SEEDS = 28
"""Points that stand for an arc, or a group of arcs, in its first fit."""
PIECE = 0.6
"""Part of an arc that may be an ellipse's where not all of it is."""
INSET = 3
"""Points at the ends of an arc that are left out: the blur bends them."""
NEAREST = 16
"""Candidates for the next arc of a group."""
STRAIGHT_PX = 0.35
"""Deviation from its chord below which an arc counts as straight, px."""
# Limits for two arcs of one ellipse: wide, since the fit decides; see the first constants.
UNEVEN_RAD, TOTAL_RAD, BACKWARD_RAD = 0.6, 2.6, -0.1
"""Difference and sum of the angles between the chord and the two tangents, and least such angle."""
BEND_RATIO, BEND_LOG = 5, 1.1
"""Ratio of the curvatures of both arcs; logarithm of the ratio between the curvature of the circle
through the gap and their mean."""


def group_arcs(arcs: np.ndarray, edges: Edges, numbers: Sequence[int]) -> list[np.ndarray]:
    """Return groups of arcs that may follow one another around an ellipse, `(M, number)` for each number.

    Rows index `arcs`; each arc is the likeliest successor of the one before. On a circle the chord
    between two arcs halves the angle between their tangents; on an ellipse nearly so. Both arcs
    bend to the same side, about as strongly, and are bright on the same side.
    """
    following = _find_successors(arcs, edges) if len(arcs) > 1 else np.full(len(arcs), -1)
    found = []
    for number in numbers:
        groups = np.flatnonzero(following >= 0)[:, None]
        for _ in range(number - 1):
            # Only arcs with a successor can continue a group.
            groups = groups[following[groups[:, -1]] >= 0]
            groups = np.column_stack([groups, following[groups[:, -1]]])
        # Sorted, so that the same group found from two beginnings is one.
        groups = np.sort(groups, 1)
        groups = groups[(groups[:, 1:] > groups[:, :-1]).all(1)]
        key = groups @ (len(arcs) ** np.arange(number)[::-1])
        found.append(groups[np.unique(key, return_index=True)[1]])
    return found


def split_arcs(arcs: np.ndarray, least: int) -> np.ndarray:
    """Return first, middle and last piece of each arc, of `least` points or more.

    The ends of an arc may belong to something else.
    """
    start, length = arcs[:, 0], arcs[:, 1] - arcs[:, 0]
    # Not shorter than an arc may be.
    part = np.maximum((PIECE * length).astype(int), least)
    is_long = length > part + 2
    start, part, left = start[is_long], part[is_long], (length - part)[is_long]
    pieces = []
    for shift in (0 * part, left // 2, left):
        pieces.append(np.column_stack([start + shift, start + shift + part]))
    return np.concatenate(pieces)


def select_seed_points(groups: np.ndarray) -> np.ndarray:
    """Return evenly spread points of each group of spans `(C, G, 2)`, `(C, NUM_SEEDS)`."""
    ends = np.cumsum(groups[..., 1] - groups[..., 0], 1)
    # Middles of equal stretches, so that no seed lies on an end.
    place = (np.arange(NUM_SEEDS) + 0.5) / NUM_SEEDS * ends[:, -1:]
    number = (place[..., None] >= ends[:, None]).sum(-1)
    rows = np.arange(len(groups))[:, None]
    before = np.concatenate([np.zeros((len(ends), 1), int), ends], 1)[rows, number]
    return (groups[rows, number, 0] + place - before).astype(int)


def _find_successors(arcs: np.ndarray, edges: Edges) -> np.ndarray:
    """Return the number of the best successor of each arc, `(A,)`, -1 for none."""
    # A quarter of a short arc at most: it must keep its middle.
    inset = np.minimum(INSET, (arcs[:, 1] - arcs[:, 0]) // 4)
    first, last, middle = arcs[:, 0] + inset, arcs[:, 1] - 1 - inset, arcs.sum(1) // 2
    start, stop = edges.points[first], edges.points[last]
    towards = (start + stop) / 2 - edges.points[middle]
    chord = stop - start
    side = chord[:, 0] * towards[:, 1] - chord[:, 1] * towards[:, 0]
    turned = side < 0  # all shall have their inside on the same hand
    start, stop = np.where(turned[:, None], stop, start), np.where(turned[:, None], start, stop)
    polarity = np.sign((edges.directions[middle] * towards).sum(1))
    depth, width = np.linalg.norm(towards, axis=1), np.linalg.norm(chord, axis=1)
    # Curvature of the circle through chord and sagitta.
    bend = 8 * depth / np.maximum(width**2 + 4 * depth**2, 1e-9)
    head = _compute_tangents(edges, first, polarity)
    tail = _compute_tangents(edges, last, polarity)
    head, tail = np.where(turned[:, None], tail, head), np.where(turned[:, None], head, tail)
    usable = np.flatnonzero((depth > STRAIGHT_PX) & (width > 2))
    result = np.full(len(arcs), -1)
    if len(usable) < 2:
        return result
    # Only near neighbours can follow: comparing all pairs would take the square of their number.
    near = KDTree(start[usable]).query(stop[usable], k=min(NEAREST, len(usable)))[1]
    other = usable[near]
    gap = start[other] - stop[usable][:, None]
    length = np.maximum(np.linalg.norm(gap, axis=-1), 1e-6)
    leaving = _measure_turn(tail[usable][:, None], gap)
    arriving = _measure_turn(gap, head[other])
    total = leaving + arriving
    mean_bend = (bend[usable][:, None] + bend[other]) / 2
    # Ratios of curvature, as a circle seen obliquely bends unevenly.
    ratio = np.maximum(bend[usable][:, None], bend[other]) / np.maximum(
        np.minimum(bend[usable][:, None], bend[other]), 1e-9
    )
    uneven = np.abs(leaving - arriving)
    strength = np.abs(
        np.log(np.maximum(2 * np.sin(np.clip(total, 0.02, np.pi) / 2) / length, 1e-6) / mean_bend)
    )
    good = (
        (other != usable[:, None])
        & (polarity[other] == polarity[usable][:, None])
        & (uneven < UNEVEN_RAD)
        & (ratio < BEND_RATIO)
    )
    good &= (leaving > BACKWARD_RAD) & (arriving > BACKWARD_RAD)
    good &= (total < TOTAL_RAD) & (strength < BEND_LOG)
    # A weighted sum of the misfits.
    cost = np.where(good, uneven + 0.5 * strength + 0.2 * np.log(ratio), np.inf)
    best = np.argmin(cost, 1)
    rows = np.arange(len(usable))
    result[usable] = np.where(np.isfinite(cost[rows, best]), other[rows, best], -1)
    return result


def _compute_tangents(edges: Edges, place: np.ndarray, polarity: np.ndarray) -> np.ndarray:
    """Return the direction of each arc at a point, with its inside on the right hand, `(A, 2)`."""
    # Over three points, since single gradients scatter.
    near = np.clip(place[:, None] + np.array([-1, 0, 1]), 0, len(edges.directions) - 1)
    inward = edges.directions[near].sum(1) * polarity[:, None]
    return np.column_stack([inward[:, 1], -inward[:, 0]])


def _measure_turn(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the signed angle from one direction to another, rad."""
    return np.arctan2(
        first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0], (first * second).sum(-1)
    )
