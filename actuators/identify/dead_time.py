"""Dead time of each joint: the delay at which a static curve explains the motion best.

The lag of spool and oil counts as delay here (at 20 Hz the two can hardly be told apart), so this
is the total that a controller has to look ahead, not the time to first motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from actuators.recordings.split import group_by_run
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


@dataclass(frozen=True)
class DeadTimeEstimate:
    """A dead time with its interval.

    Attributes:
        value_s: Best delay.
        ci95_s: 95 % interval from resampling whole runs; at least the two neighbours in resolution.
        explained: Part of the variance of the increments that the delayed static curve explains.
        tried_s: Delays that were tried, shape `(D,)`.
        left: Part of the variance that each of them leaves unexplained, shape `(D,)`.
    """

    value_s: float
    ci95_s: tuple[float, float]
    explained: float
    tried_s: np.ndarray
    left: np.ndarray

    @property
    def is_found(self) -> bool:
        """False where the best delay is the longest tried: it may be longer, or not exist."""
        return self.value_s < float(self.tried_s[-1]) - RESOLUTION_S / 2


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
    grid_s = np.arange(0.0, LONGEST_S + 1e-9, RESOLUTION_S)
    estimates = {}
    for joint, name in enumerate(machine.joint_names):
        estimates[name] = _estimate_dead_time(usable, joint, grid_s, machine, generator)
    return estimates


def _estimate_dead_time(
    recordings: Sequence[Recording],
    joint: int,
    grid_s: np.ndarray,
    machine: Machine,
    generator: np.random.Generator,
) -> DeadTimeEstimate | None:
    moving = []
    for recording in recordings:
        if (np.abs(recording.u[:, joint]) > KNOTS[1]).any():
            moving.append(recording)
    if (
        sum(int((np.abs(recording.u[:, joint]) > KNOTS[1]).sum()) for recording in moving)
        < MIN_MOVING
    ):
        return None
    runs = group_by_run(moving).values()
    # (R, D, F + 1, F + 1)
    moments = np.stack(
        [
            np.sum([_compute_moments(part, joint, grid_s, machine) for part in parts], 0)
            for parts in runs
        ]
    )
    value = _find_best_delay(moments.sum(0))
    picks = (generator.integers(len(moments), size=len(moments)) for _ in range(RESAMPLED))
    again = grid_s[[_find_best_delay(moments[pick].sum(0)) for pick in picks]]
    low, high = np.percentile(again, (2.5, 97.5))
    total = moments.sum(0)
    left = _compute_residual(total) / total[:, -1, -1]
    interval = (
        max(0.0, min(low, grid_s[value] - RESOLUTION_S / 2)),
        max(high, grid_s[value] + RESOLUTION_S / 2),
    )
    return DeadTimeEstimate(
        float(grid_s[value]),
        (float(interval[0]), float(interval[1])),
        float(1.0 - left[value]),
        grid_s,
        left,
    )


def _compute_moments(
    recording: Recording, joint: int, grid_s: np.ndarray, machine: Machine
) -> np.ndarray:
    """Return moments of curve features and increment per delay, `(D, F + 1, F + 1)`."""
    u, q = recording.u[:, joint].astype(np.float64), recording.q[:, joint].astype(np.float64)
    knots, reach = np.array(KNOTS), int(LONGEST_S / machine.period_s) + 1
    curve = np.concatenate(
        [np.maximum(u[:, None] - knots, 0.0), np.maximum(-u[:, None] - knots, 0.0)], 1
    )[:-1]
    curve = np.stack([np.convolve(feature, SMOOTHING, mode="valid") for feature in curve.T], 1)
    moved = np.convolve(np.diff(q), SMOOTHING, mode="valid")
    margin = AT_STOP * (machine.upper[joint] - machine.lower[joint])
    stopped = (q[:-1] < machine.lower[joint] + margin) | (q[:-1] > machine.upper[joint] - margin)
    # A stop ends the motion before the command does.
    free = np.convolve(stopped, np.ones(len(SMOOTHING)), mode="valid") < 0.5
    now = np.flatnonzero(free[reach:]) + reach
    found = []
    for delay_s in grid_s:
        whole, part = divmod(delay_s / machine.period_s + 1e-9, 1.0)
        back = int(whole)
        # The command changes inside the period.
        delayed = part * curve[now - back - 1] + (1.0 - part) * curve[now - back]
        features = np.concatenate([delayed, moved[now, None]], 1)
        found.append(features.T @ features)
    return np.stack(found)


def _compute_residual(moments: np.ndarray) -> np.ndarray:
    """Return the sum of squares that the best curve leaves, for each delay, shape `(D,)`."""
    gram, cross, total = moments[:, :-1, :-1], moments[:, :-1, -1], moments[:, -1, -1]
    ridge = 1e-6 * np.trace(gram, axis1=1, axis2=2)[:, None, None] / gram.shape[1] + 1e-12
    weight = np.linalg.solve(gram + ridge * np.eye(gram.shape[1]), cross[..., None])[..., 0]
    return total - 2.0 * (weight * cross).sum(1) + np.einsum("di,dij,dj->d", weight, gram, weight)


def _find_best_delay(moments: np.ndarray) -> int:
    return int(np.argmin(_compute_residual(moments)))
