"""Light that bounces within a hole: radiosity of the rings of its wall and of its floor.

Matt surfaces that light evenly around the axis: each ring of the wall has one brightness. View
factors between rings follow from that of two equal parallel discs (Howell's catalogue, C-41), since
light that leaves through one disc and not through the next fell on the ring between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

RINGS, AROUND = 16, 64
"""Rings of a wall, and places around each at which sunlight is looked for; twice as many change
the brightness by less than 1 %."""


@dataclass(frozen=True)
class HoleLight:
    """Bounced light in a hole.

    Attributes:
        depth_m: Depths of the middles of the rings, `(RINGS,)`.
        light: Light on each ring, and last on the floor, for each unit of the ambient light in the
            mouth, and of the sun, `(RINGS + 1, 2)`.
    """

    depth_m: np.ndarray
    light: np.ndarray

    def at(self, depth_m: np.ndarray, floor: np.ndarray) -> np.ndarray:
        """Return the light at depths, `(M,)`, of the wall or, where `floor`, on it, `(M, 2)`."""
        parts = [np.interp(depth_m, self.depth_m, one) for one in self.light[:-1].T]
        found = np.where(floor[:, None], self.light[-1], np.stack(parts, 1))
        return found.astype(np.float32)


def compute_view_factors(radius_m: float, depth_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return view factors between rings and floor, `(RINGS + 1, RINGS + 1)`, and to the mouth.

    `factors[i, j]` is the part of the light from `i` that falls on `j`.
    """
    edge = np.linspace(0.0, depth_m, RINGS + 1)

    def between_discs(apart_m: np.ndarray) -> np.ndarray:
        twice = 2.0 + (apart_m / radius_m) ** 2
        return 0.5 * (twice - np.sqrt(np.maximum(twice**2 - 4.0, 0.0)))

    # Light from the cut at `edge[k]` that reaches the cut at `edge[n]`.
    cut = between_discs(np.abs(edge[:, None] - edge))
    # Area of a cut over that of a ring.
    ratio = radius_m / (2.0 * depth_m / RINGS)
    # From a ring to a cut, on either side: by reciprocity from the cut to the ring.
    to_cut = ratio * np.abs(cut[:-1] - cut[1:])
    factors = np.zeros((RINGS + 1, RINGS + 1))
    factors[:-1, :-1] = np.abs(to_cut[:, :-1] - to_cut[:, 1:])
    own = np.arange(RINGS)
    factors[own, own] = 1.0 - to_cut[own, own] - to_cut[own, own + 1]
    factors[:-1, -1] = to_cut[:, -1]
    factors[-1, :-1] = to_cut[:, -1] / ratio
    mouth = np.append(to_cut[:, 0], cut[-1, 0])
    return factors, mouth


@lru_cache(maxsize=32)
def compute_bounced_light(
    radius_m: float, depth_m: float, wall: float, floor: float, rise: float
) -> HoleLight:
    """Return the bounced light in a hole.

    Args:
        radius_m: Radius.
        depth_m: Depth.
        wall: Reflected part of the light, of its wall.
        floor: Likewise of its floor.
        rise: Cosine of the angle between the hole's outward axis and the direction to the sun.
    """
    factors, mouth = compute_view_factors(radius_m, depth_m)
    edge = np.linspace(0.0, depth_m, RINGS + 1)
    middle = (edge[:-1] + edge[1:]) / 2
    first = np.column_stack([mouth, measure_sunlight(radius_m, depth_m, middle, rise)])
    part = np.append(np.full(RINGS, wall), floor)
    # All light on a place is that which arrives first and that which the others send on.
    whole = np.linalg.solve(np.eye(RINGS + 1) - factors * part, first)
    return HoleLight(middle, whole - first)


def measure_sunlight(
    radius_m: float, depth_m: float, rings_m: np.ndarray, rise: float
) -> np.ndarray:
    """Return the mean sunlight on rings at depths, and on the floor, for a unit of sun."""
    if rise <= 0:
        return np.zeros(len(rings_m) + 1)
    slide = float(np.sqrt(max(1.0 - rise**2, 0.0)))
    angle = (np.arange(AROUND) + 0.5) * (2 * np.pi / AROUND)
    # The way back along the ray, to where it passes the mouth; the sun stands towards +x.
    x = radius_m * np.cos(angle) + (rings_m * slide / rise)[:, None]
    inside = x**2 + (radius_m * np.sin(angle)) ** 2 < radius_m**2
    on_wall = (inside * np.maximum(-slide * np.cos(angle), 0.0)).mean(1)
    # The mouth's image on the floor overlaps it by the lens of two circles.
    apart = min(depth_m * slide / rise / (2 * radius_m), 1.0)
    lens = 2.0 / np.pi * (np.arccos(apart) - apart * np.sqrt(1.0 - apart**2))
    return np.append(on_wall, rise * lens)
