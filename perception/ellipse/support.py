"""What supports an ellipse: edge points along it, and what speaks against it. Axes: `C` candidates, `P` places around each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.ellipse import conic
from perception.ellipse.edges import Edges

NUM_SAMPLES = 96
"""Places around an ellipse at which its support is looked for."""
WINDOW = NUM_SAMPLES // 8
"""Neighbouring places over which noise is averaged away."""
ANGLES = np.arange(NUM_SAMPLES) * (2 * np.pi / NUM_SAMPLES)


@dataclass(frozen=True)
class Candidates:
    """Ellipses that are judged, `C` of them.

    Attributes:
        ellipses: `(C, 5)`.
        polarity: +1 where it is brighter outside, -1 where it is brighter inside, `(C,)`.
    """

    ellipses: np.ndarray
    polarity: np.ndarray

    def __getitem__(self, keep: np.ndarray | slice) -> Candidates:
        return Candidates(self.ellipses[keep], self.polarity[keep])


def gather(
    candidates: Candidates,
    edges: Edges,
    angles_rad: np.ndarray,
    reach_px: np.ndarray,
    angle_rad: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the edge points that support each candidate at each eccentric angle, `(C, P)` each.

    A supporting point lies within reach, and its gradient along the normal, with the candidate's
    polarity. Returns the number of the point, -1 where there is none, its distance along the
    normal, and the cosine between gradient and normal.
    """
    points, outward, _ = conic.sample(candidates.ellipses, angles_rad)
    found = edges.at(points)
    apart = edges.points[found] - points
    off = conic.dot(apart, outward)
    along = conic.dot(edges.directions[found], outward) * candidates.polarity[:, None]
    side = np.abs(apart[..., 0] * outward[..., 1] - apart[..., 1] * outward[..., 0])
    good = (np.abs(off) < reach_px[:, None]) & (side < 2.0)
    good &= along > np.cos(angle_rad)
    return np.where(good, found, -1), off, along


def strength(edges: Edges, support: np.ndarray) -> np.ndarray:
    """Returns the mean gradient of the edges that support each candidate, grey levels a pixel, `(C,)`."""
    there = support >= 0
    return (edges.strength[support] * there).sum(1) / np.maximum(there.sum(1), 1)


def purity(edges: Edges, support: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Returns how much of the runs that support each candidate lies on it, in the mean over the support, `(C,)`.

    The edge of an ellipse that something hides ends there with a corner; that of a spiral or a
    heart goes on smoothly elsewhere.
    """
    there = support >= 0
    run = np.where(there, edges.run[support], -1)
    known = run >= 0
    ds = length * (2 * np.pi / support.shape[1])
    key = np.arange(len(support))[:, None] * (len(edges.run_length) + 1) + run + 1
    _, number, inverse = np.unique(key[known], return_index=True, return_inverse=True)
    whole = edges.run_length[run[known]][number]
    share = np.bincount(inverse, ds[known], minlength=len(number)) / whole
    each = np.ones(support.shape)
    each[known] = np.minimum(share, 1.3)[inverse]  # of short runs a sample more or less
    return np.minimum((each * ds * there).sum(1) / np.maximum((ds * there).sum(1), 1e-9), 1.0)


def departure(
    candidates: Candidates,
    edges: Edges,
    support: np.ndarray,
    length: np.ndarray,
    reach_px: np.ndarray,
) -> np.ndarray:
    """Returns the part of the circumference without support where an edge that supports the rest runs on beside the ellipse.

    Up to a corner: what hides a part of it has an edge that is connected to its own there.
    """
    e = candidates.ellipses
    if not len(e):
        return np.empty(0)
    points, outward, _ = conic.sample(e, ANGLES)
    number = len(edges.run_length) + 1
    rows = np.repeat(np.arange(len(e)), NUM_SAMPLES).reshape(support.shape)
    mine = np.unique(
        (rows * number + edges.run[support])[(support >= 0) & (edges.run[support] >= 0)]
    )
    reach, wide = reach_px[:, None], np.clip(0.3 * np.sqrt(e[:, 2] * e[:, 3]), 3.0, 12.0)[:, None]
    beside = np.zeros(support.shape, bool)
    for part in (-1.0, -0.6, -0.3, 0.0, 0.3, 0.6, 1.0):
        found = edges.at(points + (part * wide)[..., None] * outward)
        off = np.abs(conic.dot(edges.points[found] - points, outward))
        along = conic.dot(edges.directions[found], outward) * candidates.polarity[:, None]
        hit = (
            (found >= 0)
            & (edges.run[found] >= 0)
            & (along > 0.85)
            & (off > reach)
            & (off <= wide)
            & (support < 0)
            & ~beside
        )
        beside[hit] = np.isin((rows * number + edges.run[found])[hit], mine)
    return (length * beside).sum(1) / length.sum(1)


def waves(
    candidates: Candidates, edges: Edges, support: np.ndarray, off: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far distance and angle of the support stray from 0 in the mean over an eighth of a turn, px and rad, `(C,)` each.

    Noise is gone from such a mean; what stays is that another curve than an ellipse was fitted by
    one.
    """
    there = support >= 0
    outward = conic.sample(candidates.ellipses, ANGLES)[1]
    bright = edges.directions[support] * candidates.polarity[:, None, None]
    turn = np.arctan2(
        outward[..., 0] * bright[..., 1] - outward[..., 1] * bright[..., 0],
        conic.dot(outward, bright),
    )
    known = _around(there)
    enough = known >= 0.6 * WINDOW
    return tuple(
        np.sqrt(
            ((_around(value * there) / np.maximum(known, 1)) ** 2 * enough).sum(1)
            / np.maximum(enough.sum(1), 1)
        )
        for value in (off, turn)
    )


def _around(values: np.ndarray) -> np.ndarray:
    """Returns the sum of `WINDOW` neighbours around an ellipse at each place, `(C, P)`."""
    half = WINDOW // 2
    total = np.cumsum(
        np.concatenate([values[:, -half:], values, values[:, :half]], axis=1, dtype=float), axis=1
    )
    return total[:, WINDOW:] - total[:, :-WINDOW]


def gap(there: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Returns the longest stretch without support as a part of the circumference, `(C,)`."""
    twice = np.concatenate([there, there], 1)  # around twice: a stretch may run over the end
    way = np.cumsum(np.concatenate([length, length], 1), 1)
    seen = np.maximum.accumulate(np.where(twice, way, 0.0), 1)
    return np.minimum((way - seen).max(1, initial=0.0) / length.sum(1), 1.0)


def typical(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Returns the standard deviation of each row's values `(C, P)` that the nearest 70 % tell, whatever the others are."""
    ordered = np.sort(np.where(there, values, np.inf), 1)
    place = np.maximum((0.7 * there.sum(1)).astype(int) - 1, 0)
    return ordered[np.arange(len(values)), place] / 1.036


def evidence(
    coverage: np.ndarray, angle_rms_rad: np.ndarray, perimeter_px: np.ndarray, angle_rad: float
) -> np.ndarray:
    """Returns the decimal exponent of the chance that so many gradients point so well along the normal by accident (Chernoff)."""
    chance = np.clip(2.0 * angle_rms_rad, 0.1, angle_rad) / np.pi
    with np.errstate(divide="ignore", invalid="ignore"):
        absent = np.where(
            coverage < 1, (1 - coverage) * np.log10((1 - coverage) / (1 - chance)), 0.0
        )
        return np.where(
            coverage > chance,
            (coverage * np.log10(coverage / chance) + absent) * perimeter_px / 2,
            0.0,
        )
