"""Edges of a picture with sub-pixel places and directions, chained into convex arcs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

SCALE = 16.0
"""Gradients are given to Canny as whole numbers; in a dark picture they are a few grey levels a pixel."""

END_PX = 3.0
"""Of each arc: where it ends the edges of two things meet and are bent by the blur."""
NO_SPANS = np.empty((0, 2), int)


@dataclass(frozen=True)
class Edges:
    """Edge points, `E` of them, in the order in which chains run.

    Attributes:
        points: Sub-pixel places `(E, 2)`.
        directions: Unit gradients `(E, 2)`, from dark to bright.
        chain: Number of the connected chain of each point, `(E,)`.
        nearest: Number of the edge point nearest to each pixel, `(h, w)`.
        spans: Pieces of chains without a branch, `(S, 2)`: first point and one past the last.
        arcs: Convex arcs, spans too, `(A, 2)`.
        arc: Number of the arc of each point, `(E,)`, -1 for none.
        arc_length: `(A,)` px.
    """

    points: np.ndarray
    directions: np.ndarray
    chain: np.ndarray
    nearest: np.ndarray
    spans: np.ndarray
    arcs: np.ndarray
    arc: np.ndarray
    arc_length: np.ndarray

    def cut(self, tolerance_px: float, corner_rad: float, least: int) -> Edges:
        """Returns the same edges with their convex arcs; see `_arcs`."""
        arcs = _arcs(self, tolerance_px, corner_rad, least)
        step = np.zeros(len(self.points))
        step[2:-2] = np.linalg.norm(self.points[4:] - self.points[:-4], axis=1) / 4  # over four points: they scatter
        way = np.cumsum(np.minimum(step, 1.5))
        arc = np.full(len(self.points), -1)
        for number, (start, stop) in enumerate(arcs):
            arc[start:stop] = number
        return replace(self, arcs=arcs, arc=arc, arc_length=np.maximum(way[arcs[:, 1] - 1] - way[arcs[:, 0]] - END_PX, 1.0))


def find(gray: np.ndarray, roi: np.ndarray | None, sigma_px: float, percentile: float, noise: float, low: float) -> Edges:
    """Returns the edges of a picture.

    Thresholds follow the picture, so that dark and hazy ones have edges too: the upper one is the given percentile of the gradient,
    at least `noise` times what the gradient of noise alone would be, and at least a grey level a pixel.

    Args:
        gray: `(h, w)` uint8.
        roi: `(h, w)` bool, `None` for everywhere.
        sigma_px: Gaussian blur before the gradient.
        percentile: Of the gradient's magnitude, 0 to 100.
        noise: Upper threshold in standard deviations of the gradient of noise, as the median magnitude tells it.
        low: Lower threshold as a part of the upper one.
    """
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma_px)
    gx, gy = (cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=0.125) for dx in (1, 0))
    magnitude = cv2.magnitude(gx, gy)
    looked = magnitude[::2, ::2] if roi is None else magnitude[roi]
    if not looked.size:
        return _none(gray.shape)
    median, upper = np.percentile(looked, (50.0, percentile))
    upper = max(float(upper), noise * float(median) / 1.18, 1.0)  # the median of a Rayleigh distribution is 1.18 sigma
    whole = [np.clip(g * SCALE, -32000, 32000).astype(np.int16) for g in (gx, gy)]
    canny = cv2.Canny(whole[0], whole[1], low * upper * SCALE, upper * SCALE, L2gradient=True)
    if roi is not None:
        canny[~roi] = 0
    canny[[0, -1]] = canny[:, [0, -1]] = 0
    contours, _ = cv2.findContours(canny, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return _none(gray.shape)
    pixels, chain, spans = _chains(contours, gray.shape, canny)
    points, directions = _refined(pixels, gx, gy, magnitude)
    return Edges(points, directions, chain, _nearest(pixels, gray.shape), spans, NO_SPANS, np.full(len(points), -1), np.empty(0))


def _arcs(edges: Edges, tolerance_px: float, corner_rad: float, least: int) -> np.ndarray:
    """Returns convex arcs as spans of edge points, `(A, 2)`: pieces of chains cut where they bend back and at corners.

    Args:
        edges: Edges.
        tolerance_px: How closely a polygon follows a piece; what bends less is straight.
        corner_rad: A polygon that turns by more at a vertex has a corner there.
        least: Arcs with fewer points are left out.
    """
    found = []
    for start, stop in edges.spans:
        if stop - start < least:
            continue
        curve = np.round(edges.points[start:stop] * 16).astype(np.int32)
        corners = cv2.approxPolyDP(curve[:, None], tolerance_px * 16, False)[:, 0]
        cuts = _cuts(corners / 16.0, tolerance_px, corner_rad)
        if len(cuts):
            places = _places(curve, corners)[cuts]
            bounds = np.concatenate([[0], places, [stop - start]]) + start
        else:
            bounds = np.array([start, stop])
        found += [(int(i), int(j)) for i, j in pairwise(bounds) if j - i >= least]
    return np.array(found, dtype=int).reshape(-1, 2)


def _cuts(corners: np.ndarray, tolerance_px: float, corner_rad: float) -> np.ndarray:
    """Returns the vertices of a polygon at which it has a corner or begins to bend the other way.

    A polygon that follows a circle within the tolerance turns by eight times it over the length of its sides at each vertex, and
    a corner by more than that and `corner_rad` together.
    """
    if len(corners) < 3:
        return np.empty(0, int)
    steps = np.diff(corners.astype(float), axis=0)
    turn = np.arctan2(steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0], (steps[:-1] * steps[1:]).sum(1))
    size = np.linalg.norm(steps, axis=1)
    sharp = np.abs(turn) > corner_rad + 16 * tolerance_px / (size[1:] + size[:-1])
    back = np.concatenate([[False], turn[1:] * turn[:-1] < 0])
    return np.flatnonzero(sharp | back) + 1


def _places(curve: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Returns where the vertices of a polygon stand in the curve that it approximates, in order."""
    keys = {tuple(point): i for i, point in reversed(list(enumerate(curve.tolist())))}
    places = np.array([keys[tuple(corner)] for corner in corners.tolist()])
    return np.maximum.accumulate(places)


