"""What an exam asks of a family of plants. The family itself is a room's, and arrives through the config."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from brokk_rl.contracts.link import Link
from brokk_rl.machine import Machine


@dataclass(frozen=True)
class Ailment:
    """Something outside the library that a machine has.

    Attributes:
        kind: Its name in the family.
        severity: By joint, `(J,)`: 0 not at all, 1 plainly.
    """

    kind: str
    severity: np.ndarray


@dataclass(frozen=True)
class Specimen:
    """One run of one machine.

    Attributes:
        seed: The machine: same seed, same machine.
        roughness: Name of how much of the machine no tidy model has (`mild`, `strong`).
        chance: Seed of the run's own chance.
        elapsed_s: Time the machine has run before.
        faults: Effects it has, by name: parameters in the library's words, `(J,)` each.
        ailment: What it has besides that no library knows.
        tracked: Whether its tool point is measured.
    """

    seed: int
    roughness: str
    chance: int
    elapsed_s: float
    faults: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    ailment: Ailment | None = None
    tracked: bool = False


class PlantFamily(Protocol):
    """A spec in `conf/exam_plants`: machines of many makes, none of which shares equations with what is examined."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that its plants can have."""
        ...

    @property
    def ailments(self) -> tuple[str, ...]:
        """Names of what its plants can have that no library knows."""
        ...

    def makes(self, machine: Machine, specimens: Sequence[Specimen]) -> list[str]:
        """Returns the make of each specimen; those of one make can run side by side."""
        ...

    def build(self, machine: Machine, specimens: Sequence[Specimen], run_s: float) -> Link:
        """Returns a link to specimens of one make, side by side, that runs for `run_s`, with what else is measured as `extra()`."""
        ...
