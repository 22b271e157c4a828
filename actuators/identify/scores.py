"""Errors of free runs with intervals, and whether one model is significantly better than another.

Errors are kept as sums over the windows of each run, so that resampling whole runs is one matrix
product. All models get the same resamples, so differences between them are paired.
Axes: `W` windows, `R` runs, `B` resamples, `K` steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from actuators.open_loop import FreeRunWindows
from brokk_rl.machine import Machine
from brokk_rl.statistics import CONFIDENCE

RESAMPLED = 1000
"""Bootstrap resamples over runs; the usual number for 95 % intervals."""
TAILS = (50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE))
"""Percentiles that bound the interval."""


@dataclass
class FreeRunScores:
    """Free runs of several models through the same windows.

    Attributes:
        predicted: Positions by model, each `(W, K, J)`.
        cut: The windows.
        machine: Gives joints, travel and period.
        generator: Draws the resamples.
    """

    predicted: Mapping[str, np.ndarray]
    cut: FreeRunWindows
    machine: Machine
    generator: np.random.Generator
    weights: np.ndarray = field(init=False)
    """How often each run is in each resample, `(B, R)`."""

    def __post_init__(self) -> None:
        self._runs, self._number = np.unique(self.cut.run, return_inverse=True)
        count, measured = len(self._runs), self.cut.measured
        drawn = self.generator.multinomial(count, np.full(count, 1.0 / count), size=RESAMPLED)
        self.weights = drawn.astype(float)
        self.error = {name: path.astype(float) - measured for name, path in self.predicted.items()}
        self.travel = np.asarray(self.machine.upper - self.machine.lower, dtype=float)
        self._mean_squares = {name: self._mean(error**2) for name, error in self.error.items()}

    @property
    def num_runs(self) -> int:
        """Number of runs, `R`."""
        return len(self._runs)

    def _mean(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean over windows of `values`, `(W, …)`, and of each resample, `(B, …)`.

        NaN where there is no value at all; the resamples also where only one run has any: it says
        nothing about other runs.
        """
        given, shape = np.isfinite(values), values.shape[1:]
        total = self._by_run(np.where(given, values, 0.0)).reshape(self.num_runs, -1)
        count = self._by_run(given).reshape(self.num_runs, -1)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = total.sum(0) / count.sum(0)
            resampled = (self.weights @ total) / (self.weights @ count)
        resampled[:, (count > 0).sum(0) < 2] = np.nan
        return mean.reshape(shape), resampled.reshape(-1, *shape)

    def rmse(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the RMS error after each step, `(K, J)`, and its resamples, `(B, K, J)`."""
        mean, resampled = self._mean_squares[name]
        return np.sqrt(mean), np.sqrt(resampled)

    def step(self, horizon_s: float) -> int:
        """Return the index of the last step within a horizon."""
        return round(horizon_s / self.machine.period_s) - 1

    def at(self, name: str, horizon_s: float) -> list[dict[str, Any]]:
        """Return the error of a model at a horizon, joint by joint.

        `rmse` of the position at the end, rad or m, with `ci95`; `percent` of the joint's travel.
        """
        step = self.step(horizon_s)
        rmse, resampled = self.rmse(name)
        rows = []
        for j in range(len(self.travel)):
            row = {
                "rmse": float(rmse[step, j]),
                "ci95": bound_interval(resampled[:, step, j]),
                "percent": float(100.0 * rmse[step, j] / self.travel[j]),
            }
            rows.append(row)
        return rows

    def against(self, name: str, rival: str, horizon_s: float) -> list[dict[str, Any]]:
        """Return the difference of a model's and a rival's error: per joint, then the mean.

        `difference` in rad or m (below 0: better than the rival; in % of travel for the mean) and
        `reduction_percent`, the part of the rival's error that is gone, each with an interval from
        resampling the same runs for both.
        """
        step = self.step(horizon_s)
        both = [part[..., step, :] for key in (name, rival) for part in self.rmse(key)]
        rows = [[values[..., j] for values in both] for j in range(len(self.travel))]
        rows.append([(100.0 * values / self.travel).mean(-1) for values in both])
        return [_compare_errors(*row) for row in rows]

    def _by_run(self, values: np.ndarray) -> np.ndarray:
        """Return sums over the windows of each run, `(R, …)`."""
        sums = np.zeros((self.num_runs, *values.shape[1:]))
        np.add.at(sums, self._number, values)
        return sums


def bound_interval(resampled: np.ndarray) -> list[float] | None:
    """Return the interval of resamples `(B,)`; `None` where there are too few runs."""
    given = resampled[np.isfinite(resampled)]
    if len(given) < RESAMPLED // 2:
        return None
    return [float(bound) for bound in np.percentile(given, TAILS)]


def average_joints(rows: Sequence[dict[str, Any]], units: Sequence[str]) -> dict[str, float]:
    """Return means over joints; those in rad or m only where all joints have the same unit."""
    keys = ["percent"]
    if len(set(units)) == 1:
        keys = ["rmse", "percent"]
    return {key: float(np.mean([row[key] for row in rows])) for key in keys}


def _compare_errors(
    mine: np.ndarray, mine_again: np.ndarray, other: np.ndarray, other_again: np.ndarray
) -> dict[str, Any]:
    floor = np.finfo(float).tiny  # a rival without any error cannot be bettered
    reduced = 100.0 * (1.0 - mine / np.maximum(other, floor))
    reduced_again = 100.0 * (1.0 - mine_again / np.maximum(other_again, floor))
    return {
        "difference": float(mine - other),
        "ci95": bound_interval(mine_again - other_again),
        "reduction_percent": float(reduced),
        "reduction_ci95": bound_interval(reduced_again),
    }
