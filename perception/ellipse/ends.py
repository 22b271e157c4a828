"""Where the arc of an ellipse ends: something hides the rest, or its edge goes on elsewhere. Axes: `C` candidates, `M` ends."""

from __future__ import annotations

import numpy as np

from perception.ellipse import conic
from perception.ellipse.edges import Edges
from perception.ellipse.support import NUM_SAMPLES, Candidates, strength

OPEN = 0.12
"""Part of the circumference without support at whose ends one asks how the edge goes on."""
BACK_PX, STRIDE_PX = 4.0, 2.0
"""How far before that end one begins to look, and how far apart the places are at which one
does."""
NEAR_PX, LEAST_PX = 1.5, 0.5
"""Of that stride; where an edge ends, nothing nearer lies ahead than its last point."""
ALIKE = 1.5
"""Times as strong or as weak as an edge may be where it is followed to: what hides something has
edges of its own."""
KINK_PX, KINK_RAD = 4.5, 0.4
"""Length of an edge over which it turns at a corner, and by how much more than the ellipse does."""
CHORD, CHORD_PX, CHORD_COSINE, CHORD_PART, BOW_PX, STROKE_PX = (
    np.linspace(0.15, 0.85, 8),
    2.0,
    0.85,
    0.7,
    0.6,
    4.5,
)
"""Places between the ends of an arc; where an edge of what hides the rest must be, by so many of
them; how much it may bend, and
how deep within the ellipse it must get: the other edge of a line that is bent follows the arc."""
SAME = 1.25
"""The same of what is the edge of one thing."""
CLOSED_PX, DIP_PX, BACK, AHEAD = 3.0, 1.0, 10, 60
"""Distance of the ends of an outline that is closed; how far into an ellipse one turns; points
before and beyond an arc's end."""


