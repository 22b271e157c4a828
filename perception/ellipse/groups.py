"""Groups of arcs that follow one another around an ellipse of which something hides the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from perception.ellipse.edges import Edges

INSET = 3
"""Points at the end of an arc that are bent by what it meets there."""
NEAREST = 16
"""Arcs that are looked at as the next one."""
STRAIGHT_PX = 0.35
"""What deviates less from its chord bends nowhere."""


def find(arcs: np.ndarray, edges: Edges, numbers: Sequence[int]) -> list[np.ndarray]:
    """Returns groups of so many arcs each, `(M, number)`, numbers into `arcs`, each the likeliest next one of the one before.

    Where a circle's arc ends and its next one begins, the chord between them halves the angle
    between their tangents; of an ellipse nearly so. Both bend to the same side, with the bright on
    the same side, about as strongly.
    """
    following = _next(arcs, edges) if len(arcs) > 1 else np.full(len(arcs), -1)
    found = []
    for number in numbers:
        groups = np.flatnonzero(following >= 0)[:, None]
        for _ in range(number - 1):
            groups = groups[following[groups[:, -1]] >= 0]
            groups = np.column_stack([groups, following[groups[:, -1]]])
        groups = np.sort(groups, 1)
        groups = groups[(groups[:, 1:] > groups[:, :-1]).all(1)]
        key = groups @ (len(arcs) ** np.arange(number)[::-1])
        found.append(groups[np.unique(key, return_index=True)[1]])
    return found


def _next(arcs: np.ndarray, edges: Edges) -> np.ndarray:
    """Returns the number of the arc that follows each one best, `(A,)`, -1 for none."""
    inset = np.minimum(INSET, (arcs[:, 1] - arcs[:, 0]) // 4)
    first, last, middle = arcs[:, 0] + inset, arcs[:, 1] - 1 - inset, arcs.sum(1) // 2
    start, stop = edges.points[first], edges.points[last]
    towards = (start + stop) / 2 - edges.points[middle]
    chord = stop - start
    side = chord[:, 0] * towards[:, 1] - chord[:, 1] * towards[:, 0]
    turned = side < 0  # all run so that the inside is on the same hand
    start, stop = np.where(turned[:, None], stop, start), np.where(turned[:, None], start, stop)
    polarity = np.sign((edges.directions[middle] * towards).sum(1))
    depth, width = np.linalg.norm(towards, axis=1), np.linalg.norm(chord, axis=1)
    bend = 8 * depth / np.maximum(width**2 + 4 * depth**2, 1e-9)
    head, tail = (_tangent(edges, place, polarity) for place in (first, last))
    head, tail = np.where(turned[:, None], tail, head), np.where(turned[:, None], head, tail)
    usable = np.flatnonzero((depth > STRAIGHT_PX) & (width > 2))
    result = np.full(len(arcs), -1)
    if len(usable) < 2:
        return result
    near = KDTree(start[usable]).query(stop[usable], k=min(NEAREST, len(usable)))[1]
    other = usable[near]
    gap = start[other] - stop[usable][:, None]
    length = np.maximum(np.linalg.norm(gap, axis=-1), 1e-6)
    leaving = _turn(tail[usable][:, None], gap)
    arriving = _turn(gap, head[other])
    total = leaving + arriving
    mean_bend = (bend[usable][:, None] + bend[other]) / 2
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
        & (uneven < 0.6)
        & (ratio < 5)
    )
    good &= (leaving > -0.1) & (arriving > -0.1) & (total < 2.6) & (strength < 1.1)
    cost = np.where(good, uneven + 0.5 * strength + 0.2 * np.log(ratio), np.inf)
    best = np.argmin(cost, 1)
    rows = np.arange(len(usable))
    result[usable] = np.where(np.isfinite(cost[rows, best]), other[rows, best], -1)
    return result


def _tangent(edges: Edges, place: np.ndarray, polarity: np.ndarray) -> np.ndarray:
    """Returns the direction in which an arc runs at a point, with its inside on the right hand of a picture, `(A, 2)`."""
    near = np.clip(place[:, None] + np.array([-1, 0, 1]), 0, len(edges.directions) - 1)
    inward = edges.directions[near].sum(1) * polarity[:, None]
    return np.column_stack([inward[:, 1], -inward[:, 0]])


def _turn(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the signed angle from one direction to another, rad."""
    return np.arctan2(
        first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0], (first * second).sum(-1)
    )
