"""Effects as changes of a plant's numbers: rows of `faults.yaml`, or a function where a row does not say it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import yaml

PlantParameters = dict[str, np.ndarray]
"""Numbers of a machine by name, `(J,)` each, or `(N, J)` of several side by side."""
FaultSizes = Mapping[str, np.ndarray]
"""Numbers of an effect by name, `(J,)`, at the value that changes nothing where a joint lacks it."""
Change = Callable[[PlantParameters, FaultSizes], None]
"""Changes the plant's numbers in place."""


COMBINE: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "add": np.add,
    "multiply": np.multiply,
    "minimum": np.minimum,
    "maximum": np.maximum,
    "replace": lambda own, size: size,
    # an overlap beyond which a command of so much more is needed before the land opens
    "add_share": lambda own, size: own + size * (1.0 - own),
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
