"""Covariance of the increments of a simulator's error, and its fit to residuals.

Axes: `W` windows, `I` increments in a window, `B` blocks of `S` increments in a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from brokk_rl.machine import Machine

T_FREEDOM = 5.0
"""Degrees of freedom of the t distribution that whitened errors are taken to have."""
NO_BORDER = 1e300
"""Last element of a bordered covariance: so large that the matrix stays positive definite."""
COVARIANCE_WINDOWS = 3
"""Windows in a row on which the noise is fitted."""
MIN_TYPICAL_ERROR = 0.1
"""Smallest typical error, over the root of the mean square."""


def compute_loss(z: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Return the negative log likelihood of whitened errors, up to a constant, summed."""
    return 0.5 * (T_FREEDOM + 1.0) * np.log1p(np.square(z) / T_FREEDOM).sum(axis)


def weigh_residuals(z: np.ndarray) -> np.ndarray:
    """Return the weights that turn squares of `z` into `loss` (iteratively reweighted least squares)."""
    return (T_FREEDOM + 1.0) / (T_FREEDOM + np.square(z))


@dataclass(frozen=True)
class ErrorCovariance:
    """Covariance of the increments of one joint's error, as a function of the simulated motion.

    Attributes:
        sensor: Standard deviation of each increment, rad or m.
        change: The same over the change of speed between neighbouring increments.
        wander: Relative standard deviation of the speed.
        memory: Increments over which a wandering speed forgets.
        reading: Standard deviation of each position as it is read, rad or m; it enters two
            increments in a row with opposite signs.
    """

    sensor: float
    change: float
    wander: float
    memory: float
    reading: float = 0.0

    def covariance(self, increments: np.ndarray) -> np.ndarray:
        """Return the covariance of increments in a row, `(B, S, S)`, where the simulator moves by `increments` `(B, S)`."""
        lag = _count_between(increments.shape[1])
        read = self.reading**2 * np.clip(2.0 - 3.0 * lag, -1.0, 2.0) * (lag <= 1)
        kept = self.remember(increments.shape[1])
        return (
            self.wander**2 * increments[:, :, None] * increments[:, None, :] * kept
            + self.vary(increments)[:, :, None] * np.eye(increments.shape[1])
            + read
        )

    def remember(self, size: int) -> np.ndarray:
        """Return the correlation of a wandering speed between `size` increments in a row, `(S, S)`."""
        return np.exp(-_count_between(size) / self.memory)

    def vary(self, increments: np.ndarray) -> np.ndarray:
        """Return the variance of each increment that it shares with no other, `(B, S)`."""
        turn = np.abs(np.diff(increments, axis=1, prepend=increments[:, :1])) + np.abs(
            np.diff(increments, axis=1, append=increments[:, -1:])
        )
        return self.sensor**2 + (self.change * turn) ** 2

    def strayed(self, increments: np.ndarray) -> np.ndarray:
        """Return the variance of the position after each increment, `(B, S)`, where each of `B` begins without an error."""
        return np.diagonal(self.covariance(increments).cumsum(1).cumsum(2), axis1=1, axis2=2)

    def whitener(self, increments: np.ndarray) -> np.ndarray:
        """Return the inverse Cholesky factors of the covariance, `(B, S, S)`."""
        return np.linalg.inv(np.linalg.cholesky(self.covariance(increments)))


@dataclass(frozen=True)
class LevelCovariance(ErrorCovariance):
    """Covariance of increments where a loop holds the position, so that errors do not add up.

    The error of the position itself is stationary: it has a part of each sample by itself
    (`sensor` and `reading`), one over the motion (`change`), and one that forgets over `memory` increments.

    Attributes:
        stray: Standard deviation of the error that forgets, rad or m.
        window: Increments in a window; each window begins without an error.
    """

    stray: float = 0.0
    window: int = 1

    def level_covariance(self, increments: np.ndarray) -> np.ndarray:
        """Return the covariance of the error of the position after each increment, `(B, S, S)`."""
        size = increments.shape[1]
        moved = increments[:, :, None] * increments[:, None, :]
        alone = self.sensor**2 + self.reading**2
        level = (self.stray**2 + self.change**2 * moved) * self.remember(size)
        return level + alone * np.eye(size)

    def covariance(self, increments: np.ndarray) -> np.ndarray:
        """Return the covariance of increments in a row, `(B, S, S)`; see `ErrorCovariance`."""
        size, level = increments.shape[1], self.level_covariance(increments)
        goes_on = (np.arange(size) % self.window != 0)[1:, None]
        level[:, 1:] = level[:, 1:] - goes_on * level[:, :-1]
        level[:, :, 1:] = level[:, :, 1:] - goes_on.T * level[:, :, :-1]
        return level


