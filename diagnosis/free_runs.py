"""Free runs of a simulator beside the recordings from which they were cut.

Axes: `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.record import Recording


@dataclass(frozen=True)
class WindowedRuns:
    """Free runs, each begun at a measured position.

    Attributes:
        recordings: Where the windows come from.
        source: Number of the recording of each window, `(W,)`.
        row: Row of its first simulated position, `(W,)`; the row before is the measured one that it
            starts at.
        simulated: Positions, `(W, K, J)`, rad or m.
        measured: Measured positions, `(W, K, J)`.
    """

    recordings: Sequence[Recording]
    source: np.ndarray
    row: np.ndarray
    simulated: np.ndarray
    measured: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Simulated less measured, `(W, K, J)`."""
        return self.simulated - self.measured
