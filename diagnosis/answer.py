"""The answer of a diagnosis (`diagnosis.json`), and the free runs that its report draws.

Effects, joints and parameters have the names of the effect registry. A reader may rely on the
fields of `Answer`; `Answer.more` holds further plain JSON.
Axes: `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from brokk_rl.errors import RecordingError
from brokk_rl.session import write_json
from diagnosis.closure import (
    Estimate,
    Gap,
    Gate,
    RivalError,
    read_estimate,
    read_gap,
    read_rivals,
    serialize_estimate,
)
from diagnosis.free_runs import WindowedRuns

SCHEMA = 1
ANSWER_FILE = "diagnosis.json"

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
            selected; they add up to `closed`. `None` for an effect that free runs do not show.
        same_as: Effects that these recordings cannot tell from it.
        decided_by: The measurement that would tell it from those of `same_as`.
        identified: Its removal from the repaired simulator restores the error; `None` where free
            runs do not show it.
        edit: The numbers of that test, plain JSON.
    """

    effect: str
    joints: tuple[str, ...]
    probability: float
    parameters: Mapping[str, Mapping[str, Estimate]]
    gap_closed: Estimate | None
    same_as: tuple[str, ...] = ()
    decided_by: str | None = None
    identified: bool | None = None
    edit: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Ranked:
    """A rival and how probable it is that it is there; they need not exclude each other."""

    effect: str
    joints: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class JointGap:
    """Error of one joint over free runs (rad or m), its floor, and its share of the gap."""

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
    """The most informative next excitation, and the effects that it separates."""

    excitation: str
    separates: tuple[str, ...]
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The answer of a diagnosis, the content of `diagnosis.json`.

    Attributes:
        verdict: `effects`; `none` when no effect earns its place; `unknown` when the gap is real
            and nothing of the library explains it, or the recordings do not allow to tell.
        selected: Most probable first; empty unless the verdict is `effects`.
        ranking: All rivals worth naming, `none` and `unknown` among them, most probable first.
        where: Where the gap lies.
        gap: Its size, and the remainder.
        next_experiment: `None` where nothing is left to tell apart.
        rivals: Errors of simple rivals on the windows of the gap, by name.
        gates: Conditions of the verdict.
        reason: One sentence in words.
        more: Further plain JSON: `sanity`, `evidence`, `unseen`
    """

    verdict: Verdict
    selected: tuple[Selected, ...]
    ranking: tuple[Ranked, ...]
    where: Where
    gap: Gap | None
    next_experiment: NextExperiment | None
    rivals: Mapping[str, RivalError] = field(default_factory=dict)
    gates: tuple[Gate, ...] = ()
    reason: str = ""
    more: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`."""
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
        gap, key = self.gap and self.gap.to_json(), self.gap.key if self.gap else "rmse_rad"
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "reason": self.reason,
            "selected": [_serialize_selected(one) for one in self.selected],
            "ranking": [_serialize_tuples(dataclasses.asdict(one)) for one in self.ranking],
            "where": where,
            "gap": gap,
            "rivals": {name: one.to_json(key) for name, one in self.rivals.items()},
            "gates": [dataclasses.asdict(one) for one in self.gates],
            "next_experiment": None
            if self.next_experiment is None
            else _serialize_tuples(dataclasses.asdict(self.next_experiment)),
            **self.more,
        }

    def write(self, path: Path) -> None:
        """Write `diagnosis.json` in one step.

        Raises:
            StorageError: it could not be written.
        """
        write_json(path, self.to_json())


def read_answer(path: Path) -> Answer:
    """Read a `diagnosis.json`.

    Raises:
        RecordingError: it is missing, no JSON, or of another schema.
    """
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read as a diagnosis ({error})") from error
    return parse_answer(found, f"{path}")


def parse_answer(found: Any, where: str) -> Answer:
    """Return the answer in the content of a `diagnosis.json`; `where` names it in messages.

    Raises:
        RecordingError: it is of another schema, or no diagnosis.
    """
    try:
        if found["schema"] != SCHEMA:
            raise RecordingError(f"{where}: schema {found['schema']}, expected {SCHEMA}")
        return _build_answer(found)
    except (KeyError, TypeError) as error:
        raise RecordingError(
            f"{where}: no diagnosis: {error!r} is missing or of another kind"
        ) from error


def _build_answer(found: dict[str, Any]) -> Answer:
    joints, units = {}, {}
    for name, gap in found["where"]["joints"].items():
        units[name] = "m" if "rmse_m" in gap else "rad"
        joints[name] = JointGap(
            gap[f"rmse_{units[name]}"], gap[f"floor_{units[name]}"], gap["share"]
        )
    where = Where(
        joints,
        tuple(RegimeGap(**one) for one in found["where"]["regimes"]),
        found["where"]["stage"],
        units,
    )
    gap = read_gap(found["gap"]) if found["gap"] else None
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
        rivals=read_rivals(found.get("rivals", {})),
        gates=tuple(Gate(**one) for one in found.get("gates", ())),
        next_experiment=following
        and NextExperiment(
            following["excitation"], tuple(following["separates"]), following.get("why", "")
        ),
        reason=found.get("reason", ""),
        more={key: value for key, value in found.items() if key not in known},
    )


def _serialize_selected(one: Selected) -> dict[str, Any]:
    return _serialize_tuples(dataclasses.asdict(one)) | {
        "parameters": {
            name: {joint: serialize_estimate(value) for joint, value in values.items()}
            for name, values in one.parameters.items()
        },
        "gap_closed": serialize_estimate(one.gap_closed),
    }


def _read_selected(one: dict[str, Any]) -> Selected:
    read = {
        "joints": tuple(one["joints"]),
        "parameters": _read_parameters(one["parameters"]),
        "gap_closed": read_estimate(one["gap_closed"]),
        "same_as": tuple(one["same_as"]),
    }
    return Selected(**one | read)


def _read_parameters(given: Mapping[str, Any]) -> dict[str, dict[str, Estimate]]:
    found: dict[str, dict[str, Estimate]] = {}
    for name, values in given.items():
        found[name] = {}
        for joint, value in values.items():
            if (estimate := read_estimate(value)) is not None:
                found[name][joint] = estimate
    return found


def _serialize_tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {
        key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()
    }


@dataclass(frozen=True)
class Outcome:
    """A finished diagnosis with the free runs that its report draws.

    Attributes:
        answer: The answer.
        before: Free runs of the simulator as it was through field recordings that no effect was
            fitted to.
        after: The same with the selected effects; `None` where none was selected.
        floor: The simulator's through reference recordings that it was not fitted to; `None`
            without any.
    """

    answer: Answer
    before: WindowedRuns
    after: WindowedRuns | None
    floor: WindowedRuns | None


def format_error(value: float, unit: str) -> str:
    """Return an error as text: in mrad or mm, or in percent of travel where units differ."""
    return f"{100 * value:.1f} % of travel" if unit == "travel" else f"{1e3 * value:.1f} m{unit}"
