"""Numbers of a gap: errors before, after and at the floor, shares with intervals, rivals and gates.

`diagnosis.json` holds them field by field; pydantic writes and reads it. Names of errors end there with
their unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import SerializerFunctionWrapHandler, model_serializer, model_validator

RELATIVE_ROUNDING = 1e-9
"""Width of an interval, over the number, below which it is rounding of double precision."""


MIN_RESTORED = 0.5
"""Least rise of the error without an effect, over its Shapley value, at which the effect counts as
identified. Half: what replaces an effect then carries less than the effect. Chosen by hand."""


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval.

    Attributes:
        mean: The number.
        ci95: The interval; both ends are `mean` where none could be computed.
        at_bound: The fit ended at the bound of the number: the true one may lie beyond.
    """

    mean: float
    ci95: tuple[float, float]
    at_bound: bool = False

    @property
    def has_interval(self) -> bool:
        """True if the interval was computed, and its width is more than rounding."""
        return self.ci95[1] - self.ci95[0] > RELATIVE_ROUNDING * abs(self.mean)

    @model_serializer
    def _write(self) -> dict[str, Any]:
        """Return it as `diagnosis.json` holds it: without an interval where none could be computed."""
        found = {"mean": self.mean, "ci95": list(self.ci95) if self.has_interval else None}
        return found | ({"at_bound": True} if self.at_bound else {})

    @model_validator(mode="before")
    @classmethod
    def _read(cls, told: Any) -> Any:
        return {**told, "ci95": told["ci95"] or [told["mean"], told["mean"]]}


@dataclass(frozen=True)
class Gap:
    """Error of all joints over free runs on parts of the field that no effect was fitted to.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: Error that the unchanged machine would show under the field's own motion; without a
            reference that of an ARX on field recordings that it was not fitted to, or of the
            repaired simulator.
        closed: `(before - after) / (before - floor)`; above 1 where `after` is below the floor, which
            is an estimate and no bound; `None` where no effect is named.
        unit: `rad` or `m`; `travel` on a machine with joints of both kinds, whose errors are taken
            over their travel.
        floor_of: `reference` or `field`.
        reduced: `(before - after) / before`.
    """

    before: float
    after: float
    floor: float
    closed: Estimate | None
    unit: str = "rad"
    floor_of: str = "reference"
    reduced: Estimate | None = None

    @model_serializer(mode="wrap")
    def _write(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found = write(self)
        key = f"rmse_{found.pop('unit')}"
        for name in ("before", "after", "floor"):
            found[name] = {key: found[name]}
        return found

    @model_validator(mode="before")
    @classmethod
    def _read(cls, told: Any) -> Any:
        found = dict(told)
        for name in ("before", "after", "floor"):
            ((key, found[name]),) = told[name].items()
            found["unit"] = key.removeprefix("rmse_")
        return found


@dataclass(frozen=True)
class Gate:
    """A condition of a verdict.

    Attributes:
        name: Its name.
        passed: Whether it holds.
        value: The number that is judged; `None` where there is none.
        limit: Its limit.
        text: The finding in words, and the remedy where it failed.
    """

    name: str
    passed: bool
    value: float | None
    limit: float | None
    text: str


@dataclass(frozen=True)
class RivalError:
    """Error of a rival on the windows of the gap, all joints together and by joint; `None`: not to be had."""

    rmse: float | None
    joints: Mapping[str, float]
    unit: str = "rad"

    @model_serializer(mode="wrap")
    def _write(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found = write(self)
        return {f"rmse_{found.pop('unit')}": found.pop("rmse"), **found}

    @model_validator(mode="before")
    @classmethod
    def _read(cls, told: Any) -> Any:
        found = dict(told)
        for key in told:
            if key.startswith("rmse_"):
                found |= {"rmse": found.pop(key), "unit": key.removeprefix("rmse_")}
        return found
