"""The part of each named effect: its Shapley value, and the edit test.

The parts of all effects that act on motion add up to the whole reduction. The edit test removes one
effect from the repaired simulator without fitting the others again. An effect is identified when
the error then rises by about what the effect had closed: a name that other effects can replace does
not carry its part.
Axes: `W` windows, `K` steps, `J` joints, `R` rays, `B` draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from diagnosis.bootstrap import summarise_draws
from diagnosis.closure import Estimate
from diagnosis.detection import DetectionResult
from diagnosis.effect_library import EffectSimulator
from diagnosis.gap import GapClosure, compute_shapley
from diagnosis.refine import simulate_refit, simulate_sizes

MIN_RESTORED = 0.5
"""Least rise of the error without an effect, over its Shapley value, at which the effect counts as
identified. Half: what replaces an effect then carries less than the effect. Chosen by hand."""


@dataclass(frozen=True)
class EffectPart:
    """The part of one effect.

    Attributes:
        closed: Share of the gap that it closes (Shapley value); `None` where the gap is unknown.
        reduced: Share of the error before that it removes (Shapley value).
        rise: Rise of the error where it alone is removed from the repaired simulator, over the
            error before.
        restored: `rise` over `reduced`.
        identified: The edit test is passed.
    """

    closed: Estimate | None
    reduced: Estimate
    rise: Estimate
    restored: float
    identified: bool


def judge_edit(reduced: Estimate, rise: Estimate) -> tuple[float, bool]:
    """Return how much of an effect's part its removal restores, and whether this identifies it."""
    restored = rise.mean / reduced.mean if reduced.mean > 0.0 else 0.0
    return restored, rise.has_interval and rise.ci95[0] > 0.0 and restored >= MIN_RESTORED


@dataclass(frozen=True, eq=False)
class EffectAttribution:
    """Free runs of the repaired simulator with some of its effects.

    Attributes:
        result: What the search found.
        reach: Errors of the simulator as it was and as it is repaired.
    """

    result: DetectionResult
    reach: GapClosure

    @property
    def _simulator(self) -> EffectSimulator:
        return self.result.residuals.simulator

    @cached_property
    def steady(self) -> list[str]:
        """Detected effects of sensors that the repaired simulator contains."""
        known = self.reach.base.field.residuals.simulator.fixed
        return [kind.name for kind, _ in self._simulator.fixed[len(known) :]]

    @cached_property
    def late(self) -> list[str]:
        """Detected effects whose mean response was added to the free runs."""
        if self.result.residuals.mean is None:
            return []
        names = [one.kind.name for one in self.result.detected if one.kind.stage == "timing"]
        return [name for name in names if name not in self.steady]

    @property
    def detected(self) -> list[str]:
        """Detected effects that act on the free runs."""
        return [*self.steady, *self.late]

    def measure_parts(self) -> dict[str, EffectPart]:
        """Return the part of each effect that acts on the free runs.

        Detected effects come first, since they were found from other measurements; the chosen ones
        add to them.
        """
        reach, chosen = self.reach, sorted(self.result.chosen.names)
        parts = compute_shapley(self.detected, lambda some: -reach.errors(self._run_detected(some)))
        beside = -reach.errors(self._run_detected(frozenset(self.detected)))
        parts |= compute_shapley(
            chosen, lambda some: -reach.errors(self._run_chosen(some)) if some else beside
        )
        after, found = reach.errors(reach.after), {}
        size = np.maximum(reach.before, 1e-12)
        for name, fewer in parts.items():
            closed = summarise_draws(reach.share_closed(fewer)) if reach.has_gap else None
            reduced = summarise_draws(fewer / size)
            rise = summarise_draws((reach.errors(self._run_without(name)) - after) / size)
            found[name] = EffectPart(closed, reduced, rise, *judge_edit(reduced, rise))
        return found

    @property
    def _mean(self) -> np.ndarray | float:
        return 0.0 if self.result.residuals.mean is None else self.result.residuals.mean

    def _keep(self, names: Sequence[str] | frozenset[str]) -> EffectSimulator:
        """Return the simulator with some of the detected effects of sensors."""
        known = len(self.reach.base.field.residuals.simulator.fixed)
        fixed = list(self._simulator.fixed)
        kept = [pair for pair in fixed[known:] if pair[0].name in names]
        return replace(self._simulator, fixed=[*fixed[:known], *kept])

    def _run_detected(self, names: frozenset[str]) -> np.ndarray:
        """Return free runs `(W, K, J)` with some of the detected effects and no chosen one."""
        if not self.result.chosen.names and names == frozenset(self.detected):
            return self.reach.after
        if names >= frozenset(self.steady):
            paths = self.result.residuals.base
        elif names & set(self.steady):
            paths = self._keep(names).simulate([])[0]
        else:
            paths = self.reach.base.field.residuals.base
        return paths + self._mean if names & set(self.late) else paths

    def _run_chosen(self, names: frozenset[str]) -> np.ndarray:
        """Return free runs with all detected and some chosen effects, whose sizes are fitted anew."""
        if names == self.result.chosen.names:
            return self.reach.after
        subsets = [subset & names for subset in self.result.chosen.subsets]
        scored = zip(self.result.tables, subsets, strict=True)
        start = [table.score(subset).sizes for table, subset in scored]
        return simulate_refit(self.result.residuals, subsets, self.result.rays, start)

    def _run_without(self, name: str) -> np.ndarray:
        """Return free runs of the repaired simulator without one effect, nothing fitted again."""
        fitted, residuals = self.result.fitted, self.result.residuals
        if name in self.late:
            return self.reach.after - self._mean
        kept = [one for one in self.steady if one != name]
        simulator = self._keep(kept)
        if fitted is None:
            return simulator.simulate([])[0] + self._mean
        removed = np.array([ray.kind.name == name for ray in fitted.rays])
        # Each window meets the sizes that were not fitted to its half.
        sizes = np.where(removed[None, :, None], 0.0, fitted.halves)
        paths = simulate_sizes(simulator, fitted.rays, sizes)
        half = residuals.fold.reshape(len(residuals.increments), -1)[:, 0]
        return np.where((half == 0)[:, None, None], paths[0], paths[1]) + self._mean
