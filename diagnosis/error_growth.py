"""Growth of the error over the time of a free run, and the kind of cause that its slope suggests.

A sensor's error does not grow. Play and an offset are there at once and then stay. A wrong gain or
dead band adds up with the distance, an unmodelled load faster. Commands go to and fro, so growth is
slower than for one step; the bounds are wide.
Axes: `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns

HORIZON_SHARES = (0.01, 0.1, 0.4, 1.0)
"""Times at which errors are compared, over the length of a free run: 0.05, 0.5, 2 and 5 s of 5 s."""
READINGS = {
    "none": "no more than the floor",
    "flat": "there at once and constant: a sensor's noise, steps or offset",
    "step": "a step that then stays: play, or timing",
    "slow": "grows slowly: a wandering speed, or timing with commands that go to and fro",
    "linear": "grows with the way: gain, dead band or saturation",
    "quadratic": "grows faster than the way: load, drift, or one error on top of another",
}
FLAT, STEP, LINEAR, QUADRATIC = 0.2, 0.35, 0.65, 1.3
"""Bounds of the slope of log(error) over log(time), chosen by hand about 0 (offset), 0.5 (random
walk), 1 (ramp) and 2 (acceleration); they name the growth in words and change no figure."""
MIN_EXCESS_RATIO = 1.2
"""Error over floor from which a growth is classified; chosen by hand: below it the excess is
noise."""


@dataclass(frozen=True)
class ErrorGrowth:
    """Error of one joint over the time of a free run.

    Attributes:
        horizon_s: Times of the free run, s.
        rmse: Error at each, rad or m.
        floor: The same on the reference; `None` without one.
        early: Slope of log(error beyond the floor) over log(time), from the first horizon to the
            second.
        late: The same from the second to the last.
        reading: One of `READINGS`.
        whole_run: Error over whole recordings in one free run each; `None` where that was not
            computed.
    """

    horizon_s: tuple[float, ...]
    rmse: tuple[float, ...]
    floor: tuple[float, ...] | None
    early: float | None
    late: float | None
    reading: str
    whole_run: float | None

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        plain = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in self.__dict__.items()
        }
        return plain | {"meaning": READINGS[self.reading]}


def measure_growth(
    runs: WindowedRuns, reference: WindowedRuns | None, machine: Machine, whole: WindowedRuns | None
) -> dict[str, ErrorGrowth]:
    """Return the growth of each joint's error."""
    steps = runs.simulated.shape[1]
    at = sorted({max(round(share * steps), 1) - 1 for share in HORIZON_SHARES})
    rmse = compute_rmse_curve(runs)[at]
    floor = compute_rmse_curve(reference)[at] if reference else None
    overall = None if whole is None else np.sqrt(np.nanmean(whole.error**2, (0, 1)))
    found = {}
    for j, name in enumerate(machine.joint_names):
        beyond = np.sqrt(
            np.maximum(rmse[:, j] ** 2 - (0.0 if floor is None else floor[:, j] ** 2), 0.0)
        )
        is_sizeable = floor is None or rmse[-1, j] > MIN_EXCESS_RATIO * floor[-1, j]
        early, late = (
            fit_log_slopes(np.array([(k + 1) * machine.period_s for k in at]), beyond)
            if is_sizeable
            else (None, None)
        )
        found[name] = ErrorGrowth(
            tuple((k + 1) * machine.period_s for k in at),
            tuple(map(float, rmse[:, j])),
            None if floor is None else tuple(map(float, floor[:, j])),
            early,
            late,
            classify_growth(early, late),
            None if overall is None else float(overall[j]),
        )
    return found


def compute_rmse_curve(runs: WindowedRuns) -> np.ndarray:
    """Return the root mean square error after each step, `(K, J)`; NaN without any window."""
    given = np.isfinite(runs.error)
    with np.errstate(invalid="ignore"):
        return np.sqrt((np.where(given, runs.error, 0.0) ** 2).sum(0) / given.sum(0))


def fit_log_slopes(horizon_s: np.ndarray, beyond: np.ndarray) -> tuple[float | None, float | None]:
    """Return the slopes of log(error) over log(time) before and after the second horizon."""
    if len(horizon_s) < 3 or not np.isfinite(beyond[1:]).all() or beyond[1] <= 0 or beyond[-1] <= 0:
        return None, None
    log_s, log_error = np.log(horizon_s), np.log(np.maximum(beyond, 1e-3 * beyond[-1]))
    return (
        float((log_error[1] - log_error[0]) / (log_s[1] - log_s[0])),
        float((log_error[-1] - log_error[1]) / (log_s[-1] - log_s[1])),
    )


def classify_growth(early: float | None, late: float | None) -> str:
    """Return the kind of growth of a pair of slopes, one of `READINGS`."""
    if early is None or late is None:
        return "none"
    if late < STEP:
        return "flat" if early < FLAT else "step"
    return "slow" if late < LINEAR else "linear" if late < QUADRATIC else "quadratic"
