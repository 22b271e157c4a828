"""Electronics of the plants: command frames on the bus, encoders, and the tracker of the tool."""

from __future__ import annotations

import numpy as np

from exam.plants.plant_parameters import PlantParameters

NUM_FRAMES = 64
"""Frames on their way: 3.2 s at 20 Hz, more than any delay."""


class CommandBus:
    """Command frames: sent once a period, delivered late and in order, in force until the next.

    Args:
        numbers: `transport_s`, `jitter_s`, `loss`, each `(N, J)`.
        period_s: Time between two frames.
    """

    def __init__(self, numbers: PlantParameters, period_s: float) -> None:
        self._numbers, self._period_s = numbers, period_s
        shape = numbers["transport_s"].shape
        self._u = np.zeros((NUM_FRAMES, *shape))
        self._due_s = np.full((NUM_FRAMES, *shape), -np.inf)
        self._sent, self._seen = 0, np.zeros(shape, dtype=int)

    def send(
        self, u: np.ndarray, t_s: float, luck: np.ndarray, late: np.ndarray, later_s: np.ndarray
    ) -> None:
        """Send a frame.

        Args:
            u: Commands, `(N, J)`.
            t_s: Now.
            luck: In [0, 1), `(N, 1)`: a frame below the share of loss never arrives.
            late: In [0, 1), `(N, 1)`: how much of the longest jitter this frame has.
            later_s: Further delay of this frame, `(N, J)`.
        """
        numbers = self._numbers
        before, slot = self._sent % NUM_FRAMES, (self._sent + 1) % NUM_FRAMES
        due_s = t_s + numbers["transport_s"] + numbers["jitter_s"] * late + later_s
        lost = luck < numbers["loss"]
        self._u[slot] = np.where(lost, self._u[before], u)  # a lost frame says nothing new
        self._due_s[slot] = np.maximum(due_s, self._due_s[before])  # none overtakes another
        self._sent += 1

    def at(self, t_s: float) -> np.ndarray:
        """Return the commands in force at `t_s`, `(N, J)`; times may only grow."""
        following = np.minimum(self._seen + 1, self._sent)
        arrived = np.take_along_axis(self._due_s, (following % NUM_FRAMES)[None], 0)[0] <= t_s
        self._seen = np.where(arrived, following, self._seen)
        return np.take_along_axis(self._u, (self._seen % NUM_FRAMES)[None], 0)[0]


class Encoders:
    """Positions as they are logged.

    Args:
        numbers: The machine's, `(N, J)`.
        period_s: Control period.
    """

    def __init__(self, numbers: PlantParameters, period_s: float) -> None:
        self._n = numbers
        self._part = numbers["stamp_s"] / period_s
        self._sigma = np.hypot(numbers["noise_rad"], numbers["extra_noise_rad"])
        self._step = np.maximum(numbers["step_rad"], 1e-9)

    def read(self, now: np.ndarray, before: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the readings with the present time stamp.

        Args:
            now: Positions that the encoders are at, `(N, J)`.
            before: Those one period ago: a late stamp shows some of them.
            noise: Normal random numbers, `(N, J)`.
        """
        n = self._n
        late = now + self._part * (before - now)
        shown = n["scale"] * late + n["bias_rad"] + self._sigma * noise
        return np.where(n["step_rad"] > 0, (np.floor(shown / self._step) + 0.5) * self._step, shown)
