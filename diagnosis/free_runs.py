"""Free runs of a simulator beside the recordings from which they were cut.

Regime labels are made on whole recordings and then cut like the free runs, so that they know the
time before a window. Axes: `W` windows, `K` steps, `J` joints, `T` rows of a recording.
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

    @property
    def num_windows(self) -> int:
        """Number of windows, `W`."""
        return len(self.row)

    def cut(self, values: Sequence[np.ndarray]) -> np.ndarray:
        """Return the part of each recording's values, `(T, …)`, that lies in each window, `(W, K, …)`; NaN after the end."""
        steps = self.simulated.shape[1]
        found = np.full((self.num_windows, steps, *values[0].shape[1:]), np.nan)
        for window, (source, row) in enumerate(zip(self.source, self.row, strict=True)):
            part = values[source][row : row + steps]
            found[window, : len(part)] = part
        return found

    @cached_property
    def measured(self) -> np.ndarray:
        """Measured positions, `(W, K, J)`, NaN after the end of the recording."""
        return self.cut([recording.q for recording in self.recordings])

    @cached_property
    def error(self) -> np.ndarray:
        """Simulated less measured, `(W, K, J)`, NaN after the end of the recording."""
        return self.simulated - self.measured
