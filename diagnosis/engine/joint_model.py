"""A joint model as data: a table of numbers, one row each, with prior, ageing and bounds.

A joint takes commands and measured poses and gives its path. It never takes its own measured motion.
The joints therefore decouple, and a poor model cannot run away. An effect is a change of some
numbers; those that a healthy machine does not need are 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np

from diagnosis.engine.descent import Prior
from diagnosis.engine.hold_laws import HoldLaw
from diagnosis.engine.rows import Row


@dataclass(frozen=True)
class JointNumber:
    """One number of a joint.

    Attributes:
        name: Its name, with its unit where it has one.
        mean: Expected value before any recording is seen; 0 for one that healthy joints lack.
        deviation: Standard deviation of that expectation; 0: it is not fitted to the reference.
        step: Step of the finite difference.
        ageing: Standard deviation of its change between reference and field.
        lower: Smallest value.
        upper: Largest value.
        is_relative: Its ageing is in proportion to its value.
        joins: From which fit to the reference on it is free, 0 to 2; before, it keeps the value that it began with.
    """

    name: str
    mean: float = 0.0
    deviation: float = 0.0
    step: float = 0.0
    ageing: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    is_relative: bool = False
    joins: int = 0


def repeat_number(count: int, number: JointNumber) -> list[JointNumber]:
    """Return a number `count` times, named in turn."""
    return [replace(number, name=f"{number.name}_{i}") for i in range(1, count + 1)]


COMMAND_NAMES = (
    "slope_time_s",
    "command_lag_s",
    "filling_s",
    "pilot_lag_s",
    "log_closing_ratio",
    "closing_lag_s",
    "spool_lag_s",
    "hysteresis",
)
"""Numbers on the way of the command to the spool; every model begins with them."""


@dataclass(frozen=True)
class JointModel:
    """Numbers of a kind of joint, and how its recordings are read.

    Attributes:
        numbers: Those of `COMMAND_NAMES` first.
        rows: Effects of the library in each form and size.
        outside_rows: Causes outside the library.
        own_forms: Numbers of the rows that no effect of the registry has in this form.
        lags: Numbers that delay the motion behind a command, and by how much of their value.
        hold_laws: Laws by which commands are held.
        late: Numbers that are known better once all joints are fitted, with the values before.
        substep_s: Longest step of the simulation.
        interval_s: Time of an increment of the measure.
        settling_s: At the beginning of a recording the commands before it are unknown.
        fit_rounds: Most rounds of the three fits to the reference.
        integrates: A command is a speed: errors of the speed add up. Otherwise it is a target, and the
            level of the error says something too.
    """

    numbers: tuple[JointNumber, ...]
    rows: tuple[Row, ...]
    outside_rows: tuple[Row, ...]
    own_forms: frozenset[tuple[str, ...]]
    lags: Mapping[str, float]
    hold_laws: tuple[HoldLaw, ...]
    late: Mapping[str, float]
    substep_s: float
    interval_s: float
    settling_s: float
    fit_rounds: tuple[int, int, int]
    integrates: bool
    names: tuple[str, ...] = field(init=False)
    place: dict[str, int] = field(init=False)
    fitted: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        names = tuple(number.name for number in self.numbers)
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "place", {name: place for place, name in enumerate(names)})
        fitted = [number.deviation > 0.0 for number in self.numbers]
        object.__setattr__(self, "fitted", np.flatnonzero(fitted))

    def list_values(self, name: str) -> np.ndarray:
        """Return one field of all numbers, `(P,)`."""
        return np.array([getattr(number, name) for number in self.numbers])

    def list_fitted(self, name: str) -> np.ndarray:
        """Return one field of the fitted numbers, `(F,)`."""
        return self.list_values(name)[self.fitted]

    @cached_property
    def prior(self) -> Prior:
        """Expectation of the fitted numbers before any recording is seen."""
        names = [one.name for one in fields(Prior)]
        return Prior(**{name: self.list_fitted(name) for name in names})

    def list_ageing(self, numbers: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the ageing of the fitted numbers of a joint `(P,)`, `(F,)`."""
        is_relative = self.list_fitted("is_relative")
        return self.list_fitted("ageing") * np.where(is_relative, numbers[self.fitted], 1.0)

    def change(self, numbers: np.ndarray, rows: Sequence[Row]) -> np.ndarray:
        """Return the numbers `(P,)` changed by each row, `(C, P)`."""
        found = np.repeat(numbers[None], len(rows), 0)
        for values, row in zip(found, rows, strict=True):
            for name, how, value in row.changes:
                place = self.place[name]
                if how == "add":
                    values[place] += value
                elif how == "scale":
                    number = self.numbers[place]
                    values[place] = np.clip(
                        values[place] * (1.0 + value), number.lower, number.upper
                    )
                elif how == "set":
                    values[place] = value
                else:
                    values[place] = max(values[place], value)
        return found


def list_places(numbers: Sequence[JointNumber]) -> Any:
    """Return the place of each number as a constant of the kernels."""
    return IntEnum("Place", [(one.name.upper(), place) for place, one in enumerate(numbers)])
