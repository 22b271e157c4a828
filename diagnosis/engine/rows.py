"""A row of the table: an effect in one of its forms and sizes, as changes of a joint's numbers.

Rows outside the library stand beside it. Where one of them, or a flexible column of `generic`,
explains the field better than any effect, the cause is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Change = tuple[str, str, float]
"""A number, how it changes, and by what: `add`, `scale` (times `1 + value`), `least` (raised to it), or
`set`."""


@dataclass(frozen=True)
class Row:
    """One effect in one form and size.

    Attributes:
        effect: Its name in the registry, or that of a cause outside of it.
        changes: Changes that make it.
        sizes: Which of the changes grow with its size; the first of them is the size.
    """

    effect: str
    changes: tuple[Change, ...]
    sizes: tuple[int, ...] = (0,)

    @property
    def size(self) -> float:
        """The size, in the unit of the first number that it changes."""
        return self.changes[self.sizes[0]][2]

    @property
    def shapes(self) -> list[tuple[int]]:
        """Places of the changes that are searched one by one beside the size."""
        found = []
        for place, (name, _, value) in enumerate(self.changes):
            if place not in self.sizes and name not in FIXED and value != 0.0:
                found.append((place,))
        return found

    def resize(self, factor: float, places: tuple[int, ...] = ()) -> Row:
        """Return the same row with the changes at some places, or its size, `factor` times as large."""
        changes = list(self.changes)
        for place in places or self.sizes:
            name, how, value = changes[place]
            changes[place] = (name, how, _limit(name, value * factor))
        return Row(self.effect, tuple(changes), self.sizes)


FIXED = frozenset({"thermal_grows", "load_alone", "load_constant"})
"""Numbers that choose a form; no size of them is searched."""
CEILINGS = {"stop_ratio": 0.97, "damping": 0.7, "thermal_s": 700.0, "firmware_damping": 1.0}
FLOORS = {"thermal_s": 10.0}


def _limit(name: str, value: float) -> float:
    return float(np.clip(value, FLOORS.get(name, -np.inf), CEILINGS.get(name, np.inf)))


def spread_sizes(low: float, high: float, count: int) -> list[float]:
    """Return sizes at equal ratios."""
    return np.geomspace(low, high, count).tolist()


def mirror_sizes(sizes: Sequence[float]) -> list[float]:
    """Return sizes with both signs."""
    return [sign * size for size in sizes for sign in (-1.0, 1.0)]


SHARED = frozenset({"flow_sharing", "pump_lag", "thermal_drift"})
"""Rows with one size for all joints: they have one pump and one oil."""
