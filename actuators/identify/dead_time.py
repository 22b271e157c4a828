"""Dead time of each joint: the delay at which a model of its kind of command explains the motion best.

A command that sets a speed or a force is held against the speed or its change by a static curve. The lag
of spool and oil counts as delay there (at 20 Hz the two can hardly be told apart), so this is the total
that a controller has to look ahead, not the time to first motion. A target is followed by a second-order
loop, whose own lag is no delay: for each delay the best loop is found by free-run simulation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.signal import lfilter

from actuators.identify.signals import delay_signal, discretise_loop
from actuators.recordings.split import group_by_run
from brokk_rl.commands import read_targets
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

KNOTS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.7)
"""Commands at which the static curve bends, on either side."""
RESOLUTION_S = 0.01
"""Step of the delays that are tried, s. Chosen by hand; not searched."""
LONGEST_S = 1.0
"""Longest delay searched for; more than the history of any model here, so that a history too short
shows."""
SMOOTHING = np.hanning(11)[1:-1] / np.hanning(11).sum()
"""Applied to command curve and motion alike. Without it a delay between samples, which averages two
commands, would be preferred because averaging looks like the valve's lag."""
AT_STOP = 0.005
"""A joint this close to its stop, as a part of its travel, tells nothing about the delay."""
RESAMPLED = 200
"""Bootstrap resamples over runs. Chosen by hand; not searched."""
MIN_MOVING = 100
"""Samples with a command, in all recordings together, below which no delay is estimated."""

MIN_CHANGES = 5
"""Changes of a target, in all recordings together, below which no delay is estimated."""
FREQUENCIES_RAD_S = np.geomspace(1.0, 300.0, 20)
"""Natural frequencies of the position loops that are tried: from 0.16 Hz to a loop that is at its target at once."""
DAMPINGS = (0.2, 0.4, 0.7, 1.0, 1.5, 2.5)
LOOPS = [(float(w), damping) for w, damping in product(FREQUENCIES_RAD_S, DAMPINGS)]
"""Frequencies and damping ratios. Refining the best ones made delays of 60 servos worse: 7 ms off instead of 4."""
MOST_ROWS = 3000
"""Rows of a recording that are simulated: a minute at 50 Hz fixes a delay to a hundredth of a period."""


@dataclass(frozen=True)
class DeadTimeEstimate:
    """A dead time with its interval.

    Attributes:
        value_s: Best delay.
        ci95_s: 95 % interval from resampling whole runs; at least the two neighbours in resolution.
        explained: Part of the variance of the increments that the delayed static curve explains; for a
            target, that of the positions.
        is_found: False where the best delay is the longest tried: it may be longer, or not exist.
    """

    value_s: float
    ci95_s: tuple[float, float]
    explained: float
    is_found: bool

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return {
            "value": self.value_s, "ci95": list(self.ci95_s), "explained": self.explained, "found": self.is_found
        }  # fmt: skip


def estimate_dead_times(
    recordings: Sequence[Recording], machine: Machine, generator: np.random.Generator
) -> dict[str, DeadTimeEstimate | None]:
    """Return the dead time of each joint; `None` for a joint that is hardly commanded.

    Raises:
        RecordingError: no recording is long enough to search in.
    """
    usable = [recording for recording in recordings if recording.duration_s > 2.0 * LONGEST_S]
    if not usable:
        raise RecordingError(f"too little data: no recording is longer than {2.0 * LONGEST_S:g} s")
    runs = list(group_by_run(usable).values())
    grid_s = np.arange(0.0, LONGEST_S + 1e-9, RESOLUTION_S)
    search = _search_loops if machine.interface == "position" else _search_curves
    estimates = {}
    for joint, name in enumerate(machine.joint_names):
        found = search(runs, joint, grid_s, machine)
        estimates[name] = found and _bound_delay(grid_s, *found, generator)
    return estimates


def _bound_delay(
    grid_s: np.ndarray,
    left: np.ndarray,
    total: float,
    resolution_s: float,
    generator: np.random.Generator,
) -> DeadTimeEstimate:
    """Return the best delay with its interval.

    Args:
        grid_s: Delays that were tried, `(D,)`.
        left: Sum of squares that each leaves of each run, `(R, D)`.
        total: Sum of squares of all runs.
        resolution_s: No interval is narrower.
        generator: Draws the resamples.
    """
    best = int(left.sum(0).argmin())
    picks = generator.integers(len(left), size=(RESAMPLED, len(left)))
    low, high = np.percentile(grid_s[left[picks].sum(1).argmin(1)], (2.5, 97.5))
    value_s = float(grid_s[best])
    low_s, high_s = value_s - 0.5 * resolution_s, value_s + 0.5 * resolution_s
    interval_s = float(max(0.0, min(low, low_s))), float(max(high, high_s))
    explained = float(1.0 - left.sum(0)[best] / total)
    return DeadTimeEstimate(value_s, interval_s, explained, is_found=best < len(grid_s) - 1)


def _search_loops(
    runs: Sequence[Sequence[Recording]], joint: int, grid_s: np.ndarray, machine: Machine
) -> tuple[np.ndarray, float, float] | None:
    """Return what the best loop behind each delay leaves, `(R, D)`, of what in all, and the resolution, s.

    `None` for a joint whose targets hardly change.
    """
    pairs, source = [], []
    for number, several in enumerate(runs):
        for one in several:
            target = read_targets(one.u.astype(float), machine)[:, joint]
            pairs.append((target[:MOST_ROWS], one.q[:MOST_ROWS, joint].astype(float)))
            source.append(number)
    if sum(int((np.diff(target) != 0).sum()) for target, _ in pairs) < MIN_CHANGES:
        return None
    loops = ServoLoops(pairs, machine.period_s, grid_s)
    left = np.zeros((len(runs), len(grid_s)))
    np.add.at(left, source, loops.search()[1])
    total = sum(float(((q - q.mean()) ** 2).sum()) for _, q in pairs)
    return left, total, max(RESOLUTION_S, loops.step_s)


