"""Changes of a machine without any effect: its numbers age, and its speed wanders slowly.

Both are columns with a prior in the covariance of the increments. What they explain costs nothing,
and no hypothesis earns by it.
Axes: `N` increments, `K` columns, `C` candidates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diagnosis.engine.baseline import NUM_PARTS, JointBaseline, linearise
from diagnosis.engine.measure import IncrementMeasure
from diagnosis.engine.side import Side

WANDER_S = 12.0
"""Distance of the knots between which the speed, or the friction of a servo, wanders."""
FRICTION_UNITS = 0.02
"""Friction of a servo over its stiffness, of which the wander is a part, half travels."""
WEIGHT_UNITS = 0.2
"""Sag over the turn of another joint, of which the wander is a part."""
STILL_UNITS_S = 0.02
"""Speed about which the direction of a servo changes, half travels a second."""
WANDER_SIZES = (0.02, 0.04, 0.07, 0.12)
"""Standard deviations of the wander that are tried on the reference, over the speed."""


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

    def clean(self, increments: np.ndarray) -> np.ndarray:
        """Return increments `(N,)` over their deviation, less what the columns explain."""
        scaled = increments / np.sqrt(self.spread)
        return scaled - self.columns.T @ (self.inverse @ (self.columns @ scaled))

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


def list_wander(side: Side, joint: int, path: np.ndarray) -> np.ndarray:
    """Return paths of a slow wander, `(K, T)`: of the speed, as large as it, or of a servo's friction and weight."""
    at_s = np.arange(side.num_samples) * side.period_s
    knots = np.arange(0.0, at_s[-1] + WANDER_S, WANDER_S)
    hats = draw_hats(at_s, knots)
    if not side.model.integrates:
        friction = FRICTION_UNITS * find_direction(side, path) * hats
        others = np.delete(side.q, joint, 1).T
        return np.concatenate([friction, WEIGHT_UNITS * (others - others.mean(1)[:, None])])
    return np.cumsum(simulate_speed(side, path) * hats, -1)


@dataclass
class JointNuisance:
    """Ageing and wander of one joint, as the reference shows them.

    Attributes:
        mix: Columns of ageing from the slopes of the fitted numbers, `(F, F)`.
        wander: Standard deviation of the wander over the speed.
        parts: Projection of each part of the reference.
    """

    mix: np.ndarray
    wander: float
    parts: list[Projection]

    def project(
        self,
        side: Side,
        joint: int,
        path: np.ndarray,
        slopes: np.ndarray,
        measure: IncrementMeasure,
        spread: float,
    ) -> Projection:
        """Return the projection of a joint on a side, from its simulated path and slopes."""
        wander = measure(list_wander(side, joint, path)).astype(float)
        return Projection(np.concatenate([self.mix @ slopes, self.wander * wander]), spread)

    def explain(
        self, side: Side, joint: int, path: np.ndarray, projection: Projection, residual: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the likeliest ageing of the fitted numbers, `(F,)`, and the path of the wander, `(T,)`.

        Args:
            side: The recordings.
            joint: Place of the joint.
            path: Simulated path, `(T,)`.
            projection: Made by `project` from the same path.
            residual: Increments of the error, `(N,)`.
        """
        scaled = residual / np.sqrt(projection.spread)
        shares = projection.inverse @ (projection.columns @ scaled)
        size = len(self.mix)
        wander = self.wander * (shares[size:] @ list_wander(side, joint, path))
        return shares[:size] @ self.mix, wander


def estimate_nuisance(side: Side, joint: int, base: JointBaseline) -> JointNuisance:
    """Return ageing and wander of a joint; the wander is the one that makes the left-out parts likeliest."""
    ageing = side.model.list_ageing(base.numbers)
    mix = np.linalg.cholesky(base.covariance + np.diag(ageing**2)).T
    _, slopes = linearise(side, joint, base.numbers, base.measure)
    aged = mix @ slopes
    path = side.simulate(joint, base.numbers)[0].astype(float)
    wander = base.measure(list_wander(side, joint, path)).astype(float)
    best = None
    for size in WANDER_SIZES:
        columns = np.concatenate([aged, size * wander])
        evidence, parts = 0.0, []
        for k in range(NUM_PARTS):
            own = base.part == k
            count = count_part(base, k)
            part = Projection(columns[:, own], base.spread)
            squares = part.measure_squares(base.left_out[own])[0]
            evidence -= count * np.log(squares + count) + 0.5 * part.log_determinant
            parts.append(part)
        if best is None or evidence > best[0]:
            best = (evidence, size, parts)
    assert best is not None, "there is at least one size"
    return JointNuisance(mix, best[1], best[2])


def count_part(base: JointBaseline, part: int) -> float:
    """Return the number of independent increments in a part of the reference."""
    return float(((base.part == part) & base.measure.valid).sum()) / base.measure.interval
