"""What effects do to each joint, in the field and on the reference.

Axes: `J` joints, `E` entries (increments of all windows, over the simulator's noise).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from diagnosis.evidence import GRID, Evidence, Ray, rays
from diagnosis.library import Kind, shared
from diagnosis.noise import loss
from diagnosis.search import Scored, Table
from diagnosis.simulator import Base
from diagnosis.sizes import Plain, Shape, fitted, plain, predicted

SHAPES = (0.35, 0.5, 0.7, 1.4, 2.0)
"""Values of a number that only shapes an effect that are tried beside the typical one, over it."""
FINE = tuple(np.geomspace(GRID[0], GRID[-1], 20).round(3).tolist())
"""Sizes at which an effect is simulated that rings: between those of `GRID` it would be out of
step, and only a dull one fits."""
SMALL = GRID[:4]
"""Sizes at which effects are simulated on the reference: small ones of the field's, as many effects
begin at a threshold."""
THERE = 3.0
"""Log of a Bayes factor, all parts of the reference together, from which an effect is taken to be
there already."""
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


@dataclass
class Nulls:
    """What sets of effects earn on reference recordings; an effect is simulated there when it is first asked for.

    Attributes:
        base: The simulator, and parts of the reference that it was not fitted to.
        rays: Ways in which each effect grows, at small sizes.
        grown: The same as they are simulated in the field.
        plain: Errors of each joint in the field.
        shapes: What each effect does to each joint in the field.
        shared: Effects with one cause for all joints.
        tables: Of each part and joint.
        known: Effects that were simulated on the reference.
    """

    base: Base
    rays: Mapping[str, Sequence[Ray]]
    grown: Mapping[str, Sequence[Ray]]
    plain: Sequence[Plain]
    shapes: Sequence[Mapping[str, Sequence[Shape]]]
    shared: frozenset[str]
    tables: list[list[Table]] = field(default_factory=list)
    known: set[str] = field(default_factory=set)

    def _scored(self, j: int, subset: frozenset[str]) -> list[tuple[Scored, float]]:
        """Returns what the subset earns on joint `j` in each part of the reference, and the length of the field over the part's."""
        if not self.tables:
            parts = [one.evidence for one in self.base.nulls]
            self.tables = [
                [Table(joint, {}, part.block) for joint in plain_joints(part)] for part in parts
            ]
        for name in subset - self.known:
            ways = [
                replace(ray, shape=self.grown[name][0].shape) for ray in self.rays[name]
            ]  # shaped as they are in the field
            for tables, one in zip(self.tables, self.base.nulls, strict=True):
                add([table.shapes for table in tables], name, ways, one.evidence)
            self.known.add(name)
        found, entries = [], self.base.field.evidence.z.shape[1]
        for mine in (tables[j] for tables in self.tables):
            usable = frozenset(name for name in subset if name in mine.shapes)
            found.append((mine.score(usable), entries / len(mine.joint.z)))
        return found

    def earned(self, j: int, subset: frozenset[str]) -> float:
        """Returns the most that the subset earns on joint `j` in any part of the reference, at the length of the field.

        Of a cause that all joints share the mean: its price adds up over the joints, and the most
        of each adds up to too much.
        """
        found = [max(0.0, scored.total * part) for scored, part in self._scored(j, subset)]
        return float((np.mean if subset <= self.shared else max)(found)) if found else 0.0

    def repeated(self, j: int, subset: frozenset[str]) -> float:
        """Returns what the subset earns in the field at the sizes that it has on the reference already; 0 where it has none."""
        parts = [scored for scored, _ in self._scored(j, subset)]
        if not parts or sum(scored.total for scored in parts) < THERE:
            return 0.0
        joint, change = self.plain[j], np.zeros(len(self.plain[j].z))
        for name in subset & self.shapes[j].keys():
            if sizes := [scored.sizes[name] for scored in parts if name in scored.sizes]:
                change = change + predicted(self.shapes[j][name], np.mean(sizes, 0))
        left = plain(joint.z - change, joint.faults)
        return max(0.0, float(joint.loss.sum() - left.loss.sum()) + joint.price - left.price)
