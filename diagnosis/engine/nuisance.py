"""Changes of a machine without any effect: its numbers age.

They are columns with a prior in the covariance of the increments. What they explain costs nothing, and
no hypothesis earns by it. Columns of a slow wander, and of speed and start of each motion, are left out: they
explained small effects too. Of 22 practice machines with one effect 18 are named first without them, and 14 with
them; a wander alone tells 2 of 14 less.
Axes: `T` samples, `N` increments, `K` columns, `C` candidates, `F` fitted numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diagnosis.engine.baseline import NUM_PARTS, JointBaseline
from diagnosis.engine.joint_model import JointModel
from diagnosis.engine.side import Side

STILL_UNITS_S = 0.02
"""Speed about which the direction of a servo changes, half travels a second."""
LEAST_SQUARE = 1e-9
"""Square sum from which on a column says anything of some increments."""


class Projection:
    """Square sums of increments with the nuisance columns free within their prior.

    Args:
        columns: Columns of standard deviation 1, `(K, N)`.
        spread: Variance of the increments.
    """

    def __init__(self, columns: np.ndarray, spread: float) -> None:
        self.spread = spread
        self.columns = columns / np.sqrt(spread)
        self._narrow = self.columns.astype(np.float32)
        normal = np.eye(len(columns)) + self.columns @ self.columns.T
        self.inverse = np.linalg.inv(normal)
        self.log_determinant = float(np.linalg.slogdet(normal)[1])

    def measure_squares(self, increments: np.ndarray) -> np.ndarray:
        """Return the square sum of each row of increments `(C, N)`, `(C,)`."""
        increments = np.atleast_2d(increments)
        scaled = increments.astype(np.float32) / np.float32(np.sqrt(self.spread))
        shares = (scaled @ self._narrow.T).astype(float)
        total = np.einsum("cn,cn->c", scaled, scaled, dtype=float)
        return total - np.einsum("ck,kl,cl->c", shares, self.inverse, shares)

    def multiply(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return the products `(A, B)` of increments `(A, N)` and `(B, N)` under the whole covariance."""
        explained = (left @ self.columns.T) @ self.inverse @ (self.columns @ right.T)
        return left @ right.T / self.spread - explained / self.spread

    def add(self, columns: np.ndarray) -> Projection:
        """Return the projection with more columns of standard deviation 1."""
        own = self.columns * np.sqrt(self.spread)
        return Projection(np.concatenate([own, columns]), self.spread)


def compute_gain(squares: np.ndarray, before: float, count: float) -> np.ndarray:
    """Return the gain of candidates in nats from their square sums.

    The variance is estimated with them: a Student distribution with as many degrees of freedom as
    there are increments.
    """
    return count * np.log((before + count) / (squares + count))


def draw_hats(at: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return the hat functions of `at` `(T,)` on the knots `(K,)`, `(K, T)`."""
    return np.stack([np.interp(at, knots, row) for row in np.eye(len(knots))])


def simulate_speed(side: Side, path: np.ndarray) -> np.ndarray:
    """Return the step of a path `(T,)` from each sample to the next, 0 between recordings."""
    step = np.diff(path, append=path[-1])
    step[side.ends - 1] = 0.0
    return step


def find_direction(side: Side, path: np.ndarray) -> np.ndarray:
    """Return the smoothed sign of the motion of a path `(T,)`, `(T,)`."""
    return np.tanh(simulate_speed(side, path) / (STILL_UNITS_S * side.period_s))


@dataclass
class JointNuisance:
    """Ageing of one joint, as the reference shows it.

    Attributes:
        mix: Columns of ageing from the slopes of the fitted numbers, `(F, F)`.
        parts: Projection of each part of the reference.
    """

    mix: np.ndarray
    parts: list[Projection]

    def project(self, slopes: np.ndarray, spread: float) -> Projection:
        """Return the projection of a joint on a side, from increments of its slopes `(F, N)`."""
        return Projection(self.mix @ slopes, spread)

    def explain_ageing(self, projection: Projection, residual: np.ndarray) -> np.ndarray:
        """Return the likeliest ageing of the fitted numbers, `(F,)`, from increments of the error, `(N,)`."""
        scaled = residual / np.sqrt(projection.spread)
        shares = projection.inverse @ (projection.columns @ scaled)
        return shares @ self.mix


def count_part(base: JointBaseline, part: int) -> float:
    """Return the number of independent increments in a part of the reference."""
    return float(((base.part == part) & base.measure.valid).sum()) / base.measure.interval


def estimate_nuisance(model: JointModel, base: JointBaseline) -> JointNuisance:
    """Return the ageing of a joint: that of its kind, beside the uncertainty of the fit."""
    ageing = model.list_ageing(base.numbers)
    mix = np.linalg.cholesky(base.covariance + np.diag(ageing**2)).T
    columns = mix @ base.slopes
    parts = [Projection(columns[:, base.part == k], base.spread) for k in range(NUM_PARTS)]
    return JointNuisance(mix, parts)
