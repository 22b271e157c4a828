"""Bases of all makes: a link to machines side by side, and a family that draws them from seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.signals import Command, JointState
from exam.plants.changes import Change, PlantParameters
from exam.plants.linkage import Arm

TRACKER_SPREAD = (0.0015, 0.0015, 0.0015, 0.001)
"""Standard deviation of the measured tool point, m, and of its pitch, rad; chosen by hand."""
TRACKED = ("ee_x_m", "ee_y_m", "ee_z_m", "ee_pitch_rad")


@dataclass(frozen=True)
class UnknownFault:
    """Something outside the library that a machine has.

    Attributes:
        kind: Its name in the family.
        severity: By joint, `(J,)`: 0 not at all, 1 plainly.
    """

    kind: str
    severity: np.ndarray


@dataclass(frozen=True)
class PlantRun:
    """One run of one machine.

    Attributes:
        seed: The machine: same seed, same machine.
        roughness: Name of how much of the machine no tidy model has (`mild`, `strong`).
        chance: Seed of the run's own chance.
        elapsed_s: Time the machine has run before.
        faults: Effects it has, by name: parameters in the library's words, `(J,)` each.
        outside_fault: Its fault outside the library.
        tracked: Whether its tool point is measured.
    """

    seed: int
    roughness: str
    chance: int
    elapsed_s: float
    faults: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    outside_fault: UnknownFault | None = None
    tracked: bool = False


class PlantLink:
    """A `Link` to simulated machines, `N` runs side by side.

    Args:
        machine: Geometry, masses, limits.
        parameters: Of each run's machine.
        runs: The runs.
        chance: Random numbers of each run, arrays by attribute.
    """

    def __init__(
        self,
        machine: Machine,
        parameters: Sequence[PlantParameters],
        runs: Sequence[PlantRun],
        chance: Sequence[Any],
    ) -> None:
        self._machine, self._chance, self._k = machine, chance, 0
        self._n = {name: np.stack([one[name] for one in parameters]) for name in parameters[0]}
        self._elapsed_s = np.array([run.elapsed_s for run in runs], dtype=float)
        self._tracked = np.array([run.tracked for run in runs])
        self._kinds = [run.outside_fault.kind if run.outside_fault else None for run in runs]

    @property
    def q(self) -> np.ndarray:
        """True positions of the links, `(N, J)`."""
        raise NotImplementedError

    def read(self) -> JointState:
        """Return the present readings of the encoders."""
        return JointState(self._k * self._machine.period_s, self._measure())

    def send(self, command: Command) -> Command:
        """Move on by one control period with these commands, `(N, J)`."""
        raise NotImplementedError

    def extra(self) -> Mapping[str, np.ndarray]:
        """Return the measured tool, NaN in runs without a tracker; empty where none has one."""
        arm = self._find_arm()
        if arm is None or not self._tracked.any():
            return {}
        tip_m, pitch_rad = arm.tool(self.q)
        seen = np.concatenate([tip_m, pitch_rad[:, None]], 1)
        noise = np.stack([chance.tool[self._k] for chance in self._chance])
        seen = np.where(self._tracked[:, None], seen + noise * TRACKER_SPREAD, np.nan)
        return dict(zip(TRACKED, seen.T, strict=True))

    def _measure(self) -> np.ndarray:
        """Return the readings of the encoders, `(N, J)`."""
        raise NotImplementedError

    def _find_arm(self) -> Arm | None:
        """Return the geometry whose tool is measured; `None` where it never is."""
        return None

    def _stack_chance(self, name: str) -> np.ndarray:
        """Return random numbers of all runs, the runs on the second axis."""
        return np.stack([getattr(one, name) for one in self._chance], 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass


class DrawnPlants:
    """Base of the specs in `conf/exam_plants`: machines of many makes, each drawn from its seed.

    Attributes:
        roughness: By name, size of the nuisances.
        outside_not_on: Joints on which nothing of a fault outside the library would be seen, by its name.
        table: Change of the parameters by effect.
        causes: Faults outside the library.
        link: Builds the link to runs of one make.
    """

    roughness: dict[str, float]
    outside_not_on: dict[str, tuple[str, ...]]
    table: ClassVar[Mapping[str, Change]]
    causes: ClassVar[tuple[str, ...]]
    link: ClassVar[Callable[..., PlantLink]]

    def check(self) -> None:
        for name in self.outside_not_on:
            if name not in self.causes:
                raise ConfigError(
                    f"exam.plants.outside_not_on: no cause '{name}'; {list_choices(name, self.causes)}"
                )

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that its plants can have."""
        return tuple(self.table)

    @property
    def outside_faults(self) -> tuple[str, ...]:
        """Names of the faults outside the library that its plants can have."""
        return self.causes

    def makes(self, machine: Machine, runs: Sequence[PlantRun]) -> list[str]:
        """Return the make of each run."""
        return [self.draw(machine, run, 1.0)[0] for run in runs]

    def draw(
        self, machine: Machine, run: PlantRun, roughness: float
    ) -> tuple[str, PlantParameters]:
        """Return make and parameters of a run's machine, with its faults."""
        raise NotImplementedError

    def build(self, machine: Machine, runs: Sequence[PlantRun], run_s: float) -> PlantLink:
        """Return runs of one make, side by side.

        Raises:
            ConfigError: an effect or a roughness is unknown, or the family cannot be drawn here.
        """
        makes, parameters = set(), []
        for run in runs:
            if run.roughness not in self.roughness:
                raise ConfigError(
                    f"exam: no roughness '{run.roughness}' in exam.plants.roughness; "
                    f"{list_choices(run.roughness, self.roughness)}"
                )
            make, numbers = self.draw(machine, run, self.roughness[run.roughness])
            if run.outside_fault is not None:
                numbers["outside_severity"] = run.outside_fault.severity
            makes.add(make)
            parameters.append(numbers)
        (make,) = makes
        return self.link(machine, make, parameters, runs, round(run_s / machine.period_s))
