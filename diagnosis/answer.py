"""`diagnosis.json`: the answer of a diagnosis as data.

Effects, joints and numbers have the names of the effect registry. Fields that a reader may rely on
stand here; `more` holds everything else that the diagnosis reports, as plain JSON.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.session import write_json


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    mean: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class JointClosed:
    """Error of one joint over 5 s free runs before, after and at the floor, rad or m, and what of it is closed.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: `None` without any.
        share: `1 - after / before`.
        closed: `(before - after) / (before - floor)`; `None` without a floor below `before`.
    """

    before: float
    after: float
    floor: float | None
    share: float
    closed: float | None


@dataclass(frozen=True)
class Gap:
    """Free-running error over 5 s on parts of the field recordings that were not fitted to, all joints together.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: What it would be without any effect: the simulator's on left-out reference
            recordings; without a reference that of a flexible model on field recordings that it was
            not fitted to; `None` where neither is known.
        closed: `(before - after) / (before - floor)`; `None` where there is no gap to close.
        unit: `rad` or `m`; `travel` on a machine with joints of both kinds, whose errors are taken
            over their travel.
        floor_of: `reference`, `flexible model`, or empty.
        joints: The same joint by joint.
    """

    before: float
    after: float
    floor: float | None
    closed: Estimate | None
    unit: str = "rad"
    floor_of: str = "reference"
    joints: Mapping[str, JointClosed] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Name of the errors in `diagnosis.json`."""
        return f"rmse_{self.unit}"


SCHEMA = 1
FILE = "diagnosis.json"

Verdict = Literal["effects", "none", "unknown"]
Stage = Literal["actuation", "sensing", "kinematics", "timing", "perception"]


@dataclass(frozen=True, kw_only=True)
class Selected:
    """An effect that the machine has and the simulator lacks.

    Attributes:
        effect: Its name.
        joints: Joints that have it, in machine order; empty for an effect of the whole machine.
        probability: That the effect, or one of its class (`same_as`), is there.
        parameters: By name and joint (`machine` for a number that joints do not have), in the unit
            that the name says.
        gap_closed: Share of the gap that it closes: its Shapley value in the set of all that are
            selected.
        same_as: Effects that these recordings cannot tell from it.
        decided_by: What would tell it from those of `same_as`.
    """

    effect: str
    joints: tuple[str, ...]
    probability: float
    parameters: Mapping[str, Mapping[str, Estimate]]
    gap_closed: Estimate | None
    same_as: tuple[str, ...] = ()
    decided_by: str | None = None


@dataclass(frozen=True)
class Ranked:
    """A rival and how probable it is that it is there; they need not exclude each other."""

    effect: str
    joints: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class JointGap:
    """Where the gap lies: error over 5 s free runs (rad or m), the floor, and the share of the whole gap, by joint."""

    rmse: float
    floor: float
    share: float


@dataclass(frozen=True)
class RegimeGap:
    """Share of the gap that a joint has in a regime."""

    joint: str
    regime: str
    share: float


@dataclass(frozen=True)
class Where:
    """Where the gap lies.

    Attributes:
        joints: By joint, with its unit.
        regimes: The largest shares first.
        stage: On which part of the way from command to estimate; `None` where nothing is to be
            said.
    """

    joints: Mapping[str, JointGap]
    regimes: tuple[RegimeGap, ...]
    stage: Stage | None
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class NextExperiment:
    """The excitation that would tell most about what is left open, and between which effects."""

    excitation: str
    separates: tuple[str, ...]
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The whole answer.

    Attributes:
        verdict: `effects`; `none` when no effect earns its place; `unknown` when the gap is real
            and nothing of the library explains it, or the recordings do not allow to tell.
        selected: Most probable first; empty unless the verdict is `effects`.
        ranking: All rivals worth naming, `none` and `unknown` among them, most probable first.
        where: Where the gap lies.
        gap: How large it is, and what is left.
        next_experiment: `None` where nothing is left to tell apart.
        reason: One sentence for people.
        more: Further plain JSON: `sanity`, `horizons`, `evidence`, `remainder`, …
    """

    verdict: Verdict
    selected: tuple[Selected, ...]
    ranking: tuple[Ranked, ...]
    where: Where
    gap: Gap | None
    next_experiment: NextExperiment | None
    reason: str = ""
    more: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Returns the content of `diagnosis.json`."""
        where = {
            "joints": {
                name: {
                    f"rmse_{self.where.units.get(name, 'rad')}": gap.rmse,
                    f"floor_{self.where.units.get(name, 'rad')}": gap.floor,
                    "share": gap.share,
                }
                for name, gap in self.where.joints.items()
            },
            "regimes": [dataclasses.asdict(regime) for regime in self.where.regimes],
            "stage": self.where.stage,
        }
        gap = self.gap and {
            **{
                name: {self.gap.key: getattr(self.gap, name)}
                for name in ("before", "after", "floor")
            },
            "closed": None if self.gap.closed is None else _estimate(self.gap.closed),
            "floor_of": self.gap.floor_of,
            "joints": {name: dataclasses.asdict(one) for name, one in self.gap.joints.items()},
        }
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "reason": self.reason,
            "selected": [_selected(one) for one in self.selected],
            "ranking": [_listed(dataclasses.asdict(one)) for one in self.ranking],
            "where": where,
            "gap": gap,
            "next_experiment": None
            if self.next_experiment is None
            else _listed(dataclasses.asdict(self.next_experiment)),
            **self.more,
        }

    def write(self, path: Path) -> None:
        """Writes `diagnosis.json` in one step.

        Raises:
            StorageError: it could not be written.
        """
        try:
            write_json(path, self.to_json())
        except OSError as error:
            raise StorageError(f"cannot write {path}: {error.strerror or error}") from error