@dataclass(frozen=True)
class ForceCovariance(ErrorCovariance):
    """Covariance of increments where a command sets a force, so that errors of force add up twice.

    An error of the speed at the beginning stays; one of the force adds to it in each step and
    forgets over `memory` increments. Neither depends on the motion: friction is wrong at rest too.

    Attributes:
        start: Standard deviation of an increment through the speed at the beginning, rad or m.
        push: That through the force of one step, rad or m.
        window: Increments in a window; each window begins anew.
    """

    start: float = 0.0
    push: float = 0.0
    window: int = 1

    def covariance(self, increments: np.ndarray) -> np.ndarray:
        """Return the covariance of increments in a row, `(B, S, S)`; see `ErrorCovariance`."""
        size = increments.shape[1]
        number = np.arange(size) // self.window
        same = number[:, None] == number
        summed = np.tril(same).astype(float)
        forced = self.push**2 * (summed @ (self.remember(size) * same) @ summed.T)
        one = self.start**2 * same + forced + self.sensor**2 * np.eye(size)
        return np.broadcast_to(one, (len(increments), size, size))


def _count_between(size: int) -> np.ndarray:
    """Return how many increments lie between two of `size` in a row, `(S, S)`."""
    return np.abs(np.subtract.outer(np.arange(size), np.arange(size)))


