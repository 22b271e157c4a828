"""Laws by which commands are held: lost frames, and frames that each come late by a time of their own.

Axes: `K` delays, in steps of a sample or of a part of one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

CHANCES = (1e-4, 0.95)
"""Chances that a law may have."""


@dataclass(frozen=True)
class LossLaw:
    """Frames are lost: the delay grows with each lost frame and ends at once.

    Attributes:
        begins: Chance that a frame is lost after one that came.
        lasts: Chance that a frame is lost after a lost one.
    """

    begins: float
    lasts: float
    effect: ClassVar[str] = "frame_loss"
    parts: ClassVar[int] = 1

    @classmethod
    def count(cls, counts: np.ndarray) -> LossLaw:
        """Return the law under which samples have delays as often as `counts` says, `(K,)`."""
        lost = float(counts[1:].sum())
        begins = float(counts[1]) / max(float(counts[0]), 1.0)
        lasts = float(counts[2:].sum()) / max(lost, 1.0)
        return cls(float(np.clip(begins, *CHANCES)), float(np.clip(lasts, *CHANCES)))

    @property
    def persistence(self) -> float:
        """Rise of the chance of a loss after a lost frame, as in `FrameLoss`; 0 where each is lost by itself."""
        return max(self.lasts - self.begins, 0.0)

    @property
    def probability(self) -> float:
        """Share of frames that are lost."""
        return self.begins / (1.0 - self.lasts + self.begins)

    def list_chances(self, num_delays: int, period_s: float) -> np.ndarray:
        """Return the chance that a delay (first axis) is followed by another one (second), `(K, K)`."""
        steps = np.arange(num_delays)
        chances = np.zeros((num_delays, num_delays))
        chances[1:, 0] = 1.0 - self.lasts
        chances[steps[1:-1], steps[2:]] = self.lasts
        chances[0, :2] = (1.0 - self.begins, self.begins)
        return chances


@dataclass(frozen=True)
class JitterLaw:
    """Each frame is late by a time of its own, uniform from 0 on; no frame overtakes another.

    Attributes:
        longest_s: Longest delay.
        parts: Into how many steps a sample is divided; a frame that comes late by a part of it leaves
            the mean of two targets.
    """

    longest_s: float
    parts: int = 1
    effect: ClassVar[str] = "delay_jitter"

    def list_chances(self, num_delays: int, period_s: float) -> np.ndarray:
        """Return the chance that a delay (first axis) is followed by another one (second), `(K, K)`."""
        longest = self.longest_s / period_s * self.parts
        edges = np.clip(np.arange(num_delays + 1) - 0.5, 0.0, longest)
        shares = np.diff(edges) / (edges[-1] - edges[0])
        chances = np.zeros((num_delays, num_delays))
        for delay in range(num_delays):
            most = min(delay + self.parts, num_delays - 1)
            chances[delay, : most + 1] = shares[: most + 1]
            chances[delay, most] += shares[most + 1 :].sum()
        return chances


HoldLaw = LossLaw | JitterLaw
