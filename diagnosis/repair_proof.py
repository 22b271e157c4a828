"""Free runs of the machine as it was and of the repaired one over the field, and what they prove.

Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from actuators import open_loop
from actuators.scales import choose_horizon_s
from brokk_rl.commands import view_recordings
from diagnosis import sensors
from diagnosis.case import GapCase, select_rows
from diagnosis.closure import MIN_RESTORED, Estimate, Gap, Gate, RivalError
from diagnosis.engine.decide import Decider, EffectFinding, apply_findings
from diagnosis.engine.proof import Floor, list_windows, run_free
from diagnosis.engine.side import choose_stride, measure_units
from diagnosis.engine.sizes import SizedRow, fit_rows, size_finding
from diagnosis.free_runs import (
    BLOCK_WINDOWS,
    WindowedRuns,
    choose_unit,
    combine_joints,
    compute_shapley,
    draw_weights,
    summarise_draws,
)
from diagnosis.gates import MAX_RIVAL_RATIO
from diagnosis.rivals import measure_rivals

NOISE_FACTOR = 3.0
"""An error within so many deviations of the sensor's noise is none."""
SURE_QUANTILE = 0.95
"""An error grew for sure where it did so in this share of the bootstraps."""
STEP_ERROR = 0.02
"""Relative error of the step of a coarse sensor: the width of a peak in the transform."""
LEAST_GAP = 0.02
"""Least gap over the error, so that its share can be told where the floor nearly reaches it."""


