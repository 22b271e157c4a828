"""Effects as changes of a plant's numbers: rows of `faults.yaml`, or a function where a row does not say it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import yaml

from brokk_rl.errors import ConfigError, list_choices

PlantParameters = dict[str, np.ndarray]
"""Numbers of a machine by name, `(J,)` each, or `(N, J)` of several side by side."""
FaultSizes = Mapping[str, np.ndarray]
"""Numbers of an effect by name, `(J,)`, at the value that changes nothing where a joint lacks it."""
Row = tuple[str, Callable[[np.ndarray, np.ndarray], np.ndarray], str]
"""Number of the plant, how it changes, and the number of the effect that it changes by."""
Change = tuple[Row, ...] | Callable[[PlantParameters, FaultSizes], None]
"""Rows, or a function that changes the plant's numbers in place."""


def replace_by(own: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the effect's number."""
    return size


def add_share(own: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return an overlap beyond which a command of `size` more is needed before the land opens."""
    return own + size * (1.0 - own)


COMBINE: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "add": np.add,
    "multiply": np.multiply,
    "minimum": np.minimum,
    "maximum": np.maximum,
    "replace": replace_by,
    "add_share": add_share,
}
"""Ways in which a row of `faults.yaml` changes a number."""


def read_faults(plant: str) -> tuple[dict[str, float], dict[str, Change]]:
    """Return what only an effect changes, as a plant without effects has it, and the rows of each effect."""
    told = yaml.safe_load(Path(__file__).with_name("faults.yaml").read_text())[plant]
    changes: dict[str, Change] = {}
    for effect, rows in told["effects"].items():
        changes[effect] = tuple((own, COMBINE[how], size) for own, how, size in rows)
    return told["neutral"], changes


def apply_changes(
    numbers: PlantParameters,
    faults: Mapping[str, FaultSizes],
    table: Mapping[str, Change],
    title: str,
) -> PlantParameters:
    """Return a machine's numbers with faults.

    Args:
        numbers: Of the machine without them.
        faults: Sizes by effect.
        table: Change by effect.
        title: The make, as messages name it.

    Raises:
        ConfigError: the make cannot have a fault.
    """
    found = {name: value.copy() for name, value in numbers.items()}
    for effect, size in faults.items():
        if effect not in table:
            raise ConfigError(f"exam: {title} lacks '{effect}'; {list_choices(effect, table)}")
        change = table[effect]
        if callable(change):
            change(found, size)
            continue
        for name, combine, number in change:
            found[name] = combine(found[name], size[number])
    return found