class ServoLoops:
    """Free-run simulations of second-order loops behind a delay, each with the best gain and offset.

    Args:
        pairs: Targets and positions of each recording.
        period_s: Period of the recordings.
        grid_s: Delays to try.
    """

    def __init__(
        self, pairs: Sequence[tuple[np.ndarray, np.ndarray]], period_s: float, grid_s: np.ndarray
    ) -> None:
        self._pairs = pairs
        self._num_steps = max(1, round(period_s / RESOLUTION_S))
        self.step_s = period_s / self._num_steps
        self._shifts = np.round(grid_s / self.step_s).astype(int)

    def search(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the number of the best loop at each delay, `(D,)`, and the sums of squares that it leaves, `(R, D)`."""
        tried = np.stack([self._simulate(loop) for loop in LOOPS])
        best = tried.sum(1).argmin(0)
        return best, tried[best, :, np.arange(len(best))].T

    def list_loops(self) -> list[tuple[int, float, float]]:
        """Return numbers of delays with frequency, rad/s, and damping ratio of their best loop, the best first."""
        best, left = self.search()
        order = np.argsort(left.sum(0), kind="stable")
        return [(int(delay), *LOOPS[best[delay]]) for delay in order]

    def _simulate(self, loop: tuple[float, float]) -> np.ndarray:
        """Return what a loop of a frequency and a damping ratio leaves at each delay, `(R, D)`."""
        numerator, denominator = discretise_loop(*loop, self.step_s)
        left = np.empty((len(self._pairs), len(self._shifts)))
        longest = int(self._shifts.max())
        for row, (target, q) in enumerate(self._pairs):
            fine = np.repeat(target - target[0], self._num_steps)
            reached = np.concatenate([np.zeros(longest), lfilter(numerator, denominator, fine)])
            places = np.arange(len(q)) * self._num_steps + longest
            late = reached[places - self._shifts[:, None]]
            late -= late.mean(1, keepdims=True)
            y = q - q.mean()
            gained = (late @ y) ** 2 / np.maximum((late**2).sum(1), 1e-12)
            left[row] = np.maximum(y @ y - gained, 0.0)
        return left


def _search_curves(
    runs: Sequence[Sequence[Recording]], joint: int, grid_s: np.ndarray, machine: Machine
) -> tuple[np.ndarray, float, float] | None:
    """Return what the best curve behind each delay leaves, `(R, D)`, of what in all, and the resolution, s.

    `None` for a joint that is hardly commanded.
    """
    commanded, found = 0, []
    for several in runs:
        counts = [int((np.abs(one.u[:, joint]) > KNOTS[1]).sum()) for one in several]
        commanded += sum(counts)
        if any(counts):
            parts = [_compute_moments(one, joint, grid_s, machine) for one in several]
            found.append(np.sum(parts, 0))
    if commanded < MIN_MOVING:
        return None
    moments = np.stack(found)  # (R, D, F + 1, F + 1)
    gram, cross, total = moments[..., :-1, :-1], moments[..., :-1, -1], moments[..., -1, -1]
    every = gram.sum(0)
    ridge = 1e-6 * np.trace(every, axis1=1, axis2=2)[:, None, None] / every.shape[1] + 1e-12
    curve = np.linalg.solve(every + ridge * np.eye(every.shape[1]), cross.sum(0)[..., None])[..., 0]
    by_curve = np.einsum("di,rdij,dj->rd", curve, gram, curve)
    left = total - 2.0 * np.einsum("di,rdi->rd", curve, cross) + by_curve
    best = int(left.sum(0).argmin())
    return left, float(total[:, best].sum()), RESOLUTION_S


def _compute_moments(
    recording: Recording, joint: int, grid_s: np.ndarray, machine: Machine
) -> np.ndarray:
    """Return moments of curve features and increment per delay, `(D, F + 1, F + 1)`."""
    u, q = recording.u[:, joint].astype(np.float64), recording.q[:, joint].astype(np.float64)
    knots, reach = np.array(KNOTS), int(LONGEST_S / machine.period_s) + 1
    sides = [np.maximum(sign * u[:, None] - knots, 0.0) for sign in (1.0, -1.0)]
    curve = np.concatenate(sides, 1)[:-1]
    curve = np.stack([np.convolve(feature, SMOOTHING, mode="valid") for feature in curve.T], 1)
    moved = np.convolve(np.diff(q), SMOOTHING, mode="valid")
    margin = AT_STOP * (machine.upper[joint] - machine.lower[joint])
    stopped = (q[:-1] < machine.lower[joint] + margin) | (q[:-1] > machine.upper[joint] - margin)
    # A stop ends the motion before the command does.
    free = np.convolve(stopped, np.ones(len(SMOOTHING)), mode="valid") < 0.5
    now = np.flatnonzero(free[reach:]) + reach
    found = []
    for delay_s in grid_s:
        delayed = delay_signal(curve, delay_s / machine.period_s)[now]
        features = np.concatenate([delayed, moved[now, None]], 1)
        found.append(features.T @ features)
    return np.stack(found)