class RepairProof(ABC):
    """Free runs over the field, cross-fitted in two halves, and their errors.

    Args:
        case: The recordings.
        findings: The named effects that act on the motion.
        num_windows: `W`.
        generator: Draws the bootstraps, the same ones for each proof of a diagnosis.
    """

    floor_of = "reference"

    def __init__(
        self,
        case: GapCase,
        findings: Sequence[EffectFinding],
        num_windows: int,
        generator: np.random.Generator,
    ) -> None:
        self.machine = case.machine
        self.findings = findings
        self.half = np.arange(num_windows) // BLOCK_WINDOWS % 2
        """Half of each window, `(W,)`; its sizes are those that were fitted to the other one."""
        self.weights = draw_weights(num_windows, deepcopy(generator))
        self._case = case
        self._effects = [one.effect for one in findings]
        self._runs: dict[frozenset[str], np.ndarray] = {}

    @property
    @abstractmethod
    def measured(self) -> np.ndarray:
        """Measured positions, `(W, K, J)`, rad or m."""

    @property
    @abstractmethod
    def floor_squares(self) -> np.ndarray:
        """Mean squares at the floor in each draw, `(1 + B, J)`."""

    @property
    def moves(self) -> bool:
        """True if a named effect acts on the free runs."""
        return bool(self._effects)

    @abstractmethod
    def view(self, paths: np.ndarray) -> WindowedRuns:
        """Return free runs beside the recordings of the field."""

    @abstractmethod
    def _simulate(self, effects: frozenset[str], half: int) -> np.ndarray:
        """Return free runs with some of the named effects, `(W, K, J)`, with the sizes for a half."""

    def run(self, effects: frozenset[str]) -> np.ndarray:
        """Return free runs with some of the named effects, each window with sizes of the other half."""
        if effects not in self._runs:
            is_first = self.half[:, None, None] == 0
            runs = [self._simulate(effects, half) for half in (0, 1)]
            self._runs[effects] = np.where(is_first, *runs)
        return self._runs[effects]

    @property
    def before(self) -> np.ndarray:
        """Free runs of the machine as it was, `(W, K, J)`."""
        return self.run(frozenset())

    @property
    def after(self) -> np.ndarray:
        """Free runs with all named effects."""
        return self.run(frozenset(self._effects))

    def measure_squares(self, paths: np.ndarray) -> np.ndarray:
        """Return mean squares of free runs in each draw, `(1 + B, J)`."""
        return self.weights @ np.square(paths - self.measured).mean(1)

    def measure_errors(self, paths: np.ndarray) -> np.ndarray:
        """Return the error of free runs in each draw, all joints together, `(1 + B,)`."""
        return combine_joints(self.measure_squares(paths), self.machine)

    def measure_gap(self, is_named: bool) -> Gap:
        """Return the errors and the share that is closed; 0 where only effects beside the motion are named."""
        before, after = self.measure_errors(self.before), self.measure_errors(self.after)
        floor = combine_joints(self.floor_squares, self.machine)
        closed = summarise_draws(self._share(before - after)) if is_named else None
        return Gap(
            before=float(before[0]),
            after=float(after[0]),
            floor=float(floor[0]),
            closed=closed,
            unit=choose_unit(self.machine),
            floor_of=self.floor_of,
            reduced=summarise_draws((before - after) / np.maximum(before, 1e-12)),
        )

    def _share(self, fewer: np.ndarray) -> np.ndarray:
        """Return differences of errors over the gap of the same draw, `(1 + B,)`."""
        before = self.measure_errors(self.before)
        floor = combine_joints(self.floor_squares, self.machine)
        return fewer / np.maximum(before - floor, LEAST_GAP * before)

    @cached_property
    def parts(self) -> dict[str, dict[str, Any]]:
        """Part of each effect: its Shapley value, what its removal restores, and how much of the error is then new."""
        every = frozenset(self._effects)
        before, after = self.measure_errors(self.before), self.measure_errors(self.after)
        values = compute_shapley(self._effects, lambda some: -self.measure_errors(self.run(some)))
        found = {}
        for name, fewer in values.items():
            reduced = summarise_draws(fewer / np.maximum(before, 1e-12))
            without = self.measure_errors(self.run(every - {name}))
            rise = summarise_draws((without - after) / np.maximum(before, 1e-12))
            needed = summarise_draws((without - after) / np.maximum(without, 1e-12))
            restored, identified = judge_edit(reduced, rise)
            edit = {"restored": restored, "reduced": reduced.mean, "rise_without": rise.mean}
            closed = summarise_draws(self._share(fewer))
            told = {"closed": closed, "identified": identified, "edit": edit}
            found[name] = {**told, "needed": needed}
        return found

    @cached_property
    def rivals(self) -> dict[str, RivalError]:
        """Errors of standing still and of an ARX on the field."""
        recordings = view_recordings(self._case.field, self.machine)
        horizon_s = choose_horizon_s(self.machine)
        cut = open_loop.cut_windows(recordings, self.machine, horizon_s, horizon_s)
        found = {}
        unit = choose_unit(self.machine)
        for name, squares in measure_rivals(cut).items():
            if squares is None:
                found[name] = RivalError(None, {}, unit)
                continue
            mean = squares.mean(0)
            joints = dict(zip(self.machine.joint_names, np.sqrt(mean).tolist(), strict=True))
            found[name] = RivalError(float(combine_joints(mean, self.machine)), joints, unit)
        return found

    def judge(self) -> list[Gate]:
        """Return whether the repaired simulator is of use on every named joint, without names on all.

        It errs less than standing still does, or hardly more than is foretold of the unchanged machine.
        """
        named = {j for one in self.findings for j in one.joints}
        joints = sorted(named or range(self.machine.num_joints))
        noise = sensors.estimate_sensor_noise(self._case.reference or self._case.field)
        after = np.sqrt(self.measure_squares(self.after)[0])
        usual = MAX_RIVAL_RATIO * np.sqrt(self.floor_squares[0])
        still = self.rivals["hold"].joints
        found = []
        for j in joints:
            name = self.machine.joint_names[j]
            # A joint that rests or hardly moves errs by its sensor and its friction either way.
            passed = bool(after[j] <= max(still[name], NOISE_FACTOR * noise[j], usual[j]))
            text = f"{name}: {after[j]:.3g} with the effects, {still[name]:.3g} standing still"
            found.append(Gate(f"beats_hold_{name}", passed, float(after[j]), still[name], text))
        if self.moves:
            found.append(self._judge_reduction())
        return found

    def _judge_reduction(self) -> Gate:
        """Return whether the repaired simulator may err less than the one as it was."""
        before, after = self.measure_errors(self.before), self.measure_errors(self.after)
        most = float(np.quantile(before - after, SURE_QUANTILE))
        text = f"free runs err by {after[0]:.3g} with the effects, by {before[0]:.3g} without"
        return Gate("reduces_error", most > 0.0, float(after[0]), float(before[0]), text)


def judge_edit(reduced: Estimate, rise: Estimate) -> tuple[float, bool]:
    """Return how much of an effect's part its removal restores, and whether this identifies it."""
    restored = rise.mean / reduced.mean if reduced.mean > 0.0 else 0.0
    return restored, rise.has_interval and rise.ci95[0] > 0.0 and restored >= MIN_RESTORED


