"""Free runs of a simulator beside the recordings from which they were cut: errors, shares of effects, draws.

The bootstrap draws blocks of windows: poses and oil change slowly, so that neighbours hang together. Draws are
weights of windows, `(1 + B, W)`; the first row is the sample itself.
Axes: `B` draws, `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from math import comb
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.closure import Estimate


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


def choose_unit(machine: Machine) -> str:
    """Return the unit of errors of all joints together: that of the joints, or `travel`, the joint's, where they differ."""
    units = {joint.unit for joint in machine.joints}
    return units.pop() if len(units) == 1 else "travel"


def combine_joints(squares: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the root mean square over joints, `(…,)`, of mean squares `(…, J)`, in the unit of `choose_unit`."""
    size = machine.upper - machine.lower if choose_unit(machine) == "travel" else 1.0
    return np.sqrt((squares / np.square(size)).mean(-1))


def compute_shapley(
    names: Sequence[str], closed_by: Callable[[frozenset[str]], Any]
) -> dict[str, Any]:
    """Return the Shapley value of each effect, a number or an array: its mean contribution over all orders of adding."""
    count, found = len(names), dict.fromkeys(names, 0.0)
    value = cache(closed_by)
    for name in names:
        others = [one for one in names if one != name]
        for size in range(count):
            for some in map(frozenset, combinations(others, size)):
                chance = 1.0 / (count * comb(count - 1, size))
                found[name] += chance * (value(some | {name}) - value(some))
    return found


NUM_DRAWS = 1000
"""Draws; the ends of an interval then vary by 2 % of its width. Chosen by hand."""
BLOCK_WINDOWS = 4
"""Windows in a row that are drawn together, and that belong to one half of the field."""
MIN_BLOCKS = 4
"""Least number of blocks; with fewer windows blocks are shorter. Chosen by hand."""


def draw_weights(num_windows: int, generator: np.random.Generator) -> np.ndarray:
    """Return how often each window is drawn, `(1 + B, W)`, each row summing to 1.

    Blocks are circular, so that windows at the ends are drawn as often as others. With one window
    all draws are equal, and there is no interval.
    """
    size = max(1, min(BLOCK_WINDOWS, num_windows // MIN_BLOCKS))
    starts = generator.integers(0, num_windows, (NUM_DRAWS, -(-num_windows // size)))
    rows = (starts[..., None] + np.arange(size)).reshape(NUM_DRAWS, -1)[:, :num_windows]
    drawn = np.zeros((NUM_DRAWS, num_windows))
    np.add.at(drawn, (np.arange(NUM_DRAWS)[:, None], rows % num_windows), 1.0)
    return np.concatenate([np.ones((1, num_windows)), drawn]) / num_windows


def summarise_draws(values: np.ndarray) -> Estimate:
    """Return the first of values `(1 + B,)` with the 95 % interval of the others."""
    low, high = np.nanquantile(values[1:], [0.025, 0.975])
    return Estimate(float(values[0]), (float(min(low, values[0])), float(max(high, values[0]))))
