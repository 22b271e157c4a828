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
from diagnosis.baseline import Baseline
from diagnosis.case import GapCase
from diagnosis.effect_library import DetectedEffect, EffectType
from diagnosis.refine import FittedSet, fit_set
from diagnosis.residuals import ParameterRay, Residuals
from diagnosis.responses import (
    REFERENCE_GRID,
    Response,
    add_responses,
    choose_rays,
    fit_joint_faults,
)
from diagnosis.search import (
    MAX_EFFECTS,
    EffectSet,
    PenaltyFunction,
    ReferenceScores,
    SubsetTable,
    bind_shared_sizes,
    choose_set,
)

log = logging.getLogger(__name__)

SCATTER_LIMIT = 1.3
"""Mean square error over that of the reference from which what effects earn is taken down."""
MAX_SQUARE = 25.0
"""Squares of errors over the noise count no more than this in what scatters."""
TIMING_REFERENCES = 2
"""Parts of the reference that tell how delays scatter."""
MAX_REFITS = 2
"""Times that effects are simulated around what was found, where adding up is far off."""
ProgressCallback = Callable[[str, float], None]
"""Receives the name of the step and the share of the whole that is done."""


@spec
class Penalties:
    """Penalties of effects, nats of log likelihood on recordings outside the fit.

    Attributes:
        joint: For each joint that has it, unless one cause is behind it on all joints.
        reference: Factor on its gain on reference recordings.
        name: For the effect as such.
        partial: For each joint that lacks an effect with one cause for all joints.
        share: Least part of the gain of its joint's set: an effect that adds less only corrects the
            form of another.
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
class DetectionResult:
    """Result of the search.

    Attributes:
        residuals: Residuals of the simulator on the field, adjusted for the detected effects.
        tables: Scores of the subsets of each joint.
        rays: Rays of each effect.
        price: Penalty of a subset of effects on a joint.
        chosen: The set.
        fitted: The set fitted by simulation; `None` for the empty set.
        detected: Effects that sensors, frames and tool points show.
        clue_gains: Gain of each of `residual_model.CLUES` on the remaining residuals, `(clues, J)`.
        reference_clue_gains: The same on reference recordings, the largest of any part, at the
            length of the field, `(clues, J)`.
        scatter: Mean square of the remaining residuals over that of the reference, `(J,)`.
        strays: Free-run error with the set over that on the reference, each over its expectation
            under the noise, `(J,)`.
        tool_left: Remaining error of measured tool points over that of the reference.
    """

    residuals: Residuals
    tables: list[SubsetTable]
    rays: dict[str, list[ParameterRay]]
    price: PenaltyFunction
    chosen: EffectSet
    fitted: FittedSet | None
    detected: list[DetectedEffect]
    clue_gains: np.ndarray
    reference_clue_gains: np.ndarray
    scatter: np.ndarray
    strays: np.ndarray
    tool_left: float

    @property
    def names(self) -> set[str]:
        """All effects that were found."""
        return {*self.chosen.names, *(one.kind.name for one in self.detected)}


@dataclass
class EffectSearch:
    """The search for effects.

    Attributes:
        case: The recordings.
        base: The simulator.
        kinds: The library.
        penalties: Penalties of effects.
        tell: Receives the name and the progress of each step.
    """

    case: GapCase
    base: Baseline
    kinds: Sequence[EffectType]
    penalties: Penalties
    tell: ProgressCallback

    def run(self) -> DetectionResult:
        """Return the chosen set, its fit and the remaining residuals."""
        penalties, left_out = self.penalties, [one.residuals for one in self.base.left_out]
        self.tell("sensors", 0.32)
        on_sensors = sensors.find_sensor_effects(
            self.case, self.kinds, penalties.joint, penalties.name
        )
        on_tool = geometry.find_geometry_errors(
            self.case, self.kinds, penalties.joint, penalties.name
        )
        residuals = _adjust_residuals(
            self.base.field.residuals, self.case, [*on_sensors, *on_tool.found]
        )
        grown, shapes = self._simulated(
            residuals, geometry.is_tracked(self.case.field, self.case.machine)
        )
        small = {name: choose_rays(ways[0].kind, REFERENCE_GRID) for name, ways in grown.items()}
        known = ReferenceScores(
            left_out,
            self.base.field.residuals.z.shape[1],
            small,
            grown,
            fit_joint_faults(residuals),
            shapes,
            self.shared,
        )

        def price(j: int, subset: frozenset[str]) -> float:
            known_there = max(
                penalties.reference * known.earned(j, subset), known.repeated(j, subset)
            )
            return penalties.joint * len(subset - self.shared) + known_there

        scatter = np.ones(self.case.machine.num_joints)
        tables, chosen, fitted = self._round(residuals, grown, shapes, price, scatter)
        wide = None
        if fitted and nonadditive_refit.is_needed(residuals, fitted, _sum_scores(tables, chosen)):
            wide, tables, chosen, fitted = self._around(residuals, grown, chosen, fitted, price)
            grown = wide.rays
        self.tell("frames", 0.8)
        after = fitted.after if fitted else residuals.base
        changes, error = timing.CommandChanges(residuals), residuals.compute_error(after)
        late = timing.detect_timing_effect(
            changes,
            error,
            left_out[:TIMING_REFERENCES],
            self.kinds,
            penalties.joint,
            penalties.name,
        )
        if late:  # from here on errors scatter after each change of a command
            chancy = replace(residuals, late=changes.spread(error))
            shapes = [
                {
                    name: [replace(s, change=chancy.rewhiten(residuals, s.change, j)) for s in own]
                    for name, own in mine.items()
                }
                for j, mine in enumerate(shapes)
            ]
            residuals = chancy
        scatter = np.maximum(1.0, self._scatter(residuals.whiten(error[None])[:, 0]))
        for _ in range(2 if late else int(scatter.max() > SCATTER_LIMIT)):
            if (
                late
            ):  # what delays change depends on when commands act, and so on what else delays them
                residuals = timing.add_mean_delay(
                    residuals, late, fitted.effects() if fitted else []
                )
                wide = (
                    nonadditive_refit.simulate_beside(residuals, grown, fitted)
                    if wide and fitted
                    else None
                )
            z, grown, shapes = wide or (None, grown, shapes)
            tables, chosen, fitted = self._round(residuals, grown, shapes, price, scatter, z)
        self.tell("what is left", 0.92)
        others = [*on_sensors, *on_tool.found, *([late] if late else [])]
        beside = residual_model.apply_fitted_set(residuals, fitted)
        left, reference_clue_gains = self._left(beside)
        return DetectionResult(
            residuals, tables, grown, price, chosen, fitted, others, left, reference_clue_gains,
            self._scatter(beside.z), self._strays(beside), on_tool.left,
        )  # fmt: skip

    @property
    def shared(self) -> frozenset[str]:
        """Effects with one cause for all joints."""
        return effect_library.list_shared_effects(self.kinds)

    def _simulated(
        self, residuals: Residuals, tracked: bool
    ) -> tuple[dict[str, list[ParameterRay]], list[dict[str, list[Response]]]]:
        """Return the rays of each effect that free runs can show, and its responses on each joint."""
        grown: dict[str, list[ParameterRay]] = {}
        shapes: list[dict[str, list[Response]]] = [{} for _ in range(residuals.increments.shape[2])]
        for number, kind in enumerate(self.kinds):
            measured = kind.target.side == "measurement" and (tracked or not kind.target.smooth)
            if kind.target.stochastic or kind.target.side == "kinematics" or measured:
                continue
            self.tell(f"simulating {kind.name}", 0.35 + 0.2 * number / len(self.kinds))
            grown[kind.name] = add_responses(shapes, kind.name, choose_rays(kind), residuals)
        return grown, shapes

    def _round(
        self,
        residuals: Residuals,
        grown: Mapping[str, list[ParameterRay]],
        shapes: Sequence[Mapping[str, list[Response]]],
        price: PenaltyFunction,
        scatter: np.ndarray,
        z: np.ndarray | None = None,
    ) -> tuple[list[SubsetTable], EffectSet, FittedSet | None]:
        """Search sets where errors scatter more than the noise says: they are worth less by as much; `z`: errors to explain."""
        tables = self._tables(residuals, grown, shapes, scatter, z)
        self.tell("the same on the reference", 0.7)
        penalties = self.penalties
        chosen = choose_set(
            tables,
            price,
            penalties.name,
            penalties.share,
            self.shared,
            penalties.partial,
            penalties.joint,
        )
        if z is None and (common := chosen.names & self.shared):
            grown, shapes = bind_shared_sizes(common, tables, grown, shapes)
            tables = self._tables(residuals, grown, shapes, scatter, z)
            chosen = choose_set(
                tables,
                price,
                penalties.name,
                penalties.share,
                self.shared,
                penalties.partial,
                penalties.joint,
            )
        fitted = self._repaired(residuals, grown, tables, chosen)
        if (
            fitted
            and (kept := refine.prune_set(residuals, chosen, fitted, price, scatter, self.shared))
            != chosen.subsets
        ):
            chosen = EffectSet(kept, chosen.net_gain)
            fitted = self._repaired(residuals, grown, tables, chosen)
        return tables, chosen, fitted

    def _repaired(
        self,
        residuals: Residuals,
        grown: Mapping[str, list[ParameterRay]],
        tables: Sequence[SubsetTable],
        chosen: EffectSet,
    ) -> FittedSet | None:
        start = [
            table.score(subset).sizes for table, subset in zip(tables, chosen.subsets, strict=True)
        ]
        return fit_set(residuals, chosen.subsets, grown, start) if chosen.names else None

    def _tables(
        self,
        residuals: Residuals,
        grown: Mapping[str, list[ParameterRay]],
        shapes: Sequence[Mapping[str, list[Response]]],
        scatter: np.ndarray,
        z: np.ndarray | None,
    ) -> list[SubsetTable]:
        """Return the scores of subsets on each joint."""
        tables, flat = (
            [],
            {name: self.penalties.joint * (name not in self.shared) for name in grown},
        )
        for j, (mine, joint) in enumerate(
            zip(shapes, fit_joint_faults(residuals, scatter, z), strict=True)
        ):
            self.tell(f"trying sets on joint {j + 1}", 0.55 + 0.1 * j / len(shapes))
            by = 1.0 / np.sqrt(scatter[j])
            scaled = {
                name: [Response(shape.sizes, shape.change * by) for shape in own]
                for name, own in mine.items()
            }
            tables.append(SubsetTable(joint, scaled, residuals.block))
            tables[-1].explore(flat, 3 if z is None else MAX_EFFECTS)
        return tables

    def _around(
        self,
        residuals: Residuals,
        grown: Mapping[str, list[ParameterRay]],
        chosen: EffectSet,
        fitted: FittedSet,
        price: PenaltyFunction,
    ) -> tuple[nonadditive_refit.WideResponses, list[SubsetTable], EffectSet, FittedSet | None]:
        """Continue from a set whose effects do not add up: simulates all others in its company, fits sizes together."""
        tried, scatter = [fitted], np.ones(self.case.machine.num_joints)
        wide = nonadditive_refit.simulate_beside(residuals, grown, fitted)
        for turn in range(MAX_REFITS):
            self.tell("simulating around what was found", 0.72 + 0.04 * turn)
            before = chosen
            tables, chosen, now = self._round(
                residuals, wide.rays, wide.shapes, price, scatter, wide.z
            )
            tried += [now] if now else []
            more = now and nonadditive_refit.add_effect(
                residuals, wide.rays, tables, chosen, now, self.penalties.joint
            )
            tried += [more] if more else []
            if now is None or (more is None and chosen.subsets == before.subsets):
                break
            wide = nonadditive_refit.simulate_beside(residuals, grown, more or now)
        best = nonadditive_refit.combine_best(residuals, wide.rays, tried, price)
        if best is None:
            return wide, tables, EffectSet((frozenset(),) * len(tables), 0.0), None
        for drops in (True, False):
            wide, subsets = (
                nonadditive_refit.simulate_beside(residuals, grown, best),
                refine.list_subsets(best),
            )
            tables = self._tables(residuals, wide.rays, wide.shapes, scatter, wide.z)
            paying = nonadditive_refit.drop_unneeded(tables, subsets, price, self.penalties.name)
            if not drops or paying == subsets or not any(paying):
                break
            best = refine.drop_effects(residuals, wide.rays, best, paying)
        worth = sum(
            table.score(s).total - price(j, s)
            for j, (table, s) in enumerate(zip(tables, subsets, strict=True))
            if s
        )
        return (
            wide,
            tables,
            EffectSet(subsets, worth - self.penalties.name * len(frozenset().union(*subsets))),
            best,
        )

    def _scatter(self, z: np.ndarray) -> np.ndarray:
        """Return the mean square of errors over the noise `(J, E)` over that of the reference, outliers cut, `(J,)`."""
        left_out = [one.residuals.z for one in self.base.left_out]
        usual = (
            np.mean(np.minimum(np.concatenate(left_out, 1) ** 2, MAX_SQUARE), 1)
            if left_out
            else np.ones(len(z))
        )
        return np.mean(np.minimum(z**2, MAX_SQUARE), 1) / usual

    def _left(self, beside: Residuals) -> tuple[np.ndarray, np.ndarray]:
        """Return the gain of clues on the remaining residuals, and the largest on reference recordings, both `(clues, J)`."""
        left_out = [one.residuals for one in self.base.left_out]
        earned, on_nulls = (
            residual_model.score_clues(beside, beside.z),
            [residual_model.score_clues(one, one.z) for one in left_out],
        )
        return earned, residual_model.scale_reference_gains(
            earned, on_nulls, [beside.z.shape[1] / one.z.shape[1] for one in left_out]
        )

    def _strays(self, beside: Residuals) -> np.ndarray:
        own = residual_model.measure_straying(beside, beside.error)
        left_out = [
            residual_model.measure_straying(one.residuals, one.residuals.error)
            for one in self.base.left_out
        ]
        return (
            np.sqrt(own / np.maximum(np.mean(left_out, 0), 1e-9)) if left_out else np.ones_like(own)
        )


def _sum_scores(tables: Sequence[SubsetTable], chosen: EffectSet) -> float:
    return sum(
        table.score(subset).total for table, subset in zip(tables, chosen.subsets, strict=True)
    )


def _adjust_residuals(
    residuals: Residuals, case: GapCase, found: Sequence[DetectedEffect]
) -> Residuals:
    """Return the evidence where encoders err as was found, and where sensors that scatter more say less."""
    steady = [
        (one.kind, one.values())
        for one in found
        if one.kind.target.side == "measurement" and _is_steady(one.kind)
    ]
    residuals = replace(
        residuals,
        simulator=replace(residuals.simulator, fixed=[*residuals.simulator.fixed, *steady]),
    )
    rough = [
        one.joints
        for one in found
        if one.kind.target.side == "measurement" and not _is_steady(one.kind)
    ]
    if not rough:
        return residuals
    assert residuals.noise is not None, "noise is known by now"
    reading = sensors.measure_excess_scatter(case.field, case.reference, case.machine) * np.any(
        rough, 0
    )
    noise = [
        replace(one, reading=float(more))
        for one, more in zip(residuals.noise, reading, strict=True)
    ]
    return replace(residuals, noise=noise)


def _is_steady(kind: EffectType) -> bool:
    return kind.target.smooth and not kind.target.stochastic
