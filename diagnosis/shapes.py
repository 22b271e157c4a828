"""What effects do to each joint, in the field and on the reference.

Axes: `J` joints, `E` entries (increments of all windows, over the simulator's noise).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diagnosis.evidence import GRID, Evidence, Ray, rays
from diagnosis.library import Kind, shared
from diagnosis.noise import loss
from diagnosis.sizes import Plain, Shape, fitted, plain, predicted

SHAPES = (0.35, 0.5, 0.7, 1.4, 2.0)
"""Values of a number that only shapes an effect that are tried beside the typical one, over it."""
FINE = tuple(np.geomspace(GRID[0], GRID[-1], 20).round(3).tolist())
"""Sizes at which an effect is simulated that rings: between those of `GRID` it would be out of
step, and only a dull one fits."""
SMALL = GRID[:4]
"""Sizes at which effects are simulated on the reference: small ones of the field's, as many effects
begin at a threshold."""
FELT = 1e-3
"""An effect that changes errors over the noise by less does nothing to a joint."""


def rays_of(kind: Kind, grid: Sequence[float] = GRID) -> list[Ray]:
    """Returns the ways in which an effect can grow, at sizes as close as it has to be simulated; none beyond those of `grid`."""
    fine = [size for size in FINE if size <= grid[-1]]
    return rays(kind, fine if kind.shaping and not shared([kind]) else grid)


def add(
    shapes: Sequence[dict[str, list[Shape]]], name: str, ways: Sequence[Ray], evidence: Evidence
) -> list[Ray]:
    """Adds the shapes of an effect to the joints that it does something to.

    Numbers that only shape the effect are tried at several values; each joint keeps the best, and
    the rays remember them.
    """
    kind = ways[0].kind
    trials: list[dict[str, float]] = [{}]
    if not ways[0].shape:
        trials += [{number: part} for number in kind.shaping for part in SHAPES]
    shaped = [
        [replace(ray, shape=_all(trial, len(shapes))) if trial else ray for ray in ways]
        for trial in trials
    ]
    responses = [[evidence.response(ray) for ray in one] for one in shaped]
    best = np.zeros(len(shapes), dtype=int)
    for j, mine in enumerate(shapes):
        if max(np.abs(response[j]).max() for response in responses[0]) < FELT:
            continue
        made = [
            [Shape(ray.sizes, r[j]) for ray, r in zip(ways, response, strict=True)]
            for response in responses
        ]
        if len(made) > 1:
            best[j] = int(
                np.argmin(
                    [
                        loss(evidence.z[j] - predicted(one, fitted(evidence.z[j], one)))
                        for one in made
                    ]
                )
            )
        mine[name] = made[best[j]]
    if len(trials) == 1:
        return list(ways)
    shape = {
        number: np.array([trials[b].get(number, 1.0) for b in best]) for number in kind.shaping
    }
    return [replace(ray, shape=shape) for ray in ways]


def plain_joints(
    evidence: Evidence, scatter: np.ndarray | None = None, z: np.ndarray | None = None
) -> list[Plain]:
    """Returns the errors of each joint with small faults of the simulator, in units of `scatter` times the noise.

    Args:
        evidence: Errors over the noise.
        scatter: Mean square error over what the noise says, `(J,)`.
        z: Errors to explain in place of those of the evidence, `(J, E)`.
    """
    by = np.ones(len(evidence.z)) if scatter is None else 1.0 / np.sqrt(scatter)
    z = evidence.z if z is None else z
    return [
        plain(one * part, lines * part)
        for one, lines, part in zip(z, evidence.faults, by, strict=True)
    ]


def _all(trial: Mapping[str, float], joints: int) -> dict[str, np.ndarray]:
    return {name: np.full(joints, part) for name, part in trial.items()}