def _chains(contours: Sequence, shape: tuple, canny: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns edge pixels `(E, 2)` in order, each once, their chains, and unbranched spans.

    A contour runs around a line of edge pixels: along both sides of an open one, inside and outside of a closed one. Taking each
    pixel where it comes first leaves the line, cut at its ends and branches. An open line whose topmost pixel lies within it comes
    in two halves, which are joined.
    """
    lengths = np.array([len(c) for c in contours])
    order = np.argsort(-lengths, kind="stable")
    pixels = np.concatenate([contours[i][:, 0] for i in order])
    contour = np.repeat(np.arange(len(contours)), lengths[order])
    first = np.sort(np.unique(pixels[:, 1].astype(np.int64) * shape[1] + pixels[:, 0], return_index=True)[1])
    pixels, contour = pixels[first], contour[first]
    step = np.abs(np.diff(pixels.astype(int), axis=0)).max(1)
    cut = np.flatnonzero((step > 1) | (np.diff(contour) != 0)) + 1
    bounds = np.concatenate([[0], cut, [len(pixels)]])
    pieces = np.column_stack([bounds[:-1], bounds[1:]])
    place = np.arange(len(pixels))
    joined, skip = [], False
    for k, (start, stop) in enumerate(pieces):
        if skip:
            skip = False
            continue
        if k + 1 < len(pieces) and contour[start] == contour[pieces[k + 1][0]]:
            other = pieces[k + 1]
            if np.abs(pixels[start].astype(int) - pixels[other[0]]).max() <= 1 and stop - start > 1:
                place[start:stop] = place[start:stop][::-1]
                joined.append((start, other[1]))
                skip = True
                continue
        joined.append((start, stop))
    pixels = pixels[place]
    chain = cv2.connectedComponents(canny, connectivity=8, ltype=cv2.CV_32S)[1][pixels[:, 1], pixels[:, 0]]
    return pixels, chain, np.array(joined, dtype=int).reshape(-1, 2)


def _refined(pixels: np.ndarray, gx: np.ndarray, gy: np.ndarray, magnitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns where along its gradient each edge pixel's gradient is strongest, by a parabola through three samples."""
    x, y = pixels[:, 0], pixels[:, 1]
    here = np.maximum(magnitude[y, x], 1e-6)
    direction = np.column_stack([gx[y, x], gy[y, x]]) / here[:, None]
    before, after = (_bilinear(magnitude, pixels + side * direction) for side in (-1.0, 1.0))
    bend = before - 2 * here + after
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = np.where(bend < 0, 0.5 * (before - after) / bend, 0.0)
    return pixels + np.clip(shift, -0.75, 0.75)[:, None] * direction, direction


def _nearest(pixels: np.ndarray, shape: tuple) -> np.ndarray:
    """Returns the number of the edge pixel nearest to each pixel, `(h, w)`."""
    blank = np.ones(shape, np.uint8)
    blank[pixels[:, 1], pixels[:, 0]] = 0
    labels = np.asarray(cv2.distanceTransformWithLabels(blank, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)[1], np.int32)
    number = np.zeros(len(pixels) + 1, np.int32)
    number[labels[pixels[:, 1], pixels[:, 0]]] = np.arange(len(pixels))
    return number[labels]


def _bilinear(picture: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns the picture between its pixels, at `(E, 2)` points away from its border."""
    x0, y0 = (np.clip(np.floor(points[:, k]).astype(int), 0, picture.shape[1 - k] - 2) for k in (0, 1))
    fx, fy = points[:, 0] - x0, points[:, 1] - y0
    top = picture[y0, x0] * (1 - fx) + picture[y0, x0 + 1] * fx
    bottom = picture[y0 + 1, x0] * (1 - fx) + picture[y0 + 1, x0 + 1] * fx
    return top * (1 - fy) + bottom * fy


def _none(shape: tuple) -> Edges:
    empty = np.empty((0, 2))
    none = np.empty(0, int)
    return Edges(empty, empty, none, np.zeros(shape, np.int32), NO_SPANS, NO_SPANS, none, np.empty(0))
