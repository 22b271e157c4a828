"""Delay from command to motion by cross-correlation, in the recordings and in free runs of a simulator.

No model enters: it is the shift at which the speed of a joint resembles its commanded speed most. Dead
time, lag and play all add to it, and so does the control period after which even an ideal simulator
answers. It is what papers and data sheets call the delay of an actuator.
Axes: `W` windows, `K` steps, `J` joints, `L` shifts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns

RESAMPLES = 400
"""Bootstrap resamples over windows; the ends of an interval then scatter by a tenth of its width."""
LEAST_CORRELATION = 0.5
"""A motion that resembles its command less has no delay worth telling. Chosen by hand."""


def measure_motion_delays(
    before: WindowedRuns, after: WindowedRuns | None, machine: Machine, seed: int
) -> dict[str, Mapping[str, Any] | None] | None:
    """Return the delay of each joint, s: measured with its interval, and simulated before and after the effects.

    `None` for a joint whose motion does not resemble its command, or resembles it most at the longest
    shift that is tried, or whose interval is wider than the delay itself; `None` in all for joints
    commanded by torque, to which no speed belongs.
    """
    if machine.interface == "torque":
        return None
    command = _shift_commands(before, machine.num_history)
    rows = zip(before.source, before.row, strict=True)
    start = np.stack([before.recordings[source].q[row - 1] for source, row in rows])[:, None]
    measured = np.diff(before.measured, axis=1, prepend=start)
    products = _correlate(command, measured)
    simulated = {}
    for name, runs in (("before", before), ("after", after)):
        if runs is not None:
            simulated[name] = _correlate(
                command, np.diff(runs.simulated, axis=1, prepend=start)
            ).sum(0)
    picks = np.random.default_rng(seed).integers(len(products), size=(RESAMPLES, len(products)))
    found: dict[str, Mapping[str, Any] | None] = {}
    for j, joint in enumerate(machine.joint_names):
        total = products[..., j].sum(0)
        size = np.sqrt(np.nansum(np.square(command[:, 0, :, j])) * np.nansum(measured[..., j] ** 2))
        correlation = float(total.max() / size) if size > 0.0 else 0.0
        if correlation < LEAST_CORRELATION or np.argmax(total) == len(total) - 1:
            found[joint] = None
            continue
        drawn = [_find_peak(products[pick, :, j].sum(0)) for pick in picks]
        ends = np.percentile(drawn, (2.5, 97.5)) * machine.period_s
        measured_s = _find_peak(total) * machine.period_s
        if ends[1] - ends[0] > max(measured_s, machine.period_s):
            found[joint] = None
            continue
        one: dict[str, Any] = {
            "measured": measured_s,
            "ci95": ends.tolist(),
            "correlation": correlation,
        }
        for name, values in simulated.items():
            one[name] = _find_peak(values[:, j]) * machine.period_s
        found[joint] = one
    return found


def _shift_commands(runs: WindowedRuns, num_shifts: int) -> np.ndarray:
    """Return the commanded speeds of each window, shift by shift, `(W, L, K, J)`; 0 beyond the recording."""
    steps = runs.simulated.shape[1]
    found = np.zeros((runs.num_windows, num_shifts, steps, runs.simulated.shape[2]))
    for window, (source, row) in enumerate(zip(runs.source, runs.row, strict=True)):
        u = runs.recordings[source].u
        rows = row + np.arange(steps) - np.arange(num_shifts)[:, None]
        inside = (rows >= 0) & (rows < len(u))
        found[window][inside] = u[rows[inside]]
    return found


def _correlate(command: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return the sums over steps of commands times motions `(W, K, J)`, `(W, L, J)`."""
    return np.einsum("wlkj,wkj->wlj", command, np.nan_to_num(motion))


def _find_peak(values: np.ndarray) -> float:
    """Return the place of the largest value, in steps, by a parabola through it and its neighbours."""
    best = int(np.argmax(values))
    if not 0 < best < len(values) - 1:
        return float(best)
    low, top, high = values[best - 1 : best + 2]
    return best + 0.5 * float((low - high) / (low - 2.0 * top + high))
