"""The diagnosis: from a simulator held against recordings to an answer.

Axes: `J` joints, `E` entries (increments of all windows, over the simulator's noise), `W` windows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from brokk_rl.parallel import map_parallel
from diagnosis import (
    effect_library,
    geometry,
    nonadditive_refit,
    refine,
    residual_model,
    sensors,
    shown_effects,
    timing,
)
from diagnosis.baseline import Baseline
from diagnosis.case import GapCase
from diagnosis.drive_numbers import propose_drive_effects
from diagnosis.effect_library import DetectedEffect, EffectType
from diagnosis.refine import FittedSet, fit_set
from diagnosis.request import Penalties
from diagnosis.residuals import ParameterRay, Residuals
from diagnosis.responses import (
    REFERENCE_GRID,
    Response,
    choose_rays,
    fit_joint_faults,
    rewhiten_responses,
    scale_responses,
    simulate_effect,
)
from diagnosis.search import (
    MAX_EFFECTS,
    EffectSet,
    PenaltyFunction,
    ReferencePenalty,
    ReferenceScores,
    SubsetScore,
    SubsetTable,
    bind_shared_sizes,
    choose_set,
    list_promising_subsets,
)
from diagnosis.speed_curves import SpeedCurves

log = logging.getLogger(__name__)

# Chosen by hand; not searched.
SCATTER_LIMIT = 1.3
"""Mean square of whitened residuals over that of the reference from which gains are scaled down."""
MAX_SQUARE = 25.0
"""Largest square of a whitened residual in the scatter: 5 standard deviations."""
TIMING_REFERENCES = 2
"""Parts of the reference that show the error of delays; a run takes time for each."""
MAX_REFITS = 2
"""Rounds in which all effects are simulated beside a fitted set."""
ProgressCallback = Callable[[str, float], None]
"""Receives the name of the step and the share of the whole that is done."""


@dataclass(frozen=True)
class CandidateEffects:
    """Effects to choose among.

    Attributes:
        residuals: Residuals of the simulator on the field.
        rays: Rays of each effect.
        shapes: Responses of each joint to each effect, one a ray.
    """

    residuals: Residuals
    rays: dict[str, list[ParameterRay]]
    shapes: list[dict[str, list[Response]]]


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
        alone: Scores of effects by themselves, before any was chosen.
        alone_rays: Their rays; `None` for restored findings.
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
    alone: Sequence[SubsetTable] = ()
    alone_rays: dict[str, list[ParameterRay]] | None = None

    @property
    def names(self) -> set[str]:
        """All effects that were found."""
        return {*self.chosen.names, *(one.kind.name for one in self.detected)}


@dataclass(frozen=True)
class SearchState:
    """State of the search after a set was chosen.

    Attributes:
        effects: The effects to choose among.
        wide: Responses beside a fitted set; `None` while responses add up.
        tables: Scores of the subsets of each joint.
        chosen: The set.
        fitted: The set fitted by simulation; `None` for the empty set.
    """

    effects: CandidateEffects
    wide: nonadditive_refit.WideResponses | None
    tables: list[SubsetTable]
    chosen: EffectSet
    fitted: FittedSet | None


@dataclass
class EffectSearch:
    """The search for effects.

    Attributes:
        case: The recordings.
        base: The simulator.
        kinds: The library.
        penalties: Penalties of effects.
        tell: Receives the name and the progress of each step.
        curves: Speed curves of machine and simulator, which may show a set at once.
    """

    case: GapCase
    base: Baseline
    kinds: Sequence[EffectType]
    penalties: Penalties
    tell: ProgressCallback
    curves: SpeedCurves | None = None

    def run(self) -> DetectionResult:
        """Return the chosen set, its fit and the remaining residuals."""
        penalties = self.penalties
        self.tell("sensors", 0.4)
        on_sensors = sensors.find_sensor_effects(
            self.case, self.kinds, penalties.joint, penalties.name
        )
        on_tool = geometry.find_geometry_errors(
            self.case, self.kinds, penalties.joint, penalties.name
        )
        residuals = sensors.adjust_residuals(
            self.base.field.residuals, self.case, [*on_sensors, *on_tool.found]
        )
        effects = self._simulate_effects(residuals)
        price = self._build_price(effects)
        search = self._choose(effects, price, np.ones(self.case.machine.num_joints))
        alone = search.tables
        self.tell("what the speed curves show", 0.66)
        shown, proposed = [], []
        if self.curves is not None:
            proposed = shown_effects.propose_effects(self.curves, self.kinds, self.case.machine)
            if self.case.machine.interface == "torque":
                proposed = propose_drive_effects(self.base, self.kinds, self.case.machine)
            parts = (effects.rays, effects.shapes, search.fitted, price)
            shown = shown_effects.fit_shown_effects(residuals, proposed, *parts)
        if shown:
            search = self._refit_beside(search, shown, price)
        elif search.fitted and nonadditive_refit.is_needed(
            residuals, search.fitted, _sum_scores(search.tables, search.chosen)
        ):
            search = self._refit_beside(search, [search.fitted], price)
        self.tell("frames", 0.9)
        error = residuals.compute_error(search.fitted.after if search.fitted else residuals.base)
        late, search = self._detect_late_frames(search, error)
        z = search.effects.residuals.whiten(error[None])[:, 0]
        # A penalty is in nats of the noise model: where residuals scatter more, gains count less.
        scatter = np.maximum(1.0, self._scatter(z))
        for _ in range(2 if late else int(scatter.max() > SCATTER_LIMIT)):
            # The mean delay depends on the other effects, and these on it: hence two rounds.
            search = _add_mean_delay(search, late) if late else search
            search = self._choose(search.effects, price, scatter, search.wide)
        parts = (search.effects.rays, search.effects.shapes, search.fitted)
        kept = shown_effects.keep_shown_numbers(search.effects.residuals, proposed, *parts)
        if kept is not None:
            chosen = EffectSet(refine.list_subsets(kept), search.chosen.net_gain)
            search = replace(search, chosen=chosen, fitted=kept)
        self.tell("what is left", 0.92)
        others = [*on_sensors, *on_tool.found, *([late] if late else [])]
        beside = residual_model.apply_fitted_set(search.effects.residuals, search.fitted)
        left, reference_clue_gains = self._left(beside)
        return DetectionResult(
            search.effects.residuals, search.tables, search.effects.rays, price, search.chosen, search.fitted,
            others, left, reference_clue_gains, self._scatter(beside.z), self._strays(beside), on_tool.left,
            alone, effects.rays,
        )  # fmt: skip

    @property
    def shared(self) -> frozenset[str]:
        """Effects with one cause for all joints."""
        return effect_library.list_shared_effects(self.kinds)

    @property
    def _left_out(self) -> list[Residuals]:
        """Residuals on each part of the reference, left out of the fit."""
        return [one.residuals for one in self.base.left_out]

    def _build_price(self, effects: CandidateEffects) -> ReferencePenalty:
        """Return the penalty of a subset on a joint, with its gain on the reference."""
        known = ReferenceScores(
            self._left_out,
            self.base.field.residuals.z.shape[1],
            {
                name: choose_rays(ways[0].kind, REFERENCE_GRID)
                for name, ways in effects.rays.items()
            },
            effects.rays,
            fit_joint_faults(effects.residuals),
            effects.shapes,
            self.shared,
        )
        return ReferencePenalty(known, self.penalties.joint, self.penalties.reference)

    def _simulate_effects(self, residuals: Residuals) -> CandidateEffects:
        """Return the effects that free runs can show, with their responses on each joint."""
        tracked = geometry.is_tracked(self.case.field, self.case.machine)
        rays: dict[str, list[ParameterRay]] = {}
        shapes: list[dict[str, list[Response]]] = [{} for _ in range(residuals.increments.shape[2])]
        simulated = []
        for kind in self.kinds:
            # `geometry` finds encoder errors from tool points, `sensors` finds noise and steps.
            measured = kind.target.side == "measurement" and (tracked or not kind.target.smooth)
            if not (kind.target.stochastic or kind.target.side == "kinematics" or measured):
                simulated.append(kind)
        residuals.z  # noqa: B018  # made once, before other processes need it
        every = map_parallel(
            lambda kind: simulate_effect(choose_rays(kind), residuals),
            simulated,
            lambda kind, done: self.tell(f"simulating {kind.name}", 0.45 + 0.07 * done),
        )
        for kind, (shape, own) in zip(simulated, every, strict=True):
            rays[kind.name] = [replace(ray, shape=shape) for ray in choose_rays(kind)]
            for mine, added in zip(shapes, own, strict=True):
                mine.update(added)
        return CandidateEffects(residuals, rays, shapes)

    def _choose(
        self,
        effects: CandidateEffects,
        price: ReferencePenalty,
        scatter: np.ndarray,
        wide: nonadditive_refit.WideResponses | None = None,
    ) -> SearchState:
        """Choose a set, fit it by simulation, and prune it.

        Args:
            effects: The effects to choose among.
            price: Penalty of a subset on a joint.
            scatter: Mean square of the whitened residuals over that of the reference, `(J,)`.
            wide: Responses beside a fitted set, which replace those of `effects`.
        """
        residuals, z = effects.residuals, wide.z if wide else None
        if wide:
            effects = CandidateEffects(residuals, wide.rays, wide.shapes)
        tables = self._score_subsets(effects, scatter, z)
        self.tell("the same on the reference", 0.56)
        price.prepare(self._list_promising(tables))
        chosen = choose_by_penalties(tables, price, self.penalties, self.shared)
        tied = effects
        # Joints first size a shared effect separately; it is bound where responses still add up.
        alike = effect_library.list_alike_effects(self.kinds)
        if z is None and (common := chosen.names & alike):
            tied = CandidateEffects(
                residuals, *bind_shared_sizes(common, tables, effects.rays, effects.shapes)
            )
            tables = self._score_subsets(tied, scatter, z)
            price.prepare(self._list_promising(tables))
            chosen = choose_by_penalties(tables, price, self.penalties, self.shared)
        fitted = _fit_chosen_set(tied, tables, chosen)
        if fitted:
            # Adding up responses is an approximation: the simulated set decides.
            kept = refine.prune_set(residuals, chosen, fitted, price, scatter, self.shared)
            if kept != chosen.subsets:
                chosen = EffectSet(kept, chosen.net_gain)
                fitted = _fit_chosen_set(tied, tables, chosen)
        return SearchState(effects, wide, tables, chosen, fitted)

    def _list_promising(self, tables: Sequence[SubsetTable]) -> list[list[frozenset[str]]]:
        """Return the subsets of each joint whose penalty `choose_set` asks for."""
        least, share = self.penalties.joint, self.penalties.share
        return [list_promising_subsets(table, least, share, self.shared) for table in tables]

    def _score_subsets(
        self, effects: CandidateEffects, scatter: np.ndarray, z: np.ndarray | None
    ) -> list[SubsetTable]:
        """Return the scores of subsets on each joint; `z`: whitened residuals to explain."""
        residuals, shapes = effects.residuals, effects.shapes
        flat = {name: self.penalties.joint * (name not in self.shared) for name in effects.rays}
        tables = []
        joints = fit_joint_faults(residuals, scatter, z)
        for j, (mine, joint) in enumerate(zip(shapes, joints, strict=True)):
            scaled = scale_responses(mine, 1.0 / np.sqrt(scatter[j]))
            tables.append(SubsetTable(joint, scaled, residuals.block))

        def explore(j: int) -> dict[frozenset[str], SubsetScore]:
            tables[j].explore(flat, 3 if z is None else MAX_EFFECTS)
            return tables[j].scores

        every = map_parallel(
            explore,
            range(len(tables)),
            lambda j, done: self.tell(f"trying sets on joint {j + 1}", 0.52 + 0.04 * done),
        )
        return [replace(table, scores=scores) for table, scores in zip(tables, every, strict=True)]

    def _refit_beside(
        self, search: SearchState, known: Sequence[FittedSet], price: ReferencePenalty
    ) -> SearchState:
        """Continue from sets whose responses do not add up: simulate all effects beside the first, fit sizes together."""
        effects, residuals = search.effects, search.effects.residuals
        tried, scatter = list(known), np.ones(self.case.machine.num_joints)
        wide = nonadditive_refit.simulate_beside(residuals, effects.rays, known[0])
        for turn in range(MAX_REFITS):
            self.tell("simulating around what was found", 0.75 + 0.08 * turn)
            before, search = search, self._choose(effects, price, scatter, wide)
            now = search.fitted
            if now is None:
                break
            more = nonadditive_refit.add_effect(
                residuals, wide.rays, search.tables, search.chosen, now, self.penalties.joint
            )
            tried += [now, more] if more else [now]
            if more is None and search.chosen.subsets == before.chosen.subsets:
                break
            wide = nonadditive_refit.simulate_beside(residuals, effects.rays, more or now)
        # The responses before keep their place: a later round without a fitted set needs them.
        after = CandidateEffects(residuals, wide.rays, effects.shapes)
        best = nonadditive_refit.combine_best(residuals, wide.rays, tried, price)
        if best is None:
            empty = EffectSet((frozenset(),) * len(search.tables), 0.0)
            return SearchState(after, wide, search.tables, empty, None)
        return self._drop_unneeded(effects, best, price)

    def _drop_unneeded(
        self, effects: CandidateEffects, best: FittedSet, price: ReferencePenalty
    ) -> SearchState:
        """Return the set `best` without effects that add less than they cost beside the others."""
        residuals, scatter = effects.residuals, np.ones(self.case.machine.num_joints)
        for drops in (True, False):
            wide = nonadditive_refit.simulate_beside(residuals, effects.rays, best)
            subsets = refine.list_subsets(best)
            beside = CandidateEffects(residuals, wide.rays, wide.shapes)
            tables = self._score_subsets(beside, scatter, wide.z)
            paying = nonadditive_refit.drop_unneeded(tables, subsets, price, self.penalties.name)
            if not drops or paying == subsets or not any(paying):
                break
            best = refine.drop_effects(residuals, wide.rays, best, paying)
        gains = []
        for j, (table, subset) in enumerate(zip(tables, subsets, strict=True)):
            if subset:
                gains.append(table.score(subset).total - price(j, subset))
        net_gain = sum(gains) - self.penalties.name * len(frozenset().union(*subsets))
        after = CandidateEffects(residuals, wide.rays, effects.shapes)
        return SearchState(after, wide, tables, EffectSet(subsets, net_gain), best)

    def _detect_late_frames(
        self, search: SearchState, error: np.ndarray
    ) -> tuple[DetectedEffect | None, SearchState]:
        """Return the effect on the arrival of commands, if any, and the search with its noise.

        Args:
            search: The search so far.
            error: Measured less simulated increments with the chosen set, `(W, I, J)`.
        """
        changes = timing.CommandChanges(search.effects.residuals)
        late = timing.detect_timing_effect(
            changes,
            error,
            self._left_out[:TIMING_REFERENCES],
            self.kinds,
            self.penalties.joint,
            self.penalties.name,
        )
        if late is None:
            return None, search
        # From here on residuals scatter after each change of a command.
        noisy = replace(search.effects.residuals, late=changes.spread(error))
        shapes = rewhiten_responses(search.effects.shapes, search.effects.residuals, noisy)
        effects = CandidateEffects(noisy, search.effects.rays, shapes)
        return late, replace(search, effects=effects)

    def _scatter(self, z: np.ndarray) -> np.ndarray:
        """Return the mean square of whitened residuals `(J, E)` over that of the reference, outliers cut, `(J,)`."""
        usual = np.ones(len(z))
        if left_out := self._left_out:
            known = np.concatenate([one.z for one in left_out], 1)
            usual = np.mean(np.minimum(known**2, MAX_SQUARE), 1)
        return np.mean(np.minimum(z**2, MAX_SQUARE), 1) / usual

    def _left(self, beside: Residuals) -> tuple[np.ndarray, np.ndarray]:
        """Return the gain of clues on the remaining residuals, and the largest on reference recordings, both `(clues, J)`."""
        earned = residual_model.score_clues(beside, beside.z)
        left_out = self._left_out
        known = [residual_model.score_clues(one, one.z) for one in left_out]
        # Gains grow with the number of entries.
        lengths = [beside.z.shape[1] / one.z.shape[1] for one in left_out]
        return earned, residual_model.scale_reference_gains(earned, known, lengths)

    def _strays(self, beside: Residuals) -> np.ndarray:
        own = residual_model.measure_straying(beside, beside.error)
        known = [residual_model.measure_straying(one, one.error) for one in self._left_out]
        return np.sqrt(own / np.maximum(np.mean(known, 0), 1e-9)) if known else np.ones_like(own)


def choose_by_penalties(
    tables: Sequence[SubsetTable],
    price: PenaltyFunction,
    penalties: Penalties,
    shared: frozenset[str],
) -> EffectSet:
    """Return the set that `choose_set` selects at these penalties."""
    return choose_set(
        tables,
        price,
        name_price=penalties.name,
        share=penalties.share,
        shared=shared,
        partial=penalties.partial,
        least=penalties.joint,
    )


def _fit_chosen_set(
    effects: CandidateEffects, tables: Sequence[SubsetTable], chosen: EffectSet
) -> FittedSet | None:
    if not chosen.names:
        return None
    scored = zip(tables, chosen.subsets, strict=True)
    start = [table.score(subset).sizes for table, subset in scored]
    return fit_set(effects.residuals, chosen.subsets, effects.rays, start)


def _add_mean_delay(search: SearchState, late: DetectedEffect) -> SearchState:
    """Return the search with the mean response of late frames in its residuals."""
    fitted, effects = search.fitted, search.effects
    steady = fitted.effects() if fitted else []
    residuals = timing.add_mean_delay(effects.residuals, late, steady)
    wide = None
    if search.wide and fitted:
        wide = nonadditive_refit.simulate_beside(residuals, effects.rays, fitted)
    return replace(search, effects=replace(effects, residuals=residuals), wide=wide)


def _sum_scores(tables: Sequence[SubsetTable], chosen: EffectSet) -> float:
    scored = zip(tables, chosen.subsets, strict=True)
    return sum(table.score(subset).total for table, subset in scored)
