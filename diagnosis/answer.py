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

from pydantic import TypeAdapter, ValidationError

from brokk_rl.errors import RecordingError
from brokk_rl.session import write_json
from diagnosis.closure import Estimate, Gap, Gate, RivalError
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
    """An effect, `none` or `unknown`, and how probable it is that it is there."""

    effect: str
    joints: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class RegimeGap:
    """Share of the gap that arises in one joint in one regime of its motion."""

    joint: str
    regime: str
    share: float


@dataclass(frozen=True)
class Where:
    """Where the gap lies.

    Attributes:
        joints: Of each joint the root mean square error of the simulator as it was (`rmse_rad`), of the
            unchanged machine (`floor_rad`) and of the repaired simulator (`after_rad`), in m for a joint
            that slides, and its `share` of the squared errors beyond the floor, over the travel.
        regimes: The largest shares first.
        stage: Part of the way from command to estimate on which the first named effect acts.
    """

    joints: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    regimes: tuple[RegimeGap, ...] = ()
    stage: Stage | None = None


@dataclass(frozen=True)
class NextExperiment:
    """The excitation or the measurement that tells effects apart, and which ones."""

    excitation: str
    separates: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The answer of a diagnosis, the content of `diagnosis.json`.

    Attributes:
        verdict: `effects`; `none` when no effect earns its place; `unknown` when the gap is real
            and nothing of the library explains it, or the recordings do not allow to tell.
        selected: Most probable first; empty unless the verdict is `effects`.
        ranking: What is named, `none` or `unknown`, and the rivals; the most probable first.
        gap: Its size, and the remainder.
        where: Where it lies.
        rivals: Errors of simple rivals on the windows of the gap, by name.
        gates: Conditions of the verdict.
        next_experiment: `None` where nothing is left to tell apart.
        reason: One sentence in words.
        more: Further plain JSON: `sanity`, `evidence`, `changes`.
    """

    verdict: Verdict
    selected: tuple[Selected, ...]
    ranking: tuple[Ranked, ...]
    gap: Gap | None
    where: Where = field(default_factory=Where)
    rivals: Mapping[str, RivalError] = field(default_factory=dict)
    gates: tuple[Gate, ...] = ()
    next_experiment: NextExperiment | None = None
    reason: str = ""
    more: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`."""
        found = TypeAdapter(Answer).dump_python(self, mode="json")
        more = found.pop("more")
        return {"schema": SCHEMA, **found, **more}

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
        known = {"schema", *(one.name for one in dataclasses.fields(Answer))}
        more = {key: value for key, value in found.items() if key not in known}
        return TypeAdapter(Answer).validate_python({**found, "more": more})
    except (AttributeError, KeyError, TypeError, ValidationError) as error:
        raise RecordingError(
            f"{where}: no diagnosis: something is missing or of another kind ({error})"
        ) from error


@dataclass(frozen=True)
class Outcome:
    """A finished diagnosis with the free runs that its report draws.

    Attributes:
        answer: The answer.
        before: Free runs of the simulator as it was through field recordings that no effect was
            fitted to.
        after: The same with the selected effects; `None` where none was selected.
    """

    answer: Answer
    before: WindowedRuns
    after: WindowedRuns | None


def format_error(value: float, unit: str) -> str:
    """Return an error as text: in mrad or mm, or in percent of travel where units differ."""
    return f"{100 * value:.1f} % of travel" if unit == "travel" else f"{1e3 * value:.1f} m{unit}"
