"""Numbers of a gap: errors before, after and at the floor, shares with intervals, rivals and gates."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

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


@dataclass(frozen=True)
class JointClosed:
    """Error of one joint over free runs, in rad or m, and the closed share of its gap.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: Of the unchanged machine under the field's motion.
        share: `1 - after / before`.
        closed: `(before - after) / (before - floor)`; `None` without a floor below `before`.
    """

    before: float
    after: float
    floor: float
    share: float
    closed: float | None


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
        joints: The same joint by joint.
        reduced: `(before - after) / before`.
    """

    before: float
    after: float
    floor: float
    closed: Estimate | None
    unit: str = "rad"
    floor_of: str = "reference"
    joints: Mapping[str, JointClosed] = field(default_factory=dict)
    reduced: Estimate | None = None

    @property
    def key(self) -> str:
        """Name of the errors in `diagnosis.json`."""
        return f"rmse_{self.unit}"

    def to_json(self) -> dict[str, Any]:
        """Return the field `gap` of `diagnosis.json`."""
        errors = {name: {self.key: getattr(self, name)} for name in ("before", "after", "floor")}
        return {
            **errors,
            "closed": serialize_estimate(self.closed),
            "reduced": serialize_estimate(self.reduced),
            "floor_of": self.floor_of,
            "joints": {name: dataclasses.asdict(one) for name, one in self.joints.items()},
        }


def read_gap(given: Mapping[str, Any]) -> Gap:
    """Return the gap of a `diagnosis.json`; earlier ones have no `reduced`."""
    key = next(iter(given["before"]))
    before, after, floor = (given[name][key] for name in ("before", "after", "floor"))
    return Gap(
        before,
        after,
        floor,
        read_estimate(given["closed"]),
        key.removeprefix("rmse_"),
        given.get("floor_of", "reference"),
        {name: JointClosed(**one) for name, one in given.get("joints", {}).items()},
        read_estimate(given.get("reduced")),
    )


def serialize_estimate(value: Estimate | None) -> dict[str, Any] | None:
    """Return a number as plain JSON data; `ci95` is null where no interval could be computed."""
    if value is None:
        return None
    found = {"mean": value.mean, "ci95": list(value.ci95) if value.has_interval else None}
    return found | ({"at_bound": True} if value.at_bound else {})


def read_estimate(value: Mapping[str, Any] | None) -> Estimate | None:
    """Return the number of `serialize_estimate`."""
    if value is None:
        return None
    low, high = value["ci95"] or (value["mean"], value["mean"])
    return Estimate(value["mean"], (low, high), bool(value.get("at_bound")))


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
    reason: str = ""

    def to_json(self, key: str) -> dict[str, Any]:
        """Return plain JSON data; `key`: name of the error of all joints."""
        found: dict[str, Any] = {key: self.rmse, "joints": dict(self.joints)}
        return found | ({"reason": self.reason} if self.reason else {})


def read_rivals(given: Mapping[str, Any]) -> dict[str, RivalError]:
    """Return the rivals of a `diagnosis.json`."""
    found = {}
    for name, one in given.items():
        rmse = next((value for key, value in one.items() if key.startswith("rmse_")), None)
        found[name] = RivalError(rmse, one.get("joints", {}), one.get("reason", ""))
    return found
