"""What is recorded of the motion: encoders with a zero, a scale, noise and a converter, and a tracker that sees the tool."""

from __future__ import annotations

import numpy as np

from exam.plants.anatomy import Anatomy

TRACKER_M = 0.0015
"""Noise of the measured tool point, m."""
TRACKER_RAD = 0.001
"""Noise of its measured pitch, rad."""


class Encoders:
    """Positions as they are logged.

    Args:
        numbers: The machine's, `(N, J)`.
        period_s: Control period.
    """

    def __init__(self, numbers: Anatomy, period_s: float) -> None:
        self._n = numbers
        self._part = numbers["stamp_s"] / period_s
        self._sigma = np.hypot(numbers["noise_rad"], numbers["extra_noise_rad"])
        self._step = np.maximum(numbers["step_rad"], 1e-9)

    def read(self, now: np.ndarray, before: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Returns what is stamped with the present time.

        Args:
            now: Positions that the encoders are at, `(N, J)`.
            before: Those one period ago: a late stamp shows some of them.
            noise: Normal random numbers, `(N, J)`.
        """
        n = self._n
        late = now + self._part * (before - now)
        shown = n["scale"] * late + n["bias_rad"] + self._sigma * noise
        return np.where(n["step_rad"] > 0, (np.floor(shown / self._step) + 0.5) * self._step, shown)
