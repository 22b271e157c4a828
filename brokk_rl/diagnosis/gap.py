"""How far: errors of free runs before and after, the floor, and the share of the gap that is closed.

Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from math import factorial

import numpy as np

from brokk_rl.diagnosis.answer import Estimate

DRAWS = 1000
BLOCK = 4
"""Windows in a row that are drawn together: poses and oil change slowly."""
SIGNIFICANT = 1.1
"""Error over floor below which there is no gap whose share could be told."""


def squares(paths: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Returns the mean square error of each window, all joints together, `(W,)`."""
    return np.square(paths - measured).mean((1, 2))


def rmse(square: np.ndarray) -> float:
    """Returns the root of the mean over windows."""
    return float(np.sqrt(square.mean()))


def closed(before: np.ndarray, after: np.ndarray, floor: np.ndarray, generator: np.random.Generator) -> Estimate | None:
    """Returns the share of the gap that is closed, with the interval of a bootstrap over blocks of windows.

    Args:
        before: Mean square errors of field windows, `(W,)`.
        after: The same after repair.
        floor: Of reference windows.
        generator: Draws the blocks.
    """
    share = _share(rmse(before), rmse(after), rmse(floor))
    if rmse(before) < SIGNIFICANT * rmse(floor):
        return None
    drawn = []
    for _ in range(DRAWS):
        field, base = (_draw(len(values), generator) for values in (before, floor))
        drawn.append(_share(rmse(before[field]), rmse(after[field]), rmse(floor[base])))
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return Estimate(share, (float(min(low, share)), float(max(high, share))))


def shapley(names: Sequence[str], closed_by: Callable[[frozenset[str]], float]) -> dict[str, float]:
    """Returns what each effect closes: the mean over all orders of adding them."""
    count, found = len(names), dict.fromkeys(names, 0.0)
    value = {frozenset(s): closed_by(frozenset(s)) for size in range(count + 1) for s in combinations(names, size)}
    for name in names:
        for size in range(count):
            chance = factorial(size) * factorial(count - size - 1) / factorial(count)
            for rest in combinations([n for n in names if n != name], size):
                found[name] += chance * (value[frozenset(rest) | {name}] - value[frozenset(rest)])
    return found


def _share(before: float, after: float, floor: float) -> float:
    floor = min(floor, after)  # no repair is better than the floor: where it is, the floor was measured on harder recordings
    return float((before - after) / max(before - floor, 0.02 * before + 1e-12))


def _draw(count: int, generator: np.random.Generator) -> np.ndarray:
    starts = generator.integers(0, max(1, count - BLOCK + 1), size=-(-count // BLOCK))
    return np.concatenate([np.arange(start, min(start + BLOCK, count)) for start in starts])
