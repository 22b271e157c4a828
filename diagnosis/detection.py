"""The diagnosis: from a simulator held against recordings to an answer.

Axes: `J` joints, `E` entries (increments of all windows, over the simulator's noise), `W` windows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from brokk_rl.spec import spec
from diagnosis import (
    effect_library,
    geometry,
    nonadditive_refit,
    refine,
    residual_model,
    sensors,
    timing,
)
from diagnosis.baseline import Base
from diagnosis.case import Case
from diagnosis.effect_library import Found, Kind
from diagnosis.refine import Repair, repair
from diagnosis.residuals import Evidence, Ray
from diagnosis.responses import SMALL, Shape, add, plain_joints, rays_of
from diagnosis.search import MOST, Chosen, Nulls, Price, Table, bind_shared_sizes, choose

log = logging.getLogger(__name__)

SCATTERED = 1.3
"""Mean square error over that of the reference from which what effects earn is taken down."""
CUT = 25.0
"""Squares of errors over the noise count no more than this in what scatters."""
FEW = 2
"""Parts of the reference that tell how delays scatter."""
TURNS = 2
"""Times that effects are simulated around what was found, where adding up is far off."""
Tell = Callable[[str, float], None]
"""Is told what is being done and how much of the whole is done."""


@spec
class Prices:
    """What an effect must earn, in units of log likelihood on recordings that it was not fitted to.

    Attributes:
        joint: For each joint that has it, unless one cause is behind it on all joints.
        reference: Times what it earns on reference recordings.
        name: For the effect as such.
        partial: For each joint that lacks an effect with one cause for all joints.
        share: Of what its joint's set earns: an effect that adds less only mends the form of
            another.
        tool: Error of measured tool points over that of the reference from which something unknown
            is there.
    """

    joint: float
    reference: float
    name: float
    partial: float
    share: float
    tool: float


@dataclass
class Findings:
    """What the search found.

    Attributes:
        evidence: The simulator against the field, with what was found by other means.
        tables: Of each joint.
        rays: Of each effect.
        price: What a subset of effects costs on a joint.
        chosen: The set.
        repair: Its simulation; `None` for the empty set.
        others: Effects that sensors, frames and tool points show.
        left: What each of `remainder.CLUES` earns on what is left, `(clues, J)`.
        left_null: The same on reference recordings, the most of any part, at the length of the
            field, `(clues, J)`.
        scatter: Mean square of what is left over that of the reference, by joint, `(J,)`.
        strays: How far free runs with the set stray over those on the reference, each over what its
            noise lets expect, `(J,)`.
        tool_left: Error of measured tool points that is left over that of the reference.
    """

    evidence: Evidence
    tables: list[Table]
    rays: dict[str, list[Ray]]
    price: Price
    chosen: Chosen
    repair: Repair | None
    others: list[Found]
    left: np.ndarray
    left_null: np.ndarray
    scatter: np.ndarray
    strays: np.ndarray
    tool_left: float

    @property
    def names(self) -> set[str]:
        """All effects that were found."""
        return {*self.chosen.names, *(one.kind.name for one in self.others)}


@dataclass
class Search:
    """The search for effects.

    Attributes:
        case: The recordings.
        base: The simulator.
        kinds: The library.
        prices: What effects must earn.
        tell: Is told what is being done.
    """

    case: Case
    base: Base
    kinds: Sequence[Kind]
    prices: Prices
    tell: Tell

    def run(self) -> Findings:
        """Returns what is found."""
        prices, nulls = self.prices, [one.evidence for one in self.base.nulls]
        self.tell("sensors", 0.32)
        on_sensors = sensors.find_sensor_effects(self.case, self.kinds, prices.joint, prices.name)
        on_tool = geometry.find_geometry_errors(self.case, self.kinds, prices.joint, prices.name)
        evidence = _adjusted(self.base.field.evidence, self.case, [*on_sensors, *on_tool.found])
        grown, shapes = self._simulated(
            evidence, geometry.is_tracked(self.case.field, self.case.machine)
        )
        small = {name: rays_of(ways[0].kind, SMALL) for name, ways in grown.items()}
        known = Nulls(
            nulls,
            self.base.field.evidence.z.shape[1],
            small,
            grown,
            plain_joints(evidence),
            shapes,
            self.shared,
        )

        def price(j: int, subset: frozenset[str]) -> float:
            known_there = max(prices.reference * known.earned(j, subset), known.repeated(j, subset))
            return prices.joint * len(subset - self.shared) + known_there

        scatter = np.ones(self.case.machine.num_joints)
        tables, chosen, repaired = self._round(evidence, grown, shapes, price, scatter)
        wide = None
        if repaired and nonadditive_refit.is_needed(evidence, repaired, _promised(tables, chosen)):
            wide, tables, chosen, repaired = self._around(evidence, grown, chosen, repaired, price)
            grown = wide[1]
        self.tell("frames", 0.8)
        after = repaired.after if repaired else evidence.base
        changes, error = timing.Changes(evidence), evidence.error_of(after)
        late = timing.search(changes, error, nulls[:FEW], self.kinds, prices.joint, prices.name)
        if late:  # from here on errors scatter after each change of a command
            chancy = replace(evidence, late=changes.spread(error))
            shapes = [
                {
                    name: [replace(s, change=chancy.rewhitened(evidence, s.change, j)) for s in own]
                    for name, own in mine.items()
                }
                for j, mine in enumerate(shapes)
            ]
            evidence = chancy
        scatter = np.maximum(1.0, self._scatter(evidence.whitened(error[None])[:, 0]))
        for _ in range(2 if late else int(scatter.max() > SCATTERED)):
            if (
                late
            ):  # what delays change depends on when commands act, and so on what else delays them
                evidence = timing.expected(evidence, late, repaired.effects() if repaired else [])
                wide = (
                    nonadditive_refit.simulated(evidence, grown, repaired)
                    if wide and repaired
                    else None
                )
            z, grown, shapes = wide or (None, grown, shapes)
            tables, chosen, repaired = self._round(evidence, grown, shapes, price, scatter, z)
        self.tell("what is left", 0.92)
        others = [*on_sensors, *on_tool.found, *([late] if late else [])]
        beside = residual_model.repaired(evidence, repaired)
        left, left_null = self._left(beside)
        return Findings(
            evidence, tables, grown, price, chosen, repaired, others, left, left_null,
            self._scatter(beside.z), self._strays(beside), on_tool.left,
        )  # fmt: skip

    @property
    def shared(self) -> frozenset[str]:
        """Effects with one cause for all joints."""
        return effect_library.shared(self.kinds)

    def _simulated(
        self, evidence: Evidence, tracked: bool
    ) -> tuple[dict[str, list[Ray]], list[dict[str, list[Shape]]]]:
        """Returns the rays of each effect that free runs can show, and what it does to each joint."""
        grown: dict[str, list[Ray]] = {}
        shapes: list[dict[str, list[Shape]]] = [{} for _ in range(evidence.way.shape[2])]
        for number, kind in enumerate(self.kinds):
            measured = kind.target.side == "measurement" and (tracked or not kind.target.smooth)
            if kind.target.stochastic or kind.target.side == "kinematics" or measured:
                continue
            self.tell(f"simulating {kind.name}", 0.35 + 0.2 * number / len(self.kinds))
            grown[kind.name] = add(shapes, kind.name, rays_of(kind), evidence)
        return grown, shapes

    def _round(
        self,
        evidence: Evidence,
        grown: Mapping[str, list[Ray]],
        shapes: Sequence[Mapping[str, list[Shape]]],
        price: Price,
        scatter: np.ndarray,
        z: np.ndarray | None = None,
    ) -> tuple[list[Table], Chosen, Repair | None]:
        """Searches sets where errors scatter more than the noise says: they are worth less by as much; `z`: errors to explain."""
        tables = self._tables(evidence, grown, shapes, scatter, z)
        self.tell("the same on the reference", 0.7)
        prices = self.prices
        chosen = choose(
            tables, price, prices.name, prices.share, self.shared, prices.partial, prices.joint
        )
        if z is None and (common := chosen.names & self.shared):
            grown, shapes = bind_shared_sizes(common, tables, grown, shapes)
            tables = self._tables(evidence, grown, shapes, scatter, z)
            chosen = choose(
                tables, price, prices.name, prices.share, self.shared, prices.partial, prices.joint
            )
        repaired = self._repaired(evidence, grown, tables, chosen)
        if (
            repaired
            and (kept := refine.kept(evidence, chosen, repaired, price, scatter, self.shared))
            != chosen.subsets
        ):
            chosen = Chosen(kept, chosen.worth)
            repaired = self._repaired(evidence, grown, tables, chosen)
        return tables, chosen, repaired

    def _repaired(
        self,
        evidence: Evidence,
        grown: Mapping[str, list[Ray]],
        tables: Sequence[Table],
        chosen: Chosen,
    ) -> Repair | None:
        start = [
            table.score(subset).sizes for table, subset in zip(tables, chosen.subsets, strict=True)
        ]
        return repair(evidence, chosen.subsets, grown, start) if chosen.names else None

    def _tables(
        self,
        evidence: Evidence,
        grown: Mapping[str, list[Ray]],
        shapes: Sequence[Mapping[str, list[Shape]]],
        scatter: np.ndarray,
        z: np.ndarray | None,
    ) -> list[Table]:
        """Returns what sets earn on each joint."""
        tables, flat = [], {name: self.prices.joint * (name not in self.shared) for name in grown}
        for j, (mine, joint) in enumerate(
            zip(shapes, plain_joints(evidence, scatter, z), strict=True)
        ):
            self.tell(f"trying sets on joint {j + 1}", 0.55 + 0.1 * j / len(shapes))
            by = 1.0 / np.sqrt(scatter[j])
            scaled = {
                name: [Shape(shape.sizes, shape.change * by) for shape in own]
                for name, own in mine.items()
            }
            tables.append(Table(joint, scaled, evidence.block))
            tables[-1].explore(flat, 3 if z is None else MOST)
        return tables

    def _around(
        self,
        evidence: Evidence,
        grown: Mapping[str, list[Ray]],
        chosen: Chosen,
        repaired: Repair,
        price: Price,
    ) -> tuple[nonadditive_refit.Around, list[Table], Chosen, Repair | None]:
        """Goes on from a set whose effects do not add up: simulates all others in its company, fits sizes together."""
        tried, scatter = [repaired], np.ones(self.case.machine.num_joints)
        wide = nonadditive_refit.simulated(evidence, grown, repaired)
        for turn in range(TURNS):
            self.tell("simulating around what was found", 0.72 + 0.04 * turn)
            before = chosen
            tables, chosen, now = self._round(evidence, *wide[1:], price, scatter, wide[0])
            tried += [now] if now else []
            more = now and nonadditive_refit.grown(
                evidence, wide[1], tables, chosen, now, self.prices.joint
            )
            tried += [more] if more else []
            if now is None or (more is None and chosen.subsets == before.subsets):
                break
            wide = nonadditive_refit.simulated(evidence, grown, more or now)
        best = nonadditive_refit.best(evidence, wide[1], tried, price)
        if best is None:
            return wide, tables, Chosen((frozenset(),) * len(tables), 0.0), None
        for drops in (True, False):
            wide, subsets = (
                nonadditive_refit.simulated(evidence, grown, best),
                refine.subsets_of(best),
            )
            tables = self._tables(evidence, *wide[1:], scatter, wide[0])
            paying = nonadditive_refit.paying(tables, subsets, price, self.prices.name)
            if not drops or paying == subsets or not any(paying):
                break
            best = refine.without(evidence, wide[1], best, paying)
        worth = sum(
            table.score(s).total - price(j, s)
            for j, (table, s) in enumerate(zip(tables, subsets, strict=True))
            if s
        )
        return (
            wide,
            tables,
            Chosen(subsets, worth - self.prices.name * len(frozenset().union(*subsets))),
            best,
        )

    def _scatter(self, z: np.ndarray) -> np.ndarray:
        """Returns the mean square of errors over the noise `(J, E)` over that of the reference, outliers cut, `(J,)`."""
        nulls = [one.evidence.z for one in self.base.nulls]
        usual = (
            np.mean(np.minimum(np.concatenate(nulls, 1) ** 2, CUT), 1) if nulls else np.ones(len(z))
        )
        return np.mean(np.minimum(z**2, CUT), 1) / usual

    def _left(self, beside: Evidence) -> tuple[np.ndarray, np.ndarray]:
        """Returns what clues earn on what is left and, at most, on reference recordings, both `(clues, J)`."""
        nulls = [one.evidence for one in self.base.nulls]
        earned, on_nulls = (
            residual_model.predictable(beside, beside.z),
            [residual_model.predictable(one, one.z) for one in nulls],
        )
        return earned, residual_model.beyond(
            earned, on_nulls, [beside.z.shape[1] / one.z.shape[1] for one in nulls]
        )

    def _strays(self, beside: Evidence) -> np.ndarray:
        own = residual_model.strayed(beside, beside.error)
        nulls = [
            residual_model.strayed(one.evidence, one.evidence.error) for one in self.base.nulls
        ]
        return np.sqrt(own / np.maximum(np.mean(nulls, 0), 1e-9)) if nulls else np.ones_like(own)


def _promised(tables: Sequence[Table], chosen: Chosen) -> float:
    return sum(
        table.score(subset).total for table, subset in zip(tables, chosen.subsets, strict=True)
    )


def _adjusted(evidence: Evidence, case: Case, found: Sequence[Found]) -> Evidence:
    """Returns the evidence where encoders err as was found, and where sensors that scatter more say less."""
    steady = [
        (one.kind, one.values())
        for one in found
        if one.kind.target.side == "measurement" and _is_steady(one.kind)
    ]
    evidence = replace(
        evidence,
        candidates=replace(evidence.candidates, fixed=[*evidence.candidates.fixed, *steady]),
    )
    rough = [
        one.joints
        for one in found
        if one.kind.target.side == "measurement" and not _is_steady(one.kind)
    ]
    if not rough:
        return evidence
    assert evidence.noise is not None, "noise is known by now"
    reading = sensors.measure_excess_scatter(case.field, case.reference, case.machine) * np.any(
        rough, 0
    )
    noise = [
        replace(one, reading=float(more)) for one, more in zip(evidence.noise, reading, strict=True)
    ]
    return replace(evidence, noise=noise)


def _is_steady(kind: Kind) -> bool:
    return kind.target.smooth and not kind.target.stochastic