def read(path: Path) -> Answer:
    """Reads a `diagnosis.json`.

    Raises:
        RecordingError: it is missing, no JSON, or of another schema.
    """
    try:
        found = json.loads(path.read_text())
        if found["schema"] != SCHEMA:
            raise RecordingError(f"{path}: schema {found['schema']}, expected {SCHEMA}")
        return _answer(found)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read as a diagnosis ({error})") from error
    except (KeyError, TypeError) as error:
        raise RecordingError(
            f"{path}: no diagnosis: {error!r} is missing or of another kind"
        ) from error


def _answer(found: dict[str, Any]) -> Answer:
    joints, units = {}, {}
    for name, gap in found["where"]["joints"].items():
        units[name] = "m" if "rmse_m" in gap else "rad"
        joints[name] = JointGap(
            gap[f"rmse_{units[name]}"], gap[f"floor_{units[name]}"], gap["share"]
        )
    where = Where(
        joints,
        tuple(
            RegimeGap(one["joint"], one["regime"], one["share"])
            for one in found["where"]["regimes"]
        ),
        found["where"]["stage"],
        units,
    )
    gap = _read_gap(found["gap"]) if found["gap"] else None
    following = found.get("next_experiment")
    known = {"schema", *(one.name for one in dataclasses.fields(Answer))}
    return Answer(
        verdict=found["verdict"],
        selected=tuple(_read_selected(one) for one in found["selected"]),
        ranking=tuple(
            Ranked(one["effect"], tuple(one["joints"]), one["probability"])
            for one in found["ranking"]
        ),
        where=where,
        gap=gap,
        next_experiment=following
        and NextExperiment(
            following["excitation"], tuple(following["separates"]), following.get("why", "")
        ),
        reason=found.get("reason", ""),
        more={key: value for key, value in found.items() if key not in known},
    )


def _read_gap(given: dict[str, Any]) -> Gap:
    key = next(iter(given["before"]))
    before, after, floor = (given[name][key] for name in ("before", "after", "floor"))
    joints = {name: JointClosed(**one) for name, one in given.get("joints", {}).items()}
    floor_of = given.get("floor_of", "reference")
    return Gap(
        before,
        after,
        floor,
        _read_estimate(given["closed"]),
        key.removeprefix("rmse_"),
        floor_of,
        joints,
    )


def _selected(one: Selected) -> dict[str, Any]:
    return {
        "effect": one.effect,
        "joints": list(one.joints),
        "probability": one.probability,
        "parameters": {
            name: {joint: _estimate(value) for joint, value in values.items()}
            for name, values in one.parameters.items()
        },
        "gap_closed": None if one.gap_closed is None else _estimate(one.gap_closed),
        "same_as": list(one.same_as),
        "decided_by": one.decided_by,
    }


def _read_selected(one: dict[str, Any]) -> Selected:
    return Selected(
        effect=one["effect"],
        joints=tuple(one["joints"]),
        probability=one["probability"],
        parameters={
            name: {
                joint: Estimate(value["mean"], tuple(value["ci95"]))
                for joint, value in values.items()
            }
            for name, values in one["parameters"].items()
        },
        gap_closed=_read_estimate(one["gap_closed"]),
        same_as=tuple(one["same_as"]),
        decided_by=one.get("decided_by"),
    )


def _estimate(value: Estimate) -> dict[str, Any]:
    return {"mean": value.mean, "ci95": list(value.ci95)}


def _read_estimate(value: dict[str, Any] | None) -> Estimate | None:
    return None if value is None else Estimate(value["mean"], tuple(value["ci95"]))


def _listed(fields: dict[str, Any]) -> dict[str, Any]:
    return {
        key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()
    }
