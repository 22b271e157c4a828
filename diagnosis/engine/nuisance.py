"""Changes of a machine without any effect: its numbers age, its speed wanders, and no two motions are the same.

All are columns with a prior in the covariance of the increments. What they explain costs nothing, and
no hypothesis earns by it: an effect has to show in many motions.
Axes: `T` samples, `N` increments, `K` columns, `C` candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from diagnosis.engine.baseline import NUM_PARTS, JointBaseline, linearise
from diagnosis.engine.kernel import WAKING_DEMAND
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
MOTION_S = 1.0
"""A motion that begins sooner behind another one belongs to it. Left-out parts of three machines of two makes are likelier
by 319, 308 and 276 nats with motions of 0, 0.6 and 1.5 s at least; by 222 where only their starts scatter."""
LEAST_SQUARE = 1e-9
"""Square sum from which on a column says anything of some increments."""
SIZES = (0.0, 0.005, 0.01, 0.02, 0.04, 0.07, 0.12)
"""Standard deviations that are tried on the reference: of factors of the speed, and of starts, s."""


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


def number_motions(side: Side, flow: np.ndarray) -> np.ndarray:
    """Return the number of the motion at each sample from the asked flow `(T,)`, `(T,)`: a valve that opens begins one."""
    way = np.sign(flow) * (np.abs(flow) > WAKING_DEMAND)
    before = np.roll(way, 1)
    before[side.starts] = 0.0
    begins = np.zeros(side.num_samples, dtype=int)
    last = -side.count(MOTION_S)
    for place in np.flatnonzero((way != 0.0) & (way != before)):
        if place - last >= side.count(MOTION_S):
            begins[place] = 1
            last = place
    return np.cumsum(begins)


def list_scatter(
    side: Side, joint: int, path: np.ndarray, flow: np.ndarray, measure: IncrementMeasure
) -> list[np.ndarray]:
    """Return groups of columns of size 1, `(K, N)` each, from the simulated path and asked flow, `(T,)` each.

    For a joint that takes speeds: a slow wander of the speed, a factor of the speed of each motion, and
    how much later it starts. For a servo: a slow wander of its friction, and of its weight.
    """
    at_s = np.arange(side.num_samples) * side.period_s
    knots = np.arange(0.0, at_s[-1] + WANDER_S, WANDER_S)
    hats = draw_hats(at_s, knots)
    if not side.model.integrates:
        friction = FRICTION_UNITS * find_direction(side, path) * hats
        others = np.delete(side.q, joint, 1).T
        weight = WEIGHT_UNITS * (others - others.mean(1)[:, None])
        return [measure(np.concatenate([friction, weight])).astype(float)]
    step = simulate_speed(side, path)
    gained = np.diff(step, append=step[-1])
    gained[side.ends - 1] = 0.0
    is_rising = np.abs(step + gained) > np.abs(step)
    motion = number_motions(side, flow)
    own = motion == np.arange(motion.max() + 1)[:, None]
    columns = [step * hats, step * own, gained * is_rising / side.period_s * own]
    return [measure(np.cumsum(group, -1, dtype=np.float32)).astype(float) for group in columns]


def scale_columns(columns: Sequence[np.ndarray], sizes: Sequence[float]) -> np.ndarray:
    """Return the columns of groups `(K, N)` each, those of a group times its size, `(K, N)`."""
    return np.concatenate(
        [size * group for size, group in zip(sizes, columns, strict=True) if size]
    )


@dataclass
class JointNuisance:
    """Ageing and scatter of one joint, as the reference shows them.

    Attributes:
        mix: Columns of ageing from the slopes of the fitted numbers, `(F, F)`.
        sizes: Standard deviation of each group of columns; that of ageing is 1.
        parts: Projection of each part of the reference.
    """

    mix: np.ndarray
    sizes: list[float]
    parts: list[Projection]

    def project(
        self, slopes: np.ndarray, scatter: Sequence[np.ndarray], spread: float
    ) -> Projection:
        """Return the projection of a joint on a side, from increments of its slopes and of its scatter."""
        return Projection(scale_columns([self.mix @ slopes, *scatter], self.sizes), spread)

    def explain_ageing(self, projection: Projection, residual: np.ndarray) -> np.ndarray:
        """Return the likeliest ageing of the fitted numbers, `(F,)`, from increments of the error, `(N,)`."""
        scaled = residual / np.sqrt(projection.spread)
        shares = projection.inverse @ (projection.columns @ scaled)
        return shares[: len(self.mix)] @ self.mix


class _PartScatter:
    """One left-out part of the reference, with columns of all groups at size 1.

    Args:
        columns: Columns of each group, ageing first, `(K, N)` each.
        base: The joint.
        part: Number of the part.
    """

    def __init__(self, columns: Sequence[np.ndarray], base: JointBaseline, part: int) -> None:
        own = base.part == part
        self.columns = []
        for group in columns:
            some = group[:, own]
            self.columns.append(some[np.square(some).sum(1) > LEAST_SQUARE])
        every = np.concatenate(self.columns) / np.sqrt(base.spread)
        residual = base.left_out[own] / np.sqrt(base.spread)
        self._normal = every @ every.T
        self._shares = every @ residual
        self._square = float(residual @ residual)
        self._count = count_part(base, part)
        self._spread = base.spread

    def weigh(self, sizes: Sequence[float]) -> float:
        """Return the log evidence with a size for each group."""
        size = np.concatenate(
            [np.full(len(g), s) for g, s in zip(self.columns, sizes, strict=True)]
        )
        used = size > 0.0
        size = size[used]
        normal = np.eye(len(size)) + self._normal[np.ix_(used, used)] * np.outer(size, size)
        root = np.linalg.cholesky(normal)
        explained = solve_triangular(root, self._shares[used] * size, lower=True)
        square = self._square - float(explained @ explained)
        return -self._count * np.log(square + self._count) - float(np.log(np.diag(root)).sum())

    def project(self, sizes: Sequence[float]) -> Projection:
        """Return the projection with a size for each group."""
        return Projection(scale_columns(self.columns, sizes), self._spread)


def estimate_nuisance(side: Side, joint: int, base: JointBaseline) -> JointNuisance:
    """Return ageing and scatter of a joint; the sizes are those that make the left-out parts likeliest."""
    ageing = side.model.list_ageing(base.numbers)
    mix = np.linalg.cholesky(base.covariance + np.diag(ageing**2)).T
    _, slopes = linearise(side, joint, base.numbers, base.measure)
    path, flow = (one[0].astype(float) for one in side.simulate_flow(joint, base.numbers))
    columns = [mix @ slopes, *list_scatter(side, joint, path, flow, base.measure)]
    parts = [_PartScatter(columns, base, k) for k in range(NUM_PARTS)]
    sizes = [1.0, *[0.0] * (len(columns) - 1)]
    best = sum(part.weigh(sizes) for part in parts)
    for place in 2 * list(range(1, len(sizes))):
        for size in SIZES:
            tried = [*sizes[:place], size, *sizes[place + 1 :]]
            evidence = sum(part.weigh(tried) for part in parts)
            if evidence > best:
                best = evidence
                sizes = tried
    scatter = scale_columns(columns, sizes)[len(mix) :]
    mix = np.linalg.cholesky(base.add_scatter(slopes, scatter) + np.diag(ageing**2)).T
    return JointNuisance(mix, sizes, [part.project(sizes) for part in parts])


def count_part(base: JointBaseline, part: int) -> float:
    """Return the number of independent increments in a part of the reference."""
    return float(((base.part == part) & base.measure.valid).sum()) / base.measure.interval
