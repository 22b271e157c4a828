"""The gap: errors of free runs before and after the repair, the floor, and the share that is closed.

All errors are those of free runs on parts of the recordings that the sizes were not fitted to; only
the predicted share comes from the parts that they were fitted to.
Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np

from brokk_rl import open_loop
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import Estimate, Gap, JointClosed
from diagnosis.baseline import Baseline
from diagnosis.case import HORIZON_S, estimate_running_s
from diagnosis.detection import DetectionResult
from diagnosis.refine import simulate_refit, simulate_sizes

NUM_DRAWS = 1000
BLOCK_WINDOWS = 4
"""Windows in a row that are drawn together: poses and oil change slowly."""
MIN_GAP_RATIO = 1.1
"""Error over floor below which there is no gap whose share could be told."""


def choose_unit(machine: Machine) -> str:
    """Return the unit of errors of all joints together: that of the joints, or `travel`, the joint's, where they differ."""
    units = {joint.unit for joint in machine.joints}
    return units.pop() if len(units) == 1 else "travel"


def compute_squares(paths: np.ndarray, measured: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the mean square error of each window, all joints together, `(W,)`, in the square of `choose_unit`."""
    size = machine.upper - machine.lower if choose_unit(machine) == "travel" else 1.0
    return np.square((paths - measured) / size).mean((1, 2))


def draw_windows(
    field: int, floor: int, generator: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return windows of field and floor in bootstraps over blocks, as many as each has."""
    return [
        (_draw_blocks(field, generator), _draw_blocks(floor, generator)) for _ in range(NUM_DRAWS)
    ]


def compute_shares(
    before: np.ndarray,
    after: np.ndarray,
    floor: np.ndarray,
    drawn: Sequence[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Return the share of the gap that is closed, then the same of each draw, `(1 + B,)`."""
    found = [_compute_share(compute_rmse(before), compute_rmse(after), compute_rmse(floor))]
    # Before and after share the windows of a draw: hard windows are hard for both.
    for f, g in drawn:
        errors = (compute_rmse(before[f]), compute_rmse(after[f]), compute_rmse(floor[g]))
        found.append(_compute_share(*errors))
    return np.array(found)


def summarise_draws(values: np.ndarray) -> Estimate:
    """Return the first of values `(1 + B,)` with the 95 % interval of the others."""
    low, high = np.nanquantile(values[1:], [0.025, 0.975])
    return Estimate(float(values[0]), (float(min(low, values[0])), float(max(high, values[0]))))


def compute_rmse(square: np.ndarray) -> float:
    """Return the root of the mean over windows."""
    return float(np.sqrt(square.mean()))


def estimate_closed(
    before: np.ndarray, after: np.ndarray, floor: np.ndarray, generator: np.random.Generator
) -> Estimate | None:
    """Return the share of the gap that is closed, with the interval of a bootstrap over blocks of windows.

    Args:
        before: Mean square errors of field windows, `(W,)`.
        after: The same after repair.
        floor: Of reference windows.
        generator: Draws the blocks.
    """
    if compute_rmse(before) < MIN_GAP_RATIO * compute_rmse(floor):
        return None
    return summarise_draws(
        compute_shares(before, after, floor, draw_windows(len(before), len(floor), generator))
    )


def compute_shapley(
    names: Sequence[str], closed_by: Callable[[frozenset[str]], Any]
) -> dict[str, Any]:
    """Return the Shapley value of each effect, a number or an array: its mean contribution over all orders of adding."""
    count, found = len(names), dict.fromkeys(names, 0.0)
    value = {}
    for size in range(count + 1):
        for some in combinations(names, size):
            value[frozenset(some)] = closed_by(frozenset(some))
    for name in names:
        for size in range(count):
            chance = factorial(size) * factorial(count - size - 1) / factorial(count)
            for rest in combinations([n for n in names if n != name], size):
                found[name] += chance * (value[frozenset(rest) | {name}] - value[frozenset(rest)])
    return found


def _compute_share(before: float, after: float, floor: float) -> float:
    # No repair is better than the floor: where it is, the floor comes from harder recordings.
    floor = min(floor, after)
    return float((before - after) / max(before - floor, 0.02 * before + 1e-12))


def _draw_blocks(count: int, generator: np.random.Generator) -> np.ndarray:
    starts = generator.integers(
        0, max(1, count - BLOCK_WINDOWS + 1), size=-(-count // BLOCK_WINDOWS)
    )
    return np.concatenate([np.arange(start, min(start + BLOCK_WINDOWS, count)) for start in starts])


MIN_EXCESS_RATIO = 1.25
"""So many times the floor is more than what the simulator errs by anyway, where it exceeds the
floor for sure."""


@dataclass(frozen=True, eq=False)
class GapClosure:
    """Errors before, after and at the floor.

    Attributes:
        base: The simulator and its floor.
        machine: The machine.
        after: Free runs with the effects, `(W, K, J)`; those without where none was found.
        own: The same with sizes fitted to the window's own half; `None` where none were fitted.
        generator: Draws the bootstraps.
    """

    base: Baseline
    machine: Machine
    after: np.ndarray
    own: np.ndarray | None
    generator: np.random.Generator

    @cached_property
    def before(self) -> np.ndarray:
        """Mean square errors of the simulator as it was, `(W,)`."""
        residuals = self.base.field.residuals
        return compute_squares(residuals.base, self._measured, self.machine)

    @cached_property
    def floor(self) -> np.ndarray | None:
        """Mean square errors at the floor, by window; `None` where it is unknown."""
        if not self.base.left_out:
            return None
        squares = []
        for one in self.base.left_out:
            measured = one.residuals.simulator.cut.measured
            squares.append(compute_squares(one.residuals.base, measured, self.machine))
        return np.concatenate(squares)

    @cached_property
    def draws(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Windows of each bootstrap, the same for all shares."""
        return draw_windows(len(self.before), len(self._floor), self.generator)

    @property
    def _measured(self) -> np.ndarray:
        return self.base.field.residuals.simulator.cut.measured

    @property
    def _floor(self) -> np.ndarray:
        """The floor, or 0 where it is unknown."""
        return np.zeros(1) if self.floor is None else self.floor

    def shares(self, paths: np.ndarray) -> np.ndarray:
        """Return the share of the gap that free runs close, then the same of each draw, `(1 + B,)`."""
        return compute_shares(
            self.before,
            compute_squares(paths, self._measured, self.machine),
            self._floor,
            self.draws,
        )

    @cached_property
    def has_gap(self) -> bool:
        """True if there is a floor, and errors that exceed it."""
        return self.floor is not None and compute_rmse(self.before) >= MIN_GAP_RATIO * compute_rmse(
            self.floor
        )

    def gap(self) -> Gap:
        """Return the errors, all joints together and joint by joint."""
        left = compute_squares(self.after, self._measured, self.machine)
        closed = summarise_draws(self.shares(self.after)) if self.has_gap else None
        floor = None if self.floor is None else compute_rmse(self.floor)
        of = "" if floor is None else "flexible model" if self.base.is_flexible else "reference"
        return Gap(
            compute_rmse(self.before),
            compute_rmse(left),
            floor,
            closed,
            choose_unit(self.machine),
            of,
            self._joints(),
        )

    def foretold(self) -> Estimate | None:
        """Return the share that should be closed, as the parts that were fitted to say; `None` without a gap or a fit."""
        return (
            summarise_draws(self.shares(self.own))
            if self.has_gap and self.own is not None
            else None
        )

    def by_effect(self, result: DetectionResult, names: Sequence[str]) -> dict[str, Estimate]:
        """Return the share that each chosen effect closes, its Shapley value; without a floor, that of the whole error."""
        values = compute_shapley(names, lambda some: self.shares(self._with(result, some)))
        return {name: summarise_draws(value) for name, value in values.items()}

    def beyond(self) -> list[str]:
        """Return the joints whose error after repair exceeds the floor for sure."""
        if self.floor is None:
            return []
        left = np.square(self.after - self._measured).mean(1)  # (W, J)
        squares, drawn = [], []
        for one in self.base.left_out:
            error = one.residuals.base - one.residuals.simulator.cut.measured
            squares.append(np.square(error).mean(1))
        floor = np.concatenate(squares)
        for f, g in self.draws:
            drawn.append(np.sqrt(left[f].mean(0) / np.maximum(floor[g].mean(0), 1e-18)))
        ratio = np.sqrt(left.mean(0) / np.maximum(floor.mean(0), 1e-18))
        beyond = (ratio > MIN_EXCESS_RATIO) & (np.quantile(drawn, 0.025, axis=0) > 1.0)
        return [self.machine.joint_names[j] for j in np.flatnonzero(beyond)]

    def _with(self, result: DetectionResult, names: frozenset[str]) -> np.ndarray:
        """Return free runs with some of the chosen effects, their sizes fitted anew."""
        if not names:
            return self.base.field.residuals.base
        if names == result.chosen.names:
            return self.after
        subsets = [subset & names for subset in result.chosen.subsets]
        start = [table.score(s).sizes for table, s in zip(result.tables, subsets, strict=True)]
        return simulate_refit(result.residuals, subsets, result.rays, start)

    def _joints(self) -> dict[str, JointClosed]:
        residuals = self.base.field.residuals
        before = _compute_joint_rmse([residuals.base], [self._measured])
        after = _compute_joint_rmse([self.after], [self._measured])
        floor = None
        if parts := [one.residuals for one in self.base.left_out]:
            measured = [one.simulator.cut.measured for one in parts]
            floor = _compute_joint_rmse([one.base for one in parts], measured)
        return _describe_joints(self.machine, before, after, floor)


def evaluate_unseen(
    result: DetectionResult, recordings: Sequence[Recording], machine: Machine
) -> dict[str, Any]:
    """Return how far the effects carry on recordings that nothing was fitted to, as plain JSON data.

    Raises:
        RecordingError: no recording is long enough.
    """
    assert result.fitted is not None, "there is something to carry"
    begun = estimate_running_s(recordings)
    cuts, running = [], []
    for one, at in zip(recordings, begun, strict=True):
        if _is_long(one, machine):
            cuts.append(open_loop.cut_windows([one], machine, HORIZON_S, HORIZON_S))
            running.append(at)
    cut = (
        open_loop.join_windows(cuts)
        if cuts
        else open_loop.cut_windows(recordings, machine, HORIZON_S, HORIZON_S)
    )
    running_at = np.repeat(running, [len(one.q) for one in cuts])
    simulator = replace(result.residuals.simulator, cut=cut, running_s=running_at)
    none = simulate_sizes(simulator, result.fitted.rays, 0.0 * result.fitted.sizes[None])[0]
    paths = simulate_sizes(simulator, result.fitted.rays, result.fitted.sizes[None])[0]
    before, after = (_compute_joint_rmse([one], [cut.measured]) for one in (none, paths))
    joints = {
        name: vars(one) for name, one in _describe_joints(machine, before, after, None).items()
    }
    return {"seconds": HORIZON_S * len(cut.q), "recordings": len(cuts), "joints": joints}


def _is_long(recording: Recording, machine: Machine) -> bool:
    return open_loop.find_longest_horizon_s([recording], machine) >= HORIZON_S


def _compute_joint_rmse(paths: Sequence[np.ndarray], measured: Sequence[np.ndarray]) -> np.ndarray:
    """Return the root mean square error of each joint, `(J,)`."""
    pairs = zip(paths, measured, strict=True)
    squares = [np.square(one - other).mean(1) for one, other in pairs]
    return np.sqrt(np.concatenate(squares).mean(0))


def _describe_joints(
    machine: Machine, before: np.ndarray, after: np.ndarray, floor: np.ndarray | None
) -> dict[str, JointClosed]:
    found = {}
    for j, name in enumerate(machine.joint_names):
        least = None if floor is None else float(floor[j])
        above = (
            None
            if least is None or before[j] < MIN_GAP_RATIO * least
            else (before[j] - after[j]) / (before[j] - least)
        )
        share = float(1.0 - after[j] / max(before[j], 1e-12))
        found[name] = JointClosed(
            float(before[j]), float(after[j]), least, share, None if above is None else float(above)
        )
    return found
