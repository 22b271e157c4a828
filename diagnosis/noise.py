"""How a simulator errs that lacks nothing: the covariance of its errors on reference recordings that it was not fitted to.

Errors are compared as increments over `SPAN` samples. They have three parts: a sensor's (each
increment by itself), one at changes of speed, and a speed that wanders by a few percent for some
seconds, which is the part that hangs together. Dividing by
the root of the covariance makes all increments count alike and independent: a wandering speed is
then no evidence for another gain.
Axes: `W` windows, `I` increments, `J` joints, `B` blocks of `S` increments in a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

SPAN = 5
"""Samples in an increment: a quarter of a second at 20 Hz."""
FREEDOM = 5.0
"""Degrees of freedom of the t distribution that whitened errors are taken to have."""
LONGEST = 80
"""Increments in a block."""
STILL = 0.1
"""Smallest typical error, over the root of the mean square."""


def increments(paths: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Returns the ways in `SPAN` samples each of positions `(…, W, K, J)` that begin at `start` `(W, J)`: `(…, W, I, J)`."""
    count = paths.shape[-2] // SPAN
    ends = paths[..., SPAN - 1 : count * SPAN : SPAN, :]
    first = np.broadcast_to(start[:, None], (*ends.shape[:-2], 1, ends.shape[-1]))
    return np.diff(ends, axis=-2, prepend=first)


def loss(z: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Returns the negative log likelihood of whitened errors, up to a constant, summed."""
    return 0.5 * (FREEDOM + 1.0) * np.log1p(np.square(z) / FREEDOM).sum(axis)


def weight(z: np.ndarray) -> np.ndarray:
    """Returns the weights that turn squares of `z` into `loss` (iteratively reweighted least squares)."""
    return (FREEDOM + 1.0) / (FREEDOM + np.square(z))


@dataclass(frozen=True)
class Noise:
    """Covariance of the increments of one joint's error, as a function of the simulated motion.

    Attributes:
        sensor: Standard deviation of each increment, rad or m.
        change: The same over the change of speed between neighbouring increments.
        wander: Relative standard deviation of the speed.
        memory: Increments over which a wandering speed forgets.
        reading: Standard deviation of each position as it is read, rad or m: what one increment
            gains the next one loses.
    """

    sensor: float
    change: float
    wander: float
    memory: float
    reading: float = 0.0

    def covariance(self, way: np.ndarray) -> np.ndarray:
        """Returns the covariance of increments in a row, `(B, S, S)`, where the simulator moves by `way` `(B, S)`."""
        lag = np.abs(np.subtract.outer(np.arange(way.shape[1]), np.arange(way.shape[1])))
        kept = np.exp(-lag / self.memory)
        turn = np.abs(np.diff(way, axis=1, prepend=way[:, :1])) + np.abs(
            np.diff(way, axis=1, append=way[:, -1:])
        )
        single = self.sensor**2 + (self.change * turn) ** 2
        read = self.reading**2 * np.clip(2.0 - 3.0 * lag, -1.0, 2.0) * (lag <= 1)
        return (
            self.wander**2 * way[:, :, None] * way[:, None, :] * kept
            + single[:, :, None] * np.eye(way.shape[1])
            + read
        )

    def strayed(self, way: np.ndarray) -> np.ndarray:
        """Returns the variance of the position after each increment, `(B, S)`, where each of `B` begins without an error."""
        return np.diagonal(self.covariance(way).cumsum(1).cumsum(2), axis1=1, axis2=2)

    def whitener(self, way: np.ndarray) -> np.ndarray:
        """Returns the inverse Cholesky factors of the covariance, `(B, S, S)`."""
        return np.linalg.inv(np.linalg.cholesky(self.covariance(way)))


def fit(error: np.ndarray, way: np.ndarray) -> Noise:
    """Returns the noise of one joint: maximum likelihood on errors and simulated increments, `(W, I)`, with outliers cut."""
    # a joint that stands still most of the time, read by a coarse sensor, has a median error of 0
    typical = max(1.4826 * np.median(np.abs(error)), STILL * np.sqrt(np.mean(error**2))) + 1e-9
    size = np.sqrt(np.mean(way**2)) + 1e-9
    error = np.clip(error, -12.0 * typical - 0.3 * np.abs(way), 12.0 * typical + 0.3 * np.abs(way))

    def minus_log(x: np.ndarray) -> float:
        noise = Noise(*np.exp(x))
        factor = np.linalg.cholesky(noise.covariance(way) + 1e-18 * np.eye(way.shape[1]))
        z = np.linalg.solve(factor, error[..., None])[..., 0]
        log_size = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum()
        return float(loss(z) + log_size + 0.02 * np.square(x[3] - np.log(10.0)) * 10)

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
    return Noise(*np.exp(found.x))
