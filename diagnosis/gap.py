"""The gap: errors of free runs before and after the repair, the floor, and the share that is closed.

All errors are those of free runs on parts of the recordings that the sizes were not fitted to; only
the predicted share comes from the parts that they were fitted to. The floor is that of the
unchanged machine under the field's own motion: see `motion_floor`.
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

from actuators import open_loop
from actuators.scales import choose_horizon_s
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import motion_floor
from diagnosis.baseline import Baseline
from diagnosis.bootstrap import draw_weights, summarise_draws
from diagnosis.case import estimate_running_s
from diagnosis.closure import Estimate, Gap, JointClosed
from diagnosis.detection import DetectionResult
from diagnosis.motion_floor import LeftOutErrors, collect_left_out
from diagnosis.refine import simulate_sizes
from diagnosis.residuals import to_increments

MIN_GAP_RATIO = 1.02
"""Error over floor from which there is a gap whose share is told. Its interval shows how surely:
the limit only keeps the denominator off 0. Chosen by hand; not searched."""
MIN_EXCESS_RATIO = 1.25
"""So many times the floor is more than what the simulator errs by anyway, where it exceeds the
floor for sure."""
MIN_CHANGE = 0.01
"""Change of free runs, over their error, from which an effect acts on a joint. Runs in batches of
another size differ by rounding of single precision, about a thousandth of that."""
NO_FLOOR = "there is no reference, and too little field for a flexible model: no floor is known"
NO_MOTION = (
    "the named effects act on sensors or on the tool: free runs of the joints do not show them"
)
"""Reasons why no share of the gap can be told."""


def choose_unit(machine: Machine) -> str:
    """Return the unit of errors of all joints together: that of the joints, or `travel`, the joint's, where they differ."""
    units = {joint.unit for joint in machine.joints}
    return units.pop() if len(units) == 1 else "travel"


