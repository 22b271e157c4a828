"""Free runs of a simulator beside the recordings from which they were cut.

Axes: `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

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
    """

    recordings: Sequence[Recording]
    source: np.ndarray
    row: np.ndarray
    simulated: np.ndarray

    @cached_property
    def measured(self) -> np.ndarray:
        """Measured positions, `(W, K, J)`, NaN after the end of the recording."""
        found = np.full_like(self.simulated, np.nan)
        steps = self.simulated.shape[1]
        for window, (source, row) in enumerate(zip(self.source, self.row, strict=True)):
            part = self.recordings[source].q[row : row + steps]
            found[window, : len(part)] = part
        return found

    @cached_property
    def error(self) -> np.ndarray:
        """Simulated less measured, `(W, K, J)`, NaN after the end of the recording."""
        return self.simulated - self.measured
