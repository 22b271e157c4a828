"""Frames on the simulated bus: when each command reaches the valve block, of each run and joint, exact to a time step."""

from __future__ import annotations

import numpy as np

from exam.plants.anatomy import Anatomy

KEPT = 64
"""Frames on their way; more than any delay holds."""


class Line:
    """Frames are sent once a control period, arrive after a delay of their own in order, and stay in force until the next arrives.

    Args:
        numbers: `transport_s`, `jitter_s`, `loss`, each `(N, J)`.
        period_s: Time between two frames.
    """

    def __init__(self, numbers: Anatomy, period_s: float) -> None:
        self._numbers, self._period_s = numbers, period_s
        shape = numbers["transport_s"].shape
        self._u = np.zeros((KEPT, *shape))
        self._due_s = np.full((KEPT, *shape), -np.inf)
        self._sent, self._seen = 0, np.zeros(shape, dtype=int)

    def send(
        self, u: np.ndarray, t_s: float, luck: np.ndarray, late: np.ndarray, later_s: np.ndarray
    ) -> None:
        """Sends a frame.

        Args:
            u: Commands, `(N, J)`.
            t_s: Now.
            luck: In [0, 1), `(N, 1)`: a frame below the share of loss never arrives.
            late: In [0, 1), `(N, 1)`: how much of the longest jitter this frame has.
            later_s: Further delay of this frame, `(N, J)`.
        """
        numbers = self._numbers
        before, slot = self._sent % KEPT, (self._sent + 1) % KEPT
        due_s = t_s + numbers["transport_s"] + numbers["jitter_s"] * late + later_s
        lost = luck < numbers["loss"]
        self._u[slot] = np.where(lost, self._u[before], u)  # a lost frame says nothing new
        self._due_s[slot] = np.maximum(due_s, self._due_s[before])  # none overtakes another
        self._sent += 1

    def at(self, t_s: float) -> np.ndarray:
        """Returns the commands in force at `t_s`, `(N, J)`; times may only grow."""
        following = np.minimum(self._seen + 1, self._sent)
        arrived = np.take_along_axis(self._due_s, (following % KEPT)[None], 0)[0] <= t_s
        self._seen = np.where(arrived, following, self._seen)
        return np.take_along_axis(self._u, (self._seen % KEPT)[None], 0)[0]
