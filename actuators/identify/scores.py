"""Errors of free runs with intervals, and whether one model is really better than another.

Everything is sums over the windows of each run, so that resampling whole runs is one matrix
product. All models are resampled alike, which makes differences between them paired.
Axes: `W` windows, `R` runs, `B` resamples, `K` steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brokk_rl.intervals import CONFIDENCE
from brokk_rl.machine import Machine
from brokk_rl.open_loop import Windows

RESAMPLED = 1000
TAILS = (50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE))
"""Percentiles that bound the interval."""


@dataclass
class Scores:
    """Free runs of several models through the same windows.

    Attributes:
        predicted: Positions by model, each `(W, K, J)`.
        cut: The windows.
        machine: Gives joints, travel and period.
        generator: Draws the resamples.
    """

    predicted: Mapping[str, np.ndarray]
    cut: Windows
    machine: Machine
    generator: np.random.Generator
    weights: np.ndarray = field(init=False)
    """How often each run is in each resample, `(B, R)`."""

    def __post_init__(self) -> None:
        self._runs, self._number = np.unique(self.cut.run, return_inverse=True)
        count = len(self._runs)
        self.weights = self.generator.multinomial(
            count, np.full(count, 1.0 / count), size=RESAMPLED
        ).astype(float)
        self.error = {
            name: path.astype(float) - self.cut.measured for name, path in self.predicted.items()
        }
        self.travel = np.asarray(self.machine.upper - self.machine.lower, dtype=float)
        self._mean_squares = {name: self.mean(error**2) for name, error in self.error.items()}

    @property
    def num_runs(self) -> int:
        """Number of runs, `R`."""
        return len(self._runs)

    def mean(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mean over windows of `values`, `(W, …)`, NaN where there is none, and that of each resample, `(B, …)`."""
        given = np.isfinite(values)
        return self.ratio(np.where(given, values, 0.0), given)

    def ratio(self, totals: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mean where each window holds `counts` values of sum `totals`, both `(W, …)`, and that of each resample.

        NaN where there is no value at all; the resamples also where only one run has any: it says
        nothing about other runs.
        """
        shape = totals.shape[1:]
        total, count = (
            self._by_run(values).reshape(self.num_runs, -1) for values in (totals, counts)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = total.sum(0) / count.sum(0)
            resampled = (self.weights @ total) / (self.weights @ count)
        resampled[:, (count > 0).sum(0) < 2] = np.nan
        return mean.reshape(shape), resampled.reshape(-1, *shape)

    def rmse(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns the root mean square error after each step, `(K, J)`, and that of each resample, `(B, K, J)`."""
        mean, resampled = self._mean_squares[name]
        return np.sqrt(mean), np.sqrt(resampled)

    def step(self, horizon_s: float) -> int:
        """Returns the index of the last step within a horizon."""
        return round(horizon_s / self.machine.period_s) - 1

    def at(self, name: str, horizon_s: float) -> list[dict[str, Any]]:
        """Returns the error of a model at a horizon, joint by joint.

        `rmse` of the position at the end, rad or m, with `ci95`; `percent` of the joint's travel;
        over the same windows `path_rmse` and `path_mean` (absolute) along the path and `end_mean`
        at its end.
        """
        step = self.step(horizon_s)
        error = self.error[name][np.isfinite(self.cut.measured[:, step, 0])]
        path, (rmse, resampled) = error[:, : step + 1], self.rmse(name)
        return [
            {
                "rmse": float(rmse[step, j]),
                "ci95": interval(resampled[:, step, j]),
                "percent": float(100.0 * rmse[step, j] / self.travel[j]),
                "path_rmse": float(np.sqrt(np.mean(path[..., j] ** 2))),
                "path_mean": float(np.abs(path[..., j]).mean()),
                "end_mean": float(np.abs(error[:, step, j]).mean()),
            }
            for j in range(len(self.travel))
        ]

    def against(self, name: str, rival: str, horizon_s: float) -> list[dict[str, Any]]:
        """Returns by how much a model's error at a horizon differs from a rival's, joint by joint, then for the mean over joints.

        `difference` in rad or m (below 0: better than the rival; in % of travel for the mean) and
        `reduction_percent`, the part of the rival's error that is gone, each with an interval from
        resampling the same runs for both.
        """
        step = self.step(horizon_s)
        (mine, mine_again), (other, other_again) = (
            [part[..., step, :] for part in self.rmse(key)] for key in (name, rival)
        )
        rows = [
            [values[..., j] for values in (mine, other, mine_again, other_again)]
            for j in range(len(self.travel))
        ]
        rows.append(
            [
                (100.0 * values / self.travel).mean(-1)
                for values in (mine, other, mine_again, other_again)
            ]
        )
        return [_difference(*row) for row in rows]

    def _by_run(self, values: np.ndarray) -> np.ndarray:
        """Returns sums over the windows of each run, `(R, …)`."""
        sums = np.zeros((self.num_runs, *values.shape[1:]))
        np.add.at(sums, self._number, values)
        return sums


def interval(resampled: np.ndarray) -> list[float] | None:
    """Returns the interval of a figure from its resamples, `(B,)`; `None` where there are too few runs for one."""
    given = resampled[np.isfinite(resampled)]
    if len(given) < RESAMPLED // 2:
        return None
    return [float(bound) for bound in np.percentile(given, TAILS)]


def overall(rows: Sequence[dict[str, Any]], units: Sequence[str]) -> dict[str, float]:
    """Returns means over joints; those in rad or m only where all joints have the same unit."""
    keys = (
        ("rmse", "percent", "path_rmse", "path_mean", "end_mean")
        if len(set(units)) == 1
        else ("percent",)
    )
    return {key: float(np.mean([row[key] for row in rows])) for key in keys}


def _difference(
    mine: np.ndarray, other: np.ndarray, mine_again: np.ndarray, other_again: np.ndarray
) -> dict[str, Any]:
    floor = np.finfo(float).tiny  # a rival without any error cannot be bettered
    return {
        "difference": float(mine - other),
        "ci95": interval(mine_again - other_again),
        "reduction_percent": float(100.0 * (1.0 - mine / np.maximum(other, floor))),
        "reduction_ci95": interval(100.0 * (1.0 - mine_again / np.maximum(other_again, floor))),
    }
