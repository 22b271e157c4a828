"""The diagnosis: from a simulator held against recordings to an answer.

Axes: `J` joints, `E` entries (increments of all windows, over the simulator's noise), `W` windows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from brokk_rl.diagnosis import remainder
from brokk_rl.diagnosis.evidence import Evidence, Ray, rays
from brokk_rl.diagnosis.library import Kind
from brokk_rl.diagnosis.repair import Repair, repair
from brokk_rl.diagnosis.search import Chosen, Table, choose
from brokk_rl.diagnosis.simulator import Base
from brokk_rl.diagnosis.sizes import Shape
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

SMALL = (0.12, 0.5)
"""Sizes at which effects are simulated on the reference: what they find there is small."""
Tell = Callable[[str, float], None]
"""Is told what is being done and how much of the whole is done."""


@spec
class Prices:
    """What an effect must earn, in units of log likelihood on recordings that it was not fitted to.

    Attributes:
        joint: For each joint that has it, beside what it earns on reference recordings.
        name: For the effect as such.
        share: Of what its joint's set earns: an effect that adds less only mends the form of another.
        temperature: Of the probabilities: a worth of so much makes odds of e to 1.
        remainder: Worth from which a flexible model shows that something is there.
        explained: Share of what can be predicted that a set must explain for the verdict `effects`.
    """

    joint: float
    name: float
    share: float
    temperature: float
    remainder: float
    explained: float


@dataclass
class Findings:
    """What the search found.

    Attributes:
        tables: Of each joint.
        rays: Of each effect.
        chosen: The set.
        repair: Its simulation; `None` for the empty set.
        left: What a flexible model earns on what is left, by joint, `(J,)`.
        left_null: The same on reference recordings, the most of any part, at the length of the field, `(J,)`.
    """

    tables: list[Table]
    rays: dict[str, list[Ray]]
    chosen: Chosen
    repair: Repair | None = None
    left: np.ndarray = field(default_factory=lambda: np.zeros(0))
    left_null: np.ndarray = field(default_factory=lambda: np.zeros(0))
    price: Callable[[int, frozenset[str]], float] = lambda j, s: 0.0


def search(base: Base, kinds: Sequence[Kind], prices: Prices, tell: Tell) -> Findings:
    """Returns the set of effects that is worth most, and its rivals."""
    evidence = base.field.evidence
    grown = {kind.name: rays(kind) for kind in kinds if not kind.target.stochastic and kind.target.side != "kinematics"}
    shapes: list[dict[str, list[Shape]]] = [{} for _ in range(evidence.way.shape[2])]
    for number, (name, ways) in enumerate(grown.items()):
        tell(f"simulating {name}", 0.3 + 0.25 * number / len(grown))
        _put(shapes, name, ways, evidence)
    tables = [Table(z, mine, evidence.fold) for z, mine in zip(evidence.z, shapes, strict=True)]
    nulls = _Nulls(base, {kind.name: rays(kind, SMALL) for kind in kinds if kind.name in grown})
    price = dict.fromkeys(grown, prices.joint)
    for j, table in enumerate(tables):
        tell(f"trying sets on joint {j + 1}", 0.55 + 0.15 * j / len(tables))
        table.explore(price, 3)

    def subset_price(j: int, subset: frozenset[str]) -> float:
        return prices.joint * len(subset) + nulls.earned(j, subset)

    tell("the same on the reference", 0.7)
    chosen = choose(tables, subset_price, prices.name, prices.share)
    findings = Findings(tables, grown, chosen, price=subset_price)
    if chosen.names:
        tell("simulating what was found", 0.85)
        start = [table.score(subset).sizes for table, subset in zip(tables, chosen.subsets, strict=True)]
        findings.repair = repair(evidence, chosen.subsets, grown, start)
    tell("what is left", 0.92)
    z = findings.repair.z if findings.repair else evidence.z
    findings.left = remainder.predictable(evidence, z).sum(1)
    entries = evidence.z.shape[1]
    of_nulls = [
        remainder.predictable(one.evidence, one.evidence.z).sum(1) * entries / one.evidence.z.shape[1] for one in base.nulls
    ]
    findings.left_null = np.max([np.zeros(len(z)), *of_nulls], 0)
    return findings


def _put(shapes: Sequence[dict[str, list[Shape]]], name: str, ways: Sequence[Ray], evidence: Evidence) -> None:
    """Adds the shapes of an effect to the joints that it does something to."""
    responses = [evidence.response(ray) for ray in ways]
    for j, mine in enumerate(shapes):
        if max(np.abs(response[j]).max() for response in responses) > 1e-3:
            mine[name] = [Shape(ray.sizes, response[j]) for ray, response in zip(ways, responses, strict=True)]


@dataclass
class _Nulls:
    """What sets of effects earn on reference recordings; an effect is simulated there when it is first asked for."""

    base: Base
    rays: Mapping[str, Sequence[Ray]]
    tables: list[list[Table]] = field(default_factory=list)
    known: set[str] = field(default_factory=set)

    def earned(self, j: int, subset: frozenset[str]) -> float:
        """Returns the most that the subset earns on joint `j` in any part of the reference, at the length of the field."""
        if not self.tables:
            parts = [one.evidence for one in self.base.nulls]
            self.tables = [[Table(z, {}, part.fold) for z in part.z] for part in parts]
        for name in subset - self.known:
            for tables, one in zip(self.tables, self.base.nulls, strict=True):
                _put([table.shapes for table in tables], name, self.rays[name], one.evidence)
            self.known.add(name)
        found, entries = 0.0, self.base.field.evidence.z.shape[1]
        for tables in self.tables:
            mine = tables[j]
            usable = frozenset(name for name in subset if name in mine.shapes)
            found = max(found, mine.score(usable).total * entries / len(mine.z))
        return found
