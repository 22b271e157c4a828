"""How far: errors of free runs before and after, the floor, and the share of the gap that is closed.

Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.answer import Estimate

DRAWS = 1000
BLOCK = 4
"""Windows in a row that are drawn together: poses and oil change slowly."""
SIGNIFICANT = 1.1
"""Error over floor below which there is no gap whose share could be told."""


def unit_of(machine: Machine) -> str:
    """Returns the unit of errors of all joints together: that of the joints, or `travel`, the joint's, where they differ."""
    units = {joint.unit for joint in machine.joints}
    return units.pop() if len(units) == 1 else "travel"


def squares(paths: np.ndarray, measured: np.ndarray, machine: Machine) -> np.ndarray:
    """Returns the mean square error of each window, all joints together, `(W,)`, in the square of `unit_of`."""
    size = machine.upper - machine.lower if unit_of(machine) == "travel" else 1.0
    return np.square((paths - measured) / size).mean((1, 2))


def draws(
    field: int, floor: int, generator: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns windows of field and floor in bootstraps over blocks, as many as each has."""
    return [(_draw(field, generator), _draw(floor, generator)) for _ in range(DRAWS)]


def shares(
    before: np.ndarray,
    after: np.ndarray,
    floor: np.ndarray,
    drawn: Sequence[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Returns the share of the gap that is closed, then the same of each draw, `(1 + B,)`."""
    found = [_share(rmse(before), rmse(after), rmse(floor))]
    return np.array(
        found + [_share(rmse(before[f]), rmse(after[f]), rmse(floor[g])) for f, g in drawn]
    )


def estimate(values: np.ndarray) -> Estimate:
    """Returns the first of values `(1 + B,)` with the 95 % interval of the others."""
    low, high = np.nanquantile(values[1:], [0.025, 0.975])
    return Estimate(float(values[0]), (float(min(low, values[0])), float(max(high, values[0]))))


def rmse(square: np.ndarray) -> float:
    """Returns the root of the mean over windows."""
    return float(np.sqrt(square.mean()))


def closed(
    before: np.ndarray, after: np.ndarray, floor: np.ndarray, generator: np.random.Generator
) -> Estimate | None:
    """Returns the share of the gap that is closed, with the interval of a bootstrap over blocks of windows.

    Args:
        before: Mean square errors of field windows, `(W,)`.
        after: The same after repair.
        floor: Of reference windows.
        generator: Draws the blocks.
    """
    if rmse(before) < SIGNIFICANT * rmse(floor):
        return None
    return estimate(shares(before, after, floor, draws(len(before), len(floor), generator)))


def shapley(names: Sequence[str], closed_by: Callable[[frozenset[str]], Any]) -> dict[str, Any]:
    """Returns what each effect closes, a number or an array of them: the mean over all orders of adding them."""
    count, found = len(names), dict.fromkeys(names, 0.0)
    value = {
        frozenset(s): closed_by(frozenset(s))
        for size in range(count + 1)
        for s in combinations(names, size)
    }
    for name in names:
        for size in range(count):
            chance = factorial(size) * factorial(count - size - 1) / factorial(count)
            for rest in combinations([n for n in names if n != name], size):
                found[name] += chance * (value[frozenset(rest) | {name}] - value[frozenset(rest)])
    return found


def _share(before: float, after: float, floor: float) -> float:
    floor = min(
        floor, after
    )  # no repair is better than the floor: where it is, the floor was measured on harder recordings
    return float((before - after) / max(before - floor, 0.02 * before + 1e-12))


def _draw(count: int, generator: np.random.Generator) -> np.ndarray:
    starts = generator.integers(0, max(1, count - BLOCK + 1), size=-(-count // BLOCK))
    return np.concatenate([np.arange(start, min(start + BLOCK, count)) for start in starts])
