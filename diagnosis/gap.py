"""Errors of all joints together, and shares of a gap that effects close.

Axes: `J` joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np

from brokk_rl.machine import Machine


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
    value = {}
    for size in range(count + 1):
        for some in combinations(names, size):
            value[frozenset(some)] = closed_by(frozenset(some))
    for name in names:
        for size in range(count):
            chance = factorial(size) * factorial(count - size - 1) / factorial(count)
            for rest in combinations([n for n in names if n != name], size):
                found[name] += chance * (value[frozenset(rest) | {name}] - value[frozenset(rest)])
    return found
