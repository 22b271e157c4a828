"""Effects as changes of a plant's numbers: rows of `faults.yaml`, or a function where a row does not say it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from brokk_rl.errors import ConfigError, list_choices

PlantParameters = dict[str, np.ndarray]
"""Numbers of a machine by name, `(J,)` each, or `(N, J)` of several side by side."""
FaultSizes = Mapping[str, np.ndarray]
"""Numbers of an effect by name, `(J,)`, at the value that changes nothing where a joint lacks it."""
Change = Callable[[PlantParameters, FaultSizes], None]
"""Changes the plant's numbers in place."""


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
    """Return what only an effect changes, as a plant without effects has it, and the change of each effect."""
    told = yaml.safe_load(Path(__file__).with_name("faults.yaml").read_text())[plant]
    changes = {effect: partial(change_by, rows) for effect, rows in told["effects"].items()}
    return told["neutral"], changes


def change_by(rows: Sequence[Sequence[str]], numbers: PlantParameters, size: FaultSizes) -> None:
    """Change a plant's numbers by rows: the number, a way of `COMBINE`, and the number of the effect."""
    for own, how, name in rows:
        numbers[own] = COMBINE[how](numbers[own], size[name])


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
        table[effect](found, size)
    return found