def join_windows(recordings: Sequence[np.ndarray]) -> np.ndarray:
    """Return increments `(W, I)` of recordings with `COVARIANCE_WINDOWS` in a row, `(W / N, N I)`.

    Fewer are joined where no recording has so many; shorter recordings than that are left out.
    """
    together = min(COVARIANCE_WINDOWS, max(map(len, recordings)))
    whole = [one[: len(one) // together * together] for one in recordings]
    return np.concatenate([one.reshape(-1, together * one.shape[1]) for one in whole])


def fit_noise(error: np.ndarray, increments: np.ndarray) -> ErrorCovariance:
    """Return the noise of one joint: maximum likelihood on errors and simulated increments, `(W, I)`, with outliers cut."""
    # a joint that stands still most of the time, read by a coarse sensor, has a median error of 0
    typical = (
        max(1.4826 * np.median(np.abs(error)), MIN_TYPICAL_ERROR * np.sqrt(np.mean(error**2)))
        + 1e-9
    )
    size = np.sqrt(np.mean(increments**2)) + 1e-9
    error = np.clip(
        error, -12.0 * typical - 0.3 * np.abs(increments), 12.0 * typical + 0.3 * np.abs(increments)
    )

    steps = increments.shape[1]
    # The Cholesky factor of the covariance bordered by the error has the whitened error in its last row.
    bordered = np.zeros((len(error), steps + 1, steps + 1))
    bordered[:, -1, :-1] = error
    products = increments[:, :, None] * increments[:, None, :]
    diagonal = np.arange(steps)

    def minus_log(x: np.ndarray) -> float:
        noise = ErrorCovariance(*np.exp(x))
        bordered[:, :-1, :-1] = noise.wander**2 * noise.remember(steps) * products
        bordered[:, diagonal, diagonal] += noise.vary(increments) + 1e-18
        bordered[:, -1, -1] = NO_BORDER
        factor = np.linalg.cholesky(bordered)
        log_size = np.log(np.diagonal(factor, axis1=1, axis2=2)[:, :-1]).sum()
        z = factor[:, -1, :-1]
        return float(compute_loss(z) + log_size + 0.02 * np.square(x[3] - np.log(10.0)) * 10)

    start = np.log([typical, 0.05, max(0.01, 0.5 * np.sqrt(np.mean(error**2)) / size), 10.0])
    low, high = (
        np.log([typical / 10, 1e-4, 1e-4, 1.0]),
        np.log([10 * typical + 1e-6, 1.0, 0.5, 200.0]),
    )
    found = minimize(
        minus_log,
        start,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={"maxiter": 40},
    )
    return ErrorCovariance(*np.exp(found.x))


def fit_joint_noise(
    errors: Sequence[np.ndarray], motions: Sequence[np.ndarray], machine: Machine
) -> ErrorCovariance:
    """Return the noise of one joint from increments of errors and of simulated motions, each `(W, I)`."""
    error, moved = join_windows(errors), join_windows(motions)
    if machine.interface == "position":
        return fit_level_noise(error, moved, errors[0].shape[1])
    if machine.interface == "torque":
        return fit_force_noise(error, errors[0].shape[1])
    return fit_noise(error, moved)


def fit_force_noise(error: np.ndarray, window: int) -> ForceCovariance:
    """Return the noise of one joint that is commanded by a force; see `fit_noise`.

    Args:
        error: Increments of the error, windows in a row, `(W, I)`.
        window: Increments in a window.
    """
    typical = max(1.4826 * np.median(np.abs(error)), MIN_TYPICAL_ERROR * np.sqrt(np.mean(error**2)))
    typical += 1e-12
    error = np.clip(error, -12.0 * typical, 12.0 * typical)

    def build(x: np.ndarray) -> ForceCovariance:
        sensor, start, push, memory = np.exp(x)
        return ForceCovariance(sensor, 0.0, 0.0, memory, 0.0, start, push, window)

    def minus_log(x: np.ndarray) -> float:
        factor = np.linalg.cholesky(build(x).covariance(error[:1])[0])
        z = np.linalg.solve(factor, error.T)
        return float(compute_loss(z) + len(error) * np.log(np.diagonal(factor)).sum())

    first = np.log([0.3 * typical, 0.5 * typical, typical / window, 5.0])
    ends = [(typical / 100, 10 * typical)] * 2 + [(typical / 1e4, 10 * typical), (1.0, 200.0)]
    bounds = [(np.log(low), np.log(high)) for low, high in ends]
    found = minimize(minus_log, first, method="L-BFGS-B", bounds=bounds, options={"maxiter": 40})
    return build(found.x)


def fit_level_noise(error: np.ndarray, increments: np.ndarray, window: int) -> LevelCovariance:
    """Return the noise of one joint whose position a loop holds; see `fit_noise`.

    Args:
        error: Increments of the error, windows in a row, `(W, I)`.
        increments: Simulated increments, `(W, I)`.
        window: Increments in a window.
    """
    level = np.cumsum(error.reshape(-1, window), 1)
    typical = 1.4826 * np.median(np.abs(level))
    typical = max(typical, MIN_TYPICAL_ERROR * np.sqrt(np.mean(level**2))) + 1e-9
    most = 12.0 * typical
    level = np.clip(level, -most, most).reshape(error.shape)
    steps = error.shape[1]
    # Increments of the error and the error itself have the same whitened values: the one's Cholesky
    # factor is that of the other, differenced. See `fit_noise` for the border.
    bordered = np.zeros((len(level), steps + 1, steps + 1))
    bordered[:, -1, :-1] = level

    def build(x: np.ndarray) -> LevelCovariance:
        sensor, change, stray, memory = np.exp(x)
        return LevelCovariance(sensor, change, 0.0, memory, 0.0, stray, window)

    def minus_log(x: np.ndarray) -> float:
        bordered[:, :-1, :-1] = build(x).level_covariance(increments) + 1e-18 * np.eye(steps)
        bordered[:, -1, -1] = NO_BORDER
        factor = np.linalg.cholesky(bordered)
        log_size = np.log(np.diagonal(factor, axis1=1, axis2=2)[:, :-1]).sum()
        return float(compute_loss(factor[:, -1, :-1]) + log_size)

    start = np.log([0.3 * typical, 0.05, typical, 5.0])
    ends = [(typical / 30, 10 * typical), (1e-3, 2.0), (typical / 30, 10 * typical), (1.0, 200.0)]
    bounds = [(np.log(low), np.log(high)) for low, high in ends]
    found = minimize(minus_log, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 40})
    return build(found.x)
