"""Levenberg's and Marquardt's method for values with a prior, all trials of a step simulated at once.

Axes: `C` trials, `F` values, `N` increments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

NUM_DAMPINGS = 4
"""Dampings that are tried at once: a step costs one call of the kernel."""
DAMPING_RATIO = 8.0
ENOUGH = 2e-4
"""Relative gain of a round below which a descent ends."""

Simulate = Callable[[np.ndarray], np.ndarray]
"""Increments `(C, N)` of trials `(C, F)`."""
Multiply = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Products `(A, B)` of increments `(A, N)` and `(B, N)` under the covariance of the noise."""


@dataclass(frozen=True)
class Prior:
    """Expectation of some values before any recording is seen, their steps and bounds, `(F,)` each.

    Attributes:
        mean: Expected values.
        deviation: Standard deviations of that expectation.
        step: Steps of the finite differences.
        lower: Smallest values.
        upper: Largest values.
    """

    mean: np.ndarray
    deviation: np.ndarray
    step: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def select(self, places: np.ndarray) -> Prior:
        """Return the expectation of the values at some places."""
        return Prior(**{one.name: getattr(self, one.name)[places] for one in fields(self)})

    @property
    def precision(self) -> np.ndarray:
        """Inverse variances, `(F,)`."""
        return 1.0 / self.deviation**2

    def pull(self, values: np.ndarray) -> np.ndarray:
        """Return how strongly the expectation draws the values back, `(F,)`."""
        return (self.mean - values) * self.precision

    def find_free(self, values: np.ndarray, downhill: np.ndarray) -> np.ndarray:
        """Return the places of the values that are free to move: not pushed against a bound.

        A step that takes them along is clipped, and no longer one downhill for the others. The square sums
        of two servos in MuJoCo C stayed at 11,000 and 8,400 so; without them they end at 37.
        """
        is_lowest = (values <= self.lower) & (downhill < 0.0)
        is_highest = (values >= self.upper) & (downhill > 0.0)
        return np.flatnonzero(~(is_lowest | is_highest))


def find_slopes(
    simulate: Simulate, values: np.ndarray, prior: Prior
) -> tuple[np.ndarray, np.ndarray]:
    """Return the increments at some values `(F,)`, `(N,)`, and their slopes over the values, `(F, N)`."""
    fits = values + prior.step <= prior.upper
    steps = np.where(fits, prior.step, -prior.step)
    found = simulate(np.concatenate([values[None], values + np.diag(steps)])).astype(float)
    return found[0], (found[1:] - found[0]) / steps[:, None]


def descend(
    simulate: Simulate,
    target: np.ndarray,
    multiply: Multiply,
    values: np.ndarray,
    prior: Prior,
    rounds: int,
) -> np.ndarray:
    """Return the likeliest values after some rounds from `values` on, `(F,)`.

    Args:
        simulate: Increments of trials.
        target: Recorded increments, `(N,)`.
        multiply: Products of increments.
        values: Where to begin, `(F,)`.
        prior: What is known before.
        rounds: Most rounds.
    """
    damping = 1e-3
    has_moved = True
    for _ in range(rounds):
        if has_moved:
            base, slopes = find_slopes(simulate, values, prior)
        downhill = multiply(slopes, (target - base)[None])[:, 0] + prior.pull(values)
        free = prior.find_free(values, downhill)
        normal = multiply(slopes[free], slopes[free]) + np.diag(prior.precision[free])
        trials = np.repeat(values[None], NUM_DAMPINGS, 0)
        for k, trial in enumerate(trials):
            damped = normal + damping * DAMPING_RATIO**k * np.diag(np.diag(normal))
            trial[free] += np.linalg.solve(damped, downhill[free])
        trials = np.clip(trials, prior.lower, prior.upper)
        errors = target - np.concatenate([base[None], simulate(trials)])
        off = (np.concatenate([values[None], trials]) - prior.mean) / prior.deviation
        costs = np.diagonal(multiply(errors, errors)) + np.square(off).sum(1)
        best = int(np.argmin(costs[1:]))
        gain = costs[0] - costs[1 + best]
        has_moved = gain > 0.0
        if not has_moved:
            damping *= DAMPING_RATIO**NUM_DAMPINGS
            continue
        values = trials[best]
        damping *= DAMPING_RATIO**best / 6.0
        if gain < ENOUGH * costs[0]:
            break
    return values
