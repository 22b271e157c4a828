"""What single starts and stops show: how much the lateness of starts varies, and how much a joint rings after stops.

Lateness: what the simulator is ahead by shortly after a start, over its speed then. Ringing: how
much the measured position shakes
after stops, beyond the noise at rest. Axes: `W` windows, `K` steps.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns
from diagnosis.occasions import REGIMES, SHORTLY_S, in_force, regimes

SLOWEST = 0.1
"""Starts slower than this part of the full speed tell no time."""
FEWEST = 8
MAD = 1.4826
"""Median absolute deviation to standard deviation."""


def figures(
    runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray
) -> dict[tuple[str, str], tuple[float, float]]:
    """Returns the spread of the lateness of starts (s) as `delay_jitter` and ringing (rad or m) as `compliance`, by joint.

    Each with its standard error; joints with fewer than `FEWEST` starts or stops are left out.
    """
    acting = [in_force(r.u, dead_time_s, 1.0 / r.rate_hz) for r in runs.recordings]
    label = [
        regimes(u, r.q, machine, r.rate_hz) for u, r in zip(acting, runs.recordings, strict=True)
    ]
    found = {}
    for j, name in enumerate(machine.joint_names):
        late_s = np.array(list(_lateness(runs, runs.cut(label)[..., j], j, machine)))
        if len(late_s) >= FEWEST:
            off = MAD * np.abs(late_s - np.median(late_s))
            found["delay_jitter", name] = (
                float(np.median(off)),
                float(off.std() / np.sqrt(len(off))),
            )
        shaken = np.array(list(_ringing(runs, [part[:, j] for part in label], j)))
        if len(shaken) >= FEWEST:
            found["compliance", name] = (
                float(np.median(shaken)),
                float(MAD * shaken.std() / np.sqrt(len(shaken))),
            )
    return found


def _lateness(
    runs: WindowedRuns, label: np.ndarray, joint: int, machine: Machine
) -> Iterator[float]:
    """Yields for each start within a window how much later the machine moves, s."""
    ahead = round(SHORTLY_S / machine.period_s)
    is_start = label == REGIMES.index("start")
    error, path = runs.error[..., joint], runs.simulated[..., joint]
    for window, begin in zip(*np.nonzero(is_start[:, 1:] & ~is_start[:, :-1]), strict=True):
        end = begin + ahead
        if end >= error.shape[1] or not is_start[window, begin + 1 : end].all():
            continue
        speed = (path[window, end] - path[window, end - ahead // 3]) / (
            ahead // 3 * machine.period_s
        )
        late_s = (
            (error[window, end] - error[window, begin]) / speed
            if abs(speed) > SLOWEST * machine.max_speed[joint]
            else np.nan
        )
        if np.isfinite(late_s):
            yield float(late_s)


def _ringing(runs: WindowedRuns, label: list[np.ndarray], joint: int) -> Iterator[float]:
    """Yields for each stop how much the measured position swings about a straight line in the second half of the time after."""
    for recording, regime in zip(runs.recordings, label, strict=True):
        is_stop = regime == REGIMES.index("stop")
        edges = np.flatnonzero(np.diff(is_stop.astype(np.int8)))
        for begin, end in zip(edges[::2], edges[1::2], strict=False) if not is_stop[0] else []:
            after = recording.q[begin + 1 + (end - begin) // 2 : end + 1, joint].astype(float)
            if len(after) >= 5:
                line = np.polyfit(np.arange(len(after)), after, 1)
                yield float(np.std(after - np.polyval(line, np.arange(len(after)))))
