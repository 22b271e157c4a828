"""One cause for all joints has one size: clocks that are apart by so much, oil that is so much too thin.

An effect that all joints share is first sized joint by joint. Where it is chosen, its size is the
same for all from then on,
nearly: what a joint needs beyond that is another effect, and shows as one.
Axes: `J` joints, `S` sizes of a ray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diagnosis.evidence import Ray
from diagnosis.search import Subset, Table
from diagnosis.sizes import Shape

PLAY = 0.3
"""Sizes may differ by so much of what they have in common: an effect's form is not quite the same
on all joints."""

Rays = Mapping[str, Sequence[Ray]]
Shapes = Sequence[Mapping[str, Sequence[Shape]]]


def tied(
    names: Subset, tables: Sequence[Table], grown: Rays, shapes: Shapes
) -> tuple[dict[str, list[Ray]], list[dict[str, list[Shape]]]]:
    """Returns rays and shapes with those of the effects `names` bounded to about the size that the joints agree on."""
    rays, narrow = (
        {name: list(ways) for name, ways in grown.items()},
        [{n: list(s) for n, s in mine.items()} for mine in shapes],
    )
    for name in names:
        scored = [table.score(frozenset({name})) for table in tables if name in table.shapes]
        for place, ray in enumerate(rays[name]):
            size = np.array([one.sizes[name][place] for one in scored])
            told = np.array([max(one.total, 0.0) for one in scored]) / np.maximum(
                np.square(size), 1e-6
            )
            common = median(size, told)
            if common == 0.0:
                continue
            ends = np.sort(common * np.array([1.0 - PLAY, 1.0, 1.0 + PLAY]))
            rays[name][place] = replace(ray, sizes=ends, is_tied=True)
            for mine in narrow:
                if name in mine:
                    shape = mine[name][place]
                    mine[name][place] = Shape(
                        ends, np.stack([shape.at(float(size))[0] for size in ends])
                    )
    return rays, narrow


def median(values: np.ndarray, weights: np.ndarray) -> float:
    """Returns the weighted median: a joint that has another effect too is far off."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])]) if below[-1] > 0 else 0.0