def compute_joint_squares(paths: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the mean square error of each window and joint, `(W, J)`, in rad² or m²."""
    return np.square(paths - measured).mean(1)


def combine_joints(squares: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the root mean square over joints, `(…,)`, of mean squares `(…, J)`, in the unit of `choose_unit`."""
    size = machine.upper - machine.lower if choose_unit(machine) == "travel" else 1.0
    return np.sqrt((squares / np.square(size)).mean(-1))


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


@dataclass(frozen=True, eq=False)
class GapClosure:
    """Errors before, after and at the floor.

    Attributes:
        base: The simulator and its errors on the reference.
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
    def weights(self) -> np.ndarray:
        """Draws of windows, the same for all shares, `(1 + B, W)`: hard windows are hard before and after."""
        return draw_weights(len(self._measured), self.generator)

    @cached_property
    def before(self) -> np.ndarray:
        """Error of the simulator as it was, in each draw, `(1 + B,)`."""
        return self.errors(self.base.field.residuals.base)

    @cached_property
    def left_out(self) -> LeftOutErrors | None:
        """Errors on the reference, outside of the fit; `None` without any."""
        parts = [one.residuals for one in self.base.left_out]
        return collect_left_out(parts) if parts else None

    @cached_property
    def joint_floor(self) -> np.ndarray | None:
        """Mean squares at the floor in each draw, `(1 + B, J)`; `None` where it is unknown."""
        known, residuals = self.left_out, self.base.field.residuals
        if known is None or residuals.noise is None:
            return None
        if self.base.is_flexible:
            # These windows are of the field itself: their motion is the field's own.
            return draw_weights(len(known.actual), self.generator) @ known.actual
        increments = to_increments(self.after, residuals.start)
        return motion_floor.draw_floor(
            known, residuals.noise, increments, self.weights, self.generator
        )

    @cached_property
    def floor(self) -> np.ndarray | None:
        """Error at the floor in each draw, `(1 + B,)`; `None` where it is unknown."""
        return None if self.joint_floor is None else combine_joints(self.joint_floor, self.machine)

    @property
    def _measured(self) -> np.ndarray:
        return self.base.field.residuals.simulator.cut.measured

    def joint_squares(self, paths: np.ndarray) -> np.ndarray:
        """Return mean squares of free runs in each draw, `(1 + B, J)`."""
        return self.weights @ compute_joint_squares(paths, self._measured)

    def errors(self, paths: np.ndarray) -> np.ndarray:
        """Return the error of free runs in each draw, all joints together, `(1 + B,)`."""
        return combine_joints(self.joint_squares(paths), self.machine)

    @cached_property
    def has_gap(self) -> bool:
        """True if there is a floor, and errors that exceed it."""
        return self.floor is not None and bool(self.before[0] > MIN_GAP_RATIO * self.floor[0])

    @cached_property
    def is_repaired(self) -> bool:
        """True if the effects change the free runs of any joint."""
        return bool(self.moved.any())

    @cached_property
    def moved(self) -> np.ndarray:
        """Which joints' free runs the effects change by more than rounding, `(J,)` bool."""
        change = np.square(self.after - self.base.field.residuals.base).mean((0, 1))
        error = np.square(self.base.field.residuals.base - self._measured).mean((0, 1))
        return np.sqrt(change) > MIN_CHANGE * np.sqrt(error)

    def share_closed(self, fewer: np.ndarray) -> np.ndarray:
        """Return differences of errors `(1 + B,)` over the gap of the same draw."""
        assert self.floor is not None, "asked where there is a gap"
        # In a draw the gap may vanish.
        least = (1.0 - 1.0 / MIN_GAP_RATIO) * self.before
        return fewer / np.maximum(self.before - self.floor, least)

    def gap(self, named: bool = False) -> Gap:
        """Return the errors, all joints together and joint by joint; `named`: effects are named."""
        after = self.errors(self.after)
        closed, reason = None, self._find_obstacle(named)
        if not reason:
            closed = summarise_draws(self.share_closed(self.before - after))
        whose = "flexible model" if self.base.is_flexible else "reference"
        return Gap(
            before=float(self.before[0]),
            after=float(after[0]),
            floor=None if self.floor is None else float(self.floor[0]),
            closed=closed,
            unit=choose_unit(self.machine),
            floor_of="" if self.floor is None else whose,
            joints=self._joints(),
            reduced=summarise_draws((self.before - after) / np.maximum(self.before, 1e-12)),
            closed_reason=reason,
        )

    def _find_obstacle(self, named: bool) -> str:
        """Return why no share of the gap can be told; empty where it can."""
        if self.floor is None:
            return NO_FLOOR
        if named and not self.is_repaired:
            return NO_MOTION
        if not self.has_gap:
            return (
                f"the error ({self.before[0]:.3g}) is not above what the unchanged machine "
                f"would show under this motion ({self.floor[0]:.3g})"
            )
        return ""

    def foretold(self) -> Estimate | None:
        """Return the share that should be closed, as the parts that were fitted to say; `None` without a gap or a fit."""
        if not self.has_gap or self.own is None:
            return None
        return summarise_draws(self.share_closed(self.before - self.errors(self.own)))

    def beyond(self) -> list[str]:
        """Return the joints whose error after repair exceeds the floor for sure."""
        if self.joint_floor is None:
            return []
        ratio = np.sqrt(self.joint_squares(self.after) / np.maximum(self.joint_floor, 1e-18))
        low = np.quantile(ratio[1:], 0.025, axis=0)
        beyond = (ratio[0] > MIN_EXCESS_RATIO) & (low > 1.0)
        return [self.machine.joint_names[j] for j in np.flatnonzero(beyond)]

    def measure_reference(self) -> dict[str, Any] | None:
        """Return the error over the reference's own excitation, plain JSON data; `None` without a reference."""
        if self.left_out is None:
            return None
        squares = self.left_out.actual.mean(0)
        joints = dict(zip(self.machine.joint_names, np.sqrt(squares).tolist(), strict=True))
        name = f"rmse_{choose_unit(self.machine)}"
        return {name: float(combine_joints(squares, self.machine)), "joints": joints}

    def _joints(self) -> dict[str, JointClosed]:
        before, after = (
            np.sqrt(self.joint_squares(paths)[0])
            for paths in (self.base.field.residuals.base, self.after)
        )
        floor = None if self.joint_floor is None else np.sqrt(self.joint_floor[0])
        return describe_joints(self.machine, before, after, floor)


def evaluate_unseen(
    result: DetectionResult, recordings: Sequence[Recording], machine: Machine
) -> dict[str, Any]:
    """Return how far the effects carry on recordings that nothing was fitted to, as plain JSON data.

    Raises:
        RecordingError: no recording is long enough.
    """
    assert result.fitted is not None, "there is something to carry"
    begun, horizon_s = estimate_running_s(recordings), choose_horizon_s(machine)
    cuts, running = [], []
    for one, at in zip(recordings, begun, strict=True):
        if _is_long(one, machine):
            cuts.append(open_loop.cut_windows([one], machine, horizon_s, horizon_s))
            running.append(at)
    cut = (
        open_loop.join_windows(cuts)
        if cuts
        else open_loop.cut_windows(recordings, machine, horizon_s, horizon_s)
    )
    running_at = np.repeat(running, [len(one.q) for one in cuts])
    simulator = replace(result.residuals.simulator, cut=cut, running_s=running_at)
    none = simulate_sizes(simulator, result.fitted.rays, 0.0 * result.fitted.sizes[None])[0]
    paths = simulate_sizes(simulator, result.fitted.rays, result.fitted.sizes[None])[0]
    before, after = (_compute_joint_rmse([one], [cut.measured]) for one in (none, paths))
    joints = {
        name: vars(one) for name, one in describe_joints(machine, before, after, None).items()
    }
    return {"seconds": horizon_s * len(cut.q), "recordings": len(cuts), "joints": joints}


def _is_long(recording: Recording, machine: Machine) -> bool:
    longest_s = open_loop.find_longest_horizon_s([recording], machine)
    return longest_s > choose_horizon_s(machine) - 0.5 * machine.period_s


def _compute_joint_rmse(paths: Sequence[np.ndarray], measured: Sequence[np.ndarray]) -> np.ndarray:
    """Return the root mean square error of each joint, `(J,)`."""
    pairs = zip(paths, measured, strict=True)
    squares = [np.square(one - other).mean(1) for one, other in pairs]
    return np.sqrt(np.concatenate(squares).mean(0))


def describe_joints(
    machine: Machine, before: np.ndarray, after: np.ndarray, floor: np.ndarray | None
) -> dict[str, JointClosed]:
    """Return errors `(J,)` before, after and at the floor, joint by joint."""
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