def leaving(
    candidates: Candidates, edges: Edges, support: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """Says which candidates have support that goes on smoothly elsewhere, `(C,)`: lobes of hearts, round corners, spirals.

    Where something stands before an ellipse, its edge ends in a corner; where nothing does, in
    nothing. What is as wide as it is may go on without a corner, but has an edge from one end of
    the arc to the other.
    """
    result = np.zeros(len(support), bool)
    ds = length * (2 * np.pi / support.shape[1])
    for side in (1, -1):  # around one way, then the other
        row, end, other = _open(support, length, side)
        hidden = _across(candidates.ellipses[row], edges, support[row, end], support[row, other])
        back = (end - side * np.ceil(BACK_PX / ds[row, end]).astype(int)) % NUM_SAMPLES
        start = np.where(support[row, back] >= 0, back, end)
        e = candidates.ellipses[row]
        outward = conic.beside(e, edges.points[support[row, start]][:, None])[1][:, 0]
        onward = side * np.column_stack([-outward[:, 1], outward[:, 0]])
        size = np.sqrt(e[:, 2] * e[:, 3])
        reach = np.clip(0.35 * size, 6.0, 16.0) + BACK_PX
        bend = size**2 / length[row, end] ** 3
        goes_on = _followed(edges, support[row, start], onward, reach, bend)
        result[row[goes_on & ~hidden]] = True
    return result


def crossed(
    candidates: Candidates, edges: Edges, support: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """Says into which candidates the outline that supports them turns where it leaves them, and out again, `(C,)`: hearts.

    Where something hides the rest of an ellipse, its edge runs within it from one end of the arc to
    the other, and what runs on
    outside has another contrast: only the edge of one thing is as strong, with the same side dark,
    in both.
    """
    result, whole = np.zeros(len(support), bool), strength(edges, support)
    for side in (1, -1):  # around one way, then the other
        row, end, _ = _open(support, length, side)
        e, last = candidates.ellipses[row], support[row, end]
        outward = conic.beside(e, edges.points[last][:, None])[1][:, 0]
        number, known = _outline(
            edges, last, side * np.column_stack([-outward[:, 1], outward[:, 0]])
        )
        off = conic.beside(e, edges.points[number])[0]
        usual = np.median(edges.strength[number[:, : BACK // 2]], axis=1)
        known &= (usual > whole[row] / ALIKE)[:, None]
        alike = np.abs(np.log(edges.strength[number] / usual[:, None])) < np.log(SAME)
        way = np.gradient(edges.points[number], axis=1)
        bright = edges.directions[number]
        hand = way[..., 0] * bright[..., 1] - way[..., 1] * bright[..., 0]
        known &= alike & (hand * hand[:, :1] > 0)
        within = np.maximum.accumulate(known & (off < -DIP_PX), axis=1)
        result[row[(within & known & (off > CHORD_PX)).any(1)]] = True
    return result


def _outline(edges: Edges, last: np.ndarray, onward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns numbers of points along the outlines through some edge points `last` `(M,)`, which run on as `onward` `(M, 2)` says.

    With them whether each is there, as an outline may end, `(M, AHEAD)` both.
    """
    span = edges.spans[np.searchsorted(edges.spans[:, 0], last, side="right") - 1]
    number = (span[:, 1] - span[:, 0])[:, None]
    closed = (
        np.linalg.norm(edges.points[span[:, 0]] - edges.points[span[:, 1] - 1], axis=1) < CLOSED_PX
    )
    back = span[:, 0] + (last - span[:, 0] - BACK) % number[:, 0]
    forward = np.where(((edges.points[last] - edges.points[back]) * onward).sum(1) > 0, 1, -1)
    place = (last - span[:, 0])[:, None] + forward[:, None] * np.arange(-BACK, AHEAD)[None]
    known = closed[:, None] | ((place >= 0) & (place < number))
    known &= np.abs(np.arange(-BACK, AHEAD)) < number
    return span[:, :1] + place % number, known


def screened(
    candidates: Candidates, edges: Edges, support: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """Says which candidates have a straight edge from one end of their support to the other, of what hides the rest, `(C,)`."""
    row, end, other = _open(support, length, 1)
    result = np.zeros(len(support), bool)
    hidden = _across(candidates.ellipses[row], edges, support[row, end], support[row, other])
    result[row[hidden]] = True
    return result


def _open(
    support: np.ndarray, length: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns each wide stretch without support: its candidate, the last place with support before it, and the first one after it.

    All are `(M,)`; before and after as one goes around by increasing angle for `side` 1, by
    decreasing for -1.
    """
    there = support >= 0
    row, end = np.nonzero(there & ~np.roll(there, -side, 1))
    ahead = (end[:, None] + side * np.arange(1, NUM_SAMPLES)) % NUM_SAMPLES
    free = np.cumprod(~there[row[:, None], ahead], axis=1)
    wide = (free * length[row[:, None], ahead]).sum(1) > OPEN * length.sum(1)[row]
    return row[wide], end[wide], (end + side * (1 + free.sum(1)))[wide] % NUM_SAMPLES


def _across(ellipses: np.ndarray, edges: Edges, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Says across which ellipses `(M, 5)` an edge runs straight between two edge points, numbers `(M,)` each, `(M,)`.

    It must be fainter than the ellipse's: what hides the rest looks like it where its outline can
    be taken for the ellipse's. As strong, it is the other side of something thin and bent.
    """
    usual = np.minimum(edges.strength[one], edges.strength[other])
    one, other = edges.points[one], edges.points[other]
    chord = other - one
    chord = chord / np.maximum(np.linalg.norm(chord, axis=1), 1e-9)[:, None]
    normal = np.column_stack([-chord[:, 1], chord[:, 0]])[:, None]
    places = one[:, None] + CHORD[:, None] * (other - one)[:, None]
    number = edges.at(places)
    off = conic.dot(edges.points[number] - places, normal)
    near = (number >= 0) & (np.abs(off) < CHORD_PX)
    near &= np.abs(conic.dot(edges.directions[number], normal)) > CHORD_COSINE
    deep = -conic.beside(ellipses, edges.points[number])[0]
    near &= deep > CHORD_PX  # else it may be the ellipse's own
    middle, ends = (
        (off * near)[:, part].sum(1) / np.maximum(near[:, part].sum(1), 1)
        for part in (np.s_[2:-2], np.array([0, 1, -2, -1]))
    )
    near &= edges.strength[number] < usual[:, None] / ALIKE
    return (
        (near.mean(1) >= CHORD_PART)
        & (np.abs(middle - ends) < BOW_PX)
        & (deep.max(1, initial=0.0, where=near) > STROKE_PX)
    )


def _followed(
    edges: Edges, start: np.ndarray, onward: np.ndarray, reach_px: np.ndarray, bend: np.ndarray
) -> np.ndarray:
    """Says which edges can be followed so far without a corner, as strong as they were, `(M,)`.

    Args:
        edges: Edges.
        start: Number of the edge point where each begins, `(M,)`.
        onward: Direction in which it runs, `(M, 2)`.
        reach_px: How far, `(M,)`.
        bend: How much the ellipse bends there, 1/px, `(M,)`; what turns more by `KINK_RAD` over
            `KINK_PX` is a corner.
    """
    place, along = edges.points[start], onward
    first = edges.directions[start]
    hand = np.sign(
        along[:, 0] * first[:, 1] - along[:, 1] * first[:, 0]
    )  # on which side it is bright
    seen, alive = [first], np.ones(len(start), bool)
    strength = np.zeros(len(start))
    for step in range(int(np.ceil(reach_px.max(initial=0.0) / STRIDE_PX))):
        onto = place + STRIDE_PX * along
        number = edges.at(onto)
        came, place, bright = (
            ((edges.points[number] - place) * along).sum(1),
            edges.points[number],
            edges.directions[number],
        )
        along = np.column_stack([bright[:, 1], -bright[:, 0]]) * hand[:, None]
        needed = step * STRIDE_PX < reach_px
        near = (np.linalg.norm(place - onto, axis=1) < NEAR_PX) & (came > LEAST_PX)
        earlier = seen[max(0, len(seen) - round(KINK_PX / STRIDE_PX))]
        turn = np.arccos(np.clip(conic.dot(bright, earlier), -1.0, 1.0))
        alive &= ~needed | (near & (turn < KINK_PX * bend + KINK_RAD))
        strength = np.where(needed, edges.strength[number], strength)
        seen.append(bright)
    alike = np.abs(np.log(np.maximum(strength, 1e-6) / edges.strength[start])) < np.log(ALIKE)
    return alive & alike
