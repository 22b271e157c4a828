"""The family of plants of an exam, as the config names it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from exam.plants import anatomy, strangers
from exam.plants.faults import FAULTS, afflicted
from exam.plants.plant import Plant
from exam.specimen import Specimen


@spec
class Valves:
    """Hydraulic arms of three makes (chambers, compensated, throttled), each machine with numbers and nuisances of its own.

    Attributes:
        roughness: By name, how much hysteresis, waviness, wandering, droop and warm-up a machine
            has; calibrated numbers.
    """

    roughness: dict[str, float]

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that its plants can have."""
        return tuple(FAULTS)

    @property
    def ailments(self) -> tuple[str, ...]:
        """Names of what its plants can have that no library knows."""
        return strangers.KINDS

    def makes(self, machine: Machine, specimens: Sequence[Specimen]) -> list[str]:
        """Returns the make of each specimen."""
        return [anatomy.drawn(machine, specimen.seed, 1.0)[0] for specimen in specimens]

    def build(self, machine: Machine, specimens: Sequence[Specimen], run_s: float) -> Plant:
        """Returns specimens of one make, side by side.

        Raises:
            ConfigError: an effect, an ailment or a roughness is unknown.
        """
        found = []
        for specimen in specimens:
            if specimen.roughness not in self.roughness:
                raise ConfigError(
                    f"exam: no roughness '{specimen.roughness}' in exam.plants.roughness; "
                    f"{list_choices(specimen.roughness, self.roughness)}"
                )
            make, numbers = anatomy.drawn(
                machine, specimen.seed, self.roughness[specimen.roughness]
            )
            numbers = afflicted(numbers, specimen.faults)
            if specimen.ailment is not None:
                numbers["stranger"] = specimen.ailment.severity
            found.append((make, numbers))
        (make,) = {make for make, _ in found}
        return Plant(
            machine,
            make,
            [numbers for _, numbers in found],
            [specimen.ailment.kind if specimen.ailment else None for specimen in specimens],
            [specimen.chance for specimen in specimens],
            np.array([specimen.elapsed_s for specimen in specimens]),
            [specimen.tracked for specimen in specimens],
            round(run_s / machine.period_s),
        )
