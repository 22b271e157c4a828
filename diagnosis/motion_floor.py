"""Error that the unchanged machine would show under the field's own motion.

The error of a simulator grows with the motion: a field of long, fast strokes has a larger error
than a tame reference, whatever the machine. The fitted noise of each joint gives the expected
square of the error for any motion. The reference, on recordings outside of the fit, gives the ratio
of the actual to the expected square. Their product is the floor.
Axes: `B` draws, `W` windows, `I` increments, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.bootstrap import draw_weights
from diagnosis.error_covariance import ErrorCovariance
from diagnosis.residual_model import MAX_STRAY
from diagnosis.residuals import Residuals


def expect_squares(noise: Sequence[ErrorCovariance], increments: np.ndarray) -> np.ndarray:
    """Return the expected mean square of the position's error in each window, `(W, J)`.

    Args:
        noise: Of each joint.
        increments: Those of the simulator, `(W, I, J)`.
    """
    columns = []
    for j, one in enumerate(noise):
        columns.append(one.strayed(increments[..., j]).mean(1))
    return np.stack(columns, -1)


def measure_squares(residuals: Residuals) -> np.ndarray:
    """Return the mean square of the position's error in each window, `(W, J)`."""
    return np.square(residuals.base - residuals.simulator.cut.measured).mean(1)


@dataclass(frozen=True, eq=False)
class LeftOutErrors:
    """Errors of a simulator on recordings left out of its fit.

    Attributes:
        actual: Mean squares of its windows, `(W, J)`.
        expected: What the noise lets expect there, `(W, J)`.
        hold: Mean squares of standing still there, `(W, J)`.
    """

    actual: np.ndarray
    expected: np.ndarray
    hold: np.ndarray

    def draw_ratios(self, weights: np.ndarray) -> np.ndarray:
        """Return the actual over the expected mean square of draws of windows `(1 + B, W)`, `(1 + B, J)`.

        A window that strays further than `MAX_STRAY` counts no more than this: a few windows that
        fail for another reason must not decide the floor.
        """
        actual = np.minimum(self.actual, MAX_STRAY * self.expected)
        return (weights @ actual) / np.maximum(weights @ self.expected, 1e-18)


def collect_left_out(parts: Sequence[Residuals]) -> LeftOutErrors:
    """Return the errors on all parts, one after the other."""
    actual, expected, hold = [], [], []
    for part in parts:
        assert part.noise is not None, "noise is known by now"
        actual.append(measure_squares(part))
        expected.append(expect_squares(part.noise, part.increments))
        still = part.start[:, None] - part.simulator.cut.measured
        hold.append(np.square(still).mean(1))
    return LeftOutErrors(*(np.concatenate(one) for one in (actual, expected, hold)))


def draw_floor(
    left_out: LeftOutErrors,
    noise: Sequence[ErrorCovariance],
    increments: np.ndarray,
    weights: np.ndarray,
    generator: np.random.Generator,
) -> np.ndarray:
    """Return mean squares at the floor for draws of field windows, `(1 + B, J)`.

    Args:
        left_out: Errors on the reference; their windows are drawn too.
        noise: Of each joint.
        increments: Motion of the repaired simulator in the field, `(W, I, J)`.
        weights: Draws of field windows, `(1 + B, W)`.
        generator: Draws windows of the reference.
    """
    ratios = left_out.draw_ratios(draw_weights(len(left_out.actual), generator))
    return ratios * (weights @ expect_squares(noise, increments))
