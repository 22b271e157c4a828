"""Bootstrap over blocks of windows: poses and oil change slowly, so that neighbours hang together.

Draws are weights of windows, `(1 + B, W)`. The first row is the sample itself.
Axes: `B` draws, `W` windows, `J` joints.
"""

from __future__ import annotations

import numpy as np

from diagnosis.closure import Estimate

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
