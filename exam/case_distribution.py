"""Distribution of the cases of an exam: kinds, effects, joints and sizes, drawn from a seed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import MinLen
from numpy.random import Generator

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Count, Range, spec
from exam.plants.family import SEVERITY, DrawnPlants

KINDS = ("none", "faint", "one", "several", "outside")
"""No gap; an effect too small to be seen; one effect; two or three; a fault outside the library."""


@spec
class EffectDistribution:
    """Distribution of the parameters and joints of an effect.

    Attributes:
        numbers: Parameter to its value that changes nothing and its typical value.
        shape: Parameters that only shape it, at the value they have.
        joints: `some` one or two, or `all` that can have it.
        not_on: Joints on which nothing of it would be seen.
        mirrored: The other sign is as likely.
        only_one: One of the numbers is drawn, the others change nothing.
        needs_tool: It cannot be seen without the measured tool point.
    """

    numbers: dict[str, tuple[float, float]]
    shape: dict[str, float]
    joints: Literal["some", "all"]
    not_on: tuple[str, ...]
    mirrored: bool
    only_one: bool
    needs_tool: bool


@dataclass(frozen=True)
class CaseFault:
    """One effect of a case, or its cause outside the library.

    Attributes:
        effect: Its name.
        joints: The joints that have it.
        size: Of typical.
        parameters: `(J,)` by name; those of a cause are its `SEVERITY`.
        drawn: The parameters that were drawn, and so can be asked for, with the value that changes
            nothing.
    """

    effect: str
    joints: tuple[str, ...]
    size: float
    parameters: dict[str, np.ndarray]
    drawn: dict[str, float]


@dataclass(frozen=True)
class CaseDesign:
    """One case before it is recorded.

    Attributes:
        kind: See `KINDS`.
        machine_seed: Draws the machine.
        chance: Draws everything else about its recordings.
        faults: Effects that the field has and the reference has not; of kind `outside` one cause.
        tracked: Whether the tool point is recorded.
    """

    kind: str
    machine_seed: int
    chance: int
    faults: tuple[CaseFault, ...] = ()
    tracked: bool = False


@spec
class CaseDistribution:
    """Kinds of cases and how effects are drawn.

    Attributes:
        num_cases: Cases in all.
        shares: Share of each kind.
        sizes: Range of sizes, of typical.
        faint_sizes: Range of sizes of effects that are too small to be seen.
        tracked_share: Part of the cases with measured tool point; those that need it have it.
        second_joint: Chance that another joint has an effect too.
        classes: Effects that commands and joint positions cannot tell apart; a case has one of each
            at most.
        troubles: How each effect is drawn; those that are not named do not occur.
    """

    num_cases: Count
    shares: dict[str, float]
    sizes: tuple[float, float]
    faint_sizes: tuple[float, float]
    tracked_share: float
    second_joint: float
    classes: tuple[tuple[str, ...], ...]
    troubles: Annotated[dict[str, EffectDistribution], MinLen(1)]

    def check(self) -> None:
        total = sum(self.shares.values())
        if set(self.shares) != set(KINDS) or not math.isclose(total, 1.0, abs_tol=1e-6):
            raise ConfigError(
                f"exam.mix.shares: expected {', '.join(KINDS)} with sum 1, got {self.shares}"
            )

    def questions(
        self, machine: Machine, plants: DrawnPlants, generator: Generator
    ) -> list[CaseDesign]:
        """Return the cases in random order; effects and outside faults are equally frequent."""
        kinds: list[str] = []
        for kind, count in self._counts().items():
            kinds += [kind] * count
        effects = _cycle_shuffled(list(self.troubles), generator)
        strange = _cycle_shuffled(list(plants.causes), generator)
        need_tool = [name for name, trouble in self.troubles.items() if trouble.needs_tool]
        found = []
        for kind in kinds:
            tracked = bool(generator.random() < self.tracked_share)
            faults: list[CaseFault] = []
            if kind in ("one", "faint"):
                sizes = self.faint_sizes if kind == "faint" else self.sizes
                faults = [self._fault(next(effects), machine, sizes, generator)]
            elif kind == "several":
                names = self._distinct(effects, int(generator.integers(2, 4)))
                faults = [self._fault(name, machine, self.sizes, generator) for name in names]
            elif kind == "outside":
                size = float(generator.uniform(*self.sizes))
                name = next(strange)
                hidden = np.isin(machine.joint_names, plants.outside_not_on.get(name, ()))
                # much of it shows in company only
                chosen = self._some(np.flatnonzero(~machine.is_exclusive & ~hidden), generator)
                has = np.isin(np.arange(machine.num_joints), chosen)
                joints = tuple(machine.joint_names[j] for j in chosen)
                faults = [CaseFault(name, joints, size, {SEVERITY: size * has}, {})]
            tracked = tracked or any(fault.effect in need_tool for fault in faults)
            machine_seed, chance = generator.integers(2**62, size=2).tolist()
            found.append(CaseDesign(kind, machine_seed, chance, tuple(faults), tracked))
        return [found[i] for i in generator.permutation(len(found))]

    def _counts(self) -> dict[str, int]:
        """Return the number of cases of each kind by largest remainders."""
        exact = {kind: self.shares[kind] * self.num_cases for kind in KINDS}
        counts = {kind: int(value + 1e-9) for kind, value in exact.items()}
        by_remainder = sorted(KINDS, key=lambda kind: counts[kind] - exact[kind])
        for kind in by_remainder[: self.num_cases - sum(counts.values())]:
            counts[kind] += 1
        return counts

    def _distinct(self, effects: Iterator[str], count: int) -> list[str]:
        found: list[str] = []
        while len(found) < count:
            name = next(effects)
            alike = [group for group in self.classes if name in group]
            if name not in found and all(set(group).isdisjoint(found) for group in alike):
                found.append(name)
        return found

    def _some(self, able: np.ndarray, generator: Generator) -> np.ndarray:
        count = 1 + (len(able) > 1 and generator.random() < self.second_joint)
        return np.sort(generator.choice(able, count, replace=False))

    def _fault(self, name: str, machine: Machine, sizes: Range, generator: Generator) -> CaseFault:
        trouble, size = self.troubles[name], float(generator.uniform(*sizes))
        able = np.flatnonzero(~np.isin(machine.joint_names, trouble.not_on))
        chosen = able if trouble.joints == "all" else self._some(able, generator)
        has = np.isin(np.arange(machine.num_joints), chosen)
        drawn = tuple(trouble.numbers)
        if trouble.only_one:
            drawn = (drawn[int(generator.integers(len(drawn)))],)
        sign = float(generator.choice([-1.0, 1.0])) if trouble.mirrored else 1.0
        parameters = {}
        for key, value in trouble.shape.items():
            parameters[key] = np.full(machine.num_joints, value)
        for key, (none, typical) in trouble.numbers.items():
            # where nothing changes a threshold is not there at all, rather than where it begins to
            # count
            away = none if none in (0.0, 1.0) else 0.0
            changed = none + sign * size * (typical - none)
            parameters[key] = np.where(has & (key in drawn), changed, away)
        nothing = {key: trouble.numbers[key][0] for key in drawn}
        joints = tuple(machine.joint_names[j] for j in chosen)
        return CaseFault(name, joints, size, parameters, nothing)


def _cycle_shuffled(names: list[str], generator: Generator) -> Iterator[str]:
    """Yield all names in random order, again and again."""
    while True:
        for i in generator.permutation(len(names)):
            yield names[i]
