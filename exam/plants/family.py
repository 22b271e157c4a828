"""Bases of all makes: a link to machines side by side, and a family that draws them from seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.signals import Command, JointState
from brokk_rl.spec import NonNegative, Range, spec
from exam.plants.changes import Change, PlantParameters
from exam.plants.linkage import Arm

TRACKER_SPREAD = (0.0015, 0.0015, 0.0015, 0.001)
"""Standard deviation of the measured tool point, m, and of its pitch, rad; chosen by hand."""
TRACKED = ("ee_x_m", "ee_y_m", "ee_z_m", "ee_pitch_rad")


SEVERITY = "severity"
"""Parameter of a cause outside the library, `(J,)`: 0 not at all, 1 plainly."""


@dataclass(frozen=True)
class PlantRun:
    """One run of one machine.

    Attributes:
        seed: The machine: same seed, same machine.
        roughness: Name of how much of the machine no tidy model has (`mild`, `strong`).
        chance: Seed of the run's own chance.
        elapsed_s: Time the machine has run before.
        day: Number of the day of the run; the machine ages from day to day.
        faults: Effects it has, by name: parameters in the library's words, `(J,)` each; and its causes
            outside the library, with their `SEVERITY`.
        tracked: Whether its tool point is measured.
    """

    seed: int
    roughness: str
    chance: int
    elapsed_s: float
    day: int = 0
    faults: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    tracked: bool = False


@dataclass(frozen=True)
class PlantBatch:
    """Runs of machines of one make, side by side.

    Attributes:
        machine: Geometry, masses, limits.
        make: Of all machines.
        runs: The runs.
        numbers: Of each run's machine.
        steps: Control periods of the longest run.
    """

    machine: Machine
    make: str
    runs: Sequence[PlantRun]
    numbers: Sequence[PlantParameters]
    steps: int

    def place_causes(self, causes: Sequence[str]) -> dict[str, np.ndarray]:
        """Return the severity of each cause outside the library, `(N, J)`, 0 in runs that lack it."""
        shape = (len(self.runs), self.machine.num_joints)
        found = {cause: np.zeros(shape) for cause in causes}
        for number, run in enumerate(self.runs):
            for cause in run.faults.keys() & found.keys():
                found[cause][number] = run.faults[cause][SEVERITY]
        return found


def share(values: Mapping[str, float], machine: Machine) -> PlantParameters:
    """Return numbers that all joints share."""
    return {name: np.full(machine.num_joints, value) for name, value in values.items()}


class PlantLink:
    """A `Link` to simulated machines, `N` runs side by side.

    Args:
        batch: The runs and their machines.
        chance: Random numbers of each run by name, drawn beforehand: a run does not depend on its neighbours.
    """

    def __init__(self, batch: PlantBatch, chance: Sequence[Mapping[str, np.ndarray]]) -> None:
        self._machine, self._k = batch.machine, 0
        self._chance = {name: np.stack([one[name] for one in chance], 1) for name in chance[0]}
        names = batch.numbers[0]
        self._n = {name: np.stack([one[name] for one in batch.numbers]) for name in names}
        self._arm: Arm | None = None  # whose tool is measured
        self._elapsed_s = np.array([run.elapsed_s for run in batch.runs], dtype=float)
        self._tracked = np.array([run.tracked for run in batch.runs])

    @property
    def q(self) -> np.ndarray:
        """True positions of the links, `(N, J)`."""
        raise NotImplementedError

    def read(self) -> JointState:
        """Return the present readings of the encoders."""
        return JointState(self._k * self._machine.period_s, self._measure())

    def send(self, command: Command) -> Command:
        """Move on by one control period with these commands, `(N, J)`."""
        self._move(np.asarray(command.u, dtype=float), self._k * self._machine.period_s)
        self._k += 1
        return command

    def _move(self, u: np.ndarray, t_s: float) -> None:
        """Move on by a control period with commands `(N, J)` that are sent `t_s` after the begin."""
        raise NotImplementedError

    def extra(self) -> Mapping[str, np.ndarray]:
        """Return the measured tool, NaN in runs without a tracker; empty where none has one."""
        if self._arm is None or not self._tracked.any():
            return {}
        tip_m, pitch_rad = self._arm.tool(self.q)
        seen = np.concatenate([tip_m, pitch_rad[:, None]], 1)
        noise = self._chance["tool"][self._k] * TRACKER_SPREAD
        seen = np.where(self._tracked[:, None], seen + noise, np.nan)
        return dict(zip(TRACKED, seen.T, strict=True))

    def _measure(self) -> np.ndarray:
        """Return the readings of the encoders, `(N, J)`."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass


@spec
class DrawnPlants:
    """Base of the specs in `conf/exam_plants`: machines of many makes, each drawn from its seed.

    Attributes:
        roughness: By name, size of the nuisances and of the ageing.
        ranges: Range of each number of a machine, uniform and by joint.
        nuisances: The same for numbers that the library has no model of; they grow with the roughness.
        shared: The same for numbers of pump and bus.
        ageing: By number, standard deviation of its relative change from day to day.
        outside_not_on: Joints on which nothing of a fault outside the library would be seen, by its name.
        makes: Names of its makes.
        stream: Word of the stream of chance that draws machines.
        table: Change of the numbers by effect.
        causes: Faults outside the library.
    """

    roughness: dict[str, float]
    ranges: dict[str, Range]
    nuisances: dict[str, Range]
    shared: dict[str, Range]
    ageing: dict[str, NonNegative]
    outside_not_on: dict[str, tuple[str, ...]]
    makes: ClassVar[tuple[str, ...]]
    stream: ClassVar[str]
    table: ClassVar[Mapping[str, Change]]
    causes: ClassVar[tuple[str, ...]]

    def draw(self, machine: Machine, run: PlantRun) -> tuple[str, PlantParameters]:
        """Return make and numbers of a run's machine, aged and with its faults.

        Raises:
            ConfigError: the roughness is unknown, or the family cannot be drawn here.
        """
        if run.roughness not in self.roughness:
            raise ConfigError(
                f"exam: no roughness '{run.roughness}' in exam.plants.roughness; "
                f"{list_choices(run.roughness, self.roughness)}"
            )
        roughness, count = self.roughness[run.roughness], machine.num_joints
        generator = np.random.default_rng([run.seed, *self.stream.encode()])
        make = self.makes[int(generator.integers(len(self.makes)))]
        numbers: PlantParameters = {}
        for name, span in self.ranges.items():
            numbers[name] = generator.uniform(*span, count)
        for name, span in self.nuisances.items():
            numbers[name] = roughness * generator.uniform(*span, count)
        numbers |= self.complete(numbers, machine, make, generator)
        of_day = np.random.default_rng([run.seed, run.day, *b"ageing"])
        for name, spread in self.ageing.items():
            aged = roughness * spread * of_day.standard_normal(count)
            numbers[name] = numbers[name] * np.exp(aged)
        for effect, size in run.faults.items():
            if effect not in self.causes:
                self.table[effect](numbers, size)
        return make, numbers

    def complete(
        self, drawn: PlantParameters, machine: Machine, make: str, chance: np.random.Generator
    ) -> PlantParameters:
        """Return the numbers that are not drawn from a range by joint.

        Args:
            drawn: Those that are.
            machine: Geometry, masses, limits.
            make: Of the machine.
            chance: Draws them.

        Raises:
            ConfigError: the family cannot be drawn for this machine.
        """
        raise NotImplementedError

    def link(self, batch: PlantBatch) -> PlantLink:
        """Return the link to runs of one make."""
        raise NotImplementedError

    def build(
        self, machine: Machine, runs: Sequence[PlantRun], run_s: float
    ) -> list[tuple[list[int], PlantLink]]:
        """Return the runs of each make, side by side: their places and the link; raises as `draw`."""
        numbers, places = [], {}
        for place, run in enumerate(runs):
            make, of_run = self.draw(machine, run)
            numbers.append(of_run)
            places.setdefault(make, []).append(place)
        steps, found = round(run_s / machine.period_s), []
        for make, mine in sorted(places.items()):
            parts = ([runs[i] for i in mine], [numbers[i] for i in mine])
            found.append((mine, self.link(PlantBatch(machine, make, *parts, steps))))
        return found