class EngineProof(RepairProof):
    """The proof of what the engine decided: the machine as it was is a joint model fitted to the reference.

    Args:
        case: The recordings.
        decider: The engine that decided.
        findings: Its named effects, the best first.
        generator: Draws the bootstraps.
    """

    def __init__(
        self,
        case: GapCase,
        decider: Decider,
        findings: Sequence[EffectFinding],
        generator: np.random.Generator,
    ) -> None:
        evidence = decider.evidence
        horizon_s = choose_horizon_s(case.machine)
        self.windows = list_windows(evidence.field, horizon_s)
        super().__init__(case, findings, len(self.windows.first), generator)
        self._decider = decider
        self._field = evidence.field
        self._healthy = [base.numbers for base in evidence.bases]
        self.floor = Floor(evidence.reference, evidence.bases, horizon_s)
        self.sizes: dict[str, dict[int, SizedRow]] = {one.effect: {} for one in findings}
        """Rows of each effect in the registry's form, by joint."""
        self._fitted = self._fit(None)
        self._halves = [self._fit(self._list_used(half)) for half in (0, 1)]

    @property
    def measured(self) -> np.ndarray:
        """Measured positions, `(W, K, J)`, rad or m."""
        return self._field.q[self.windows.rows] * measure_units(self.machine)

    @property
    def moves(self) -> bool:
        """True if a named effect acts on the free runs; one that shows by itself need not."""
        return any(one.rows or one.hold for one in self.findings)

    @property
    def steps(self) -> dict[str, Estimate]:
        """Steps of coarse sensors, rad or m, by joint."""
        values = self._decider.evidence.steps * measure_units(self.machine)
        found = {}
        for name, step in zip(self.machine.joint_names, values.tolist(), strict=True):
            found[name] = Estimate(step, ((1.0 - STEP_ERROR) * step, (1.0 + STEP_ERROR) * step))
        return found

    def judge(self) -> list[Gate]:
        """Return the gates of all repairs, and one that fails for each simulated effect without a number in the library."""
        found = super().judge()
        for one in self.findings:
            # What shows by itself, such as a coarse sensor, was not simulated and has no number.
            if one.rows and not self.sizes[one.effect]:
                joints = ", ".join(self.machine.joint_names[j] for j in one.joints)
                text = f"{joints} moves as by {one.name}, which the library takes from the weight, and bears none"
                found.append(Gate("in_library", False, None, None, text))
        return found

    def _list_used(self, half: int) -> np.ndarray:
        """Return the samples outside the windows of a half, `(T,)` bool."""
        used = np.ones(self._field.num_samples, dtype=bool)
        used[self.windows.rows[self.half == half]] = False
        return used

    def _fit(self, used: np.ndarray | None) -> list[EffectFinding]:
        """Return the named effects with rows fitted one beside the others, to the samples `used`."""
        numbers, side = self._healthy, self._field
        found = []
        for finding in self.findings:
            fitted = finding
            if finding.hold is None:
                joints = self._decider.evidence.view_field(numbers, side, used)
                fitted = replace(finding, rows=fit_rows(finding, joints))
                if used is None:
                    self.sizes[finding.effect] = size_finding(finding, joints)
            found.append(fitted)
            numbers, side = apply_findings([fitted], numbers, side)
        return found

    def _simulate(self, effects: frozenset[str], half: int) -> np.ndarray:
        some = [one for one in self._halves[half] if one.effect in effects]
        numbers, side = apply_findings(some, self._healthy, self._field)
        return run_free(side, self.windows, numbers)

    @cached_property
    def floor_squares(self) -> np.ndarray:
        """Mean squares at the floor in each draw, `(1 + B, J)`."""
        numbers, side = apply_findings(self._fitted, self._healthy, self._field)
        joints = self._decider.evidence.view_field(numbers, side)
        return self.weights @ self.floor.foresee(self.windows, joints)

    def view(self, paths: np.ndarray) -> WindowedRuns:
        """Return free runs beside the recordings of the field, thinned out as the engine read them."""
        side, windows = self._field, self.windows
        stride = choose_stride(self.machine)
        thin = []
        for one in self._case.field:
            rows = slice(0, one.num_samples // stride * stride, stride)
            thin.append(select_rows(one, rows))
        source = np.searchsorted(side.starts, windows.first, "right") - 1
        row = windows.first + 1 - side.starts[source]
        return WindowedRuns(thin, source, row, paths, self.measured)
