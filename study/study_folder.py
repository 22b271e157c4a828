"""A study on disk: plan, trials, questionnaires, who stopped; and everything of it that is not as it should be, in words.

    plan.json                          the plan
    trials/<P>_<period>_<nn>.json      one trial: who, when, where, how it ended, and the name of
    its recording recordings/<P>_<period>_<nn>.parquet
    captures/<P>_<period>_<nn>/        the loop's whole recording: messages and frames of the bus
    questionnaires/<P>_<period>.json   NASA-TLX after a period
    participants/<P>.json              a participant's record: whether they stopped, and why

Nothing that is there is passed over in silence: a file that cannot be used, stands twice or is missing
becomes a remark.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from brokk_rl.errors import ConfigError, StorageError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.record import format_now
from brokk_rl.session import write_json
from study.design import PERIODS, Design, Trial

PLAN = "plan.json"
TRIALS, RECORDINGS, CAPTURES = "trials", "recordings", "captures"
QUESTIONNAIRES, PARTICIPANTS = "questionnaires", "participants"
NOTICE = "simulated operators: no person took part, and nothing here is evidence about people"
"""Notice on the plan, report and pictures of a simulated study."""


@dataclass(frozen=True)
class Remark:
    """Remark on the data that the report shows, such as a missing trial.

    Attributes:
        where: Participant or file.
        text: The problem, and how it was handled.
    """

    where: str
    text: str


@dataclass
class StudyData:
    """Content of a study's folder.

    Attributes:
        folder: The folder.
        plan: `plan.json`.
        design: The design of the plan.
        planned: The trials of the plan.
        trials: Trials that count, by participant, period and number.
        questionnaires: By participant and period.
        participants: Records of participants, by pseudonym.
        spare: Trials that are kept but do not count: doubled ones, those of the unknown, those
            whose condition was not the planned one.
        remarks: Deviations from the plan and from the expected files.
    """

    folder: Path
    plan: dict[str, Any]
    design: Design
    planned: list[Trial]
    trials: dict[tuple[str, int, int], dict[str, Any]] = field(default_factory=dict)
    questionnaires: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)
    participants: dict[str, dict[str, Any]] = field(default_factory=dict)
    spare: list[dict[str, Any]] = field(default_factory=list)
    remarks: list[Remark] = field(default_factory=list)

    @property
    def is_simulated(self) -> bool:
        """True if any trial comes from a simulated operator."""
        # One simulated entry marks the whole study: nobody must take it for evidence.
        return any(trial.get("simulated") for trial in (*self.trials.values(), *self.spare))

    @property
    def erased(self) -> dict[str, str]:
        """Erased participants, with the time."""
        return self.plan.get("erased", {})

    def require_participant(self, who: str) -> None:
        """Raise a `ConfigError` for a name that is not in the plan, or that was erased."""
        there = [name for name in self.plan["participants"] if name not in self.erased]
        if who not in there:
            raise ConfigError(
                f"study.participant={who}: no participant of the plan; {list_choices(who, there)}"
            )

    def note(self, where: str, text: str) -> None:
        """Add a remark."""
        self.remarks.append(Remark(where, text))


def read_study(folder: Path, machine: Machine | None = None) -> StudyData:
    """Read a study with all that is wrong with it; problems of the data are collected, not raised.

    Args:
        folder: The study's.
        machine: The machine that it has to be of; `None` for any.

    Raises:
        ConfigError: there is no plan, it cannot be read, or is of another machine.
    """
    if not (folder / PLAN).is_file():
        raise ConfigError(
            f"{folder} holds no study ({PLAN} is missing); give study.folder=<folder>, or plan one with study.do=plan"
        )
    plan = _read(folder / PLAN)
    try:
        if plan["schema"] != 2:
            raise ValueError(f"schema {plan['schema']}")
        planned = [Trial(**trial) for trial in plan["trials"]]
        data = StudyData(folder, plan, Design(**plan["design"]), planned)
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise ConfigError(
            f"{folder / PLAN}: expected a plan of schema 2 as study.do=plan writes it, got {error!r}; plan the study again"
        ) from error
    if machine is not None:
        machine.check_fingerprint(plan["fingerprint"], f"the study in {folder}")
    for name, entry in _iterate_entries(data, PARTICIPANTS):
        data.participants[str(entry.get("participant", name))] = entry
    _read_trials(data)
    _read_questionnaires(data)
    _note_missing(data)
    return data


def write_trial(folder: Path, name: str, trial: dict[str, Any]) -> Path:
    """Write the record of a trial; one that is there already stays, and this becomes a second one beside it."""
    path, again = folder / TRIALS / f"{name}.json", 2
    while path.exists():
        path = folder / TRIALS / f"{name}_again{again}.json"
        again += 1
    update_record(path, trial)
    return path


def update_record(path: Path, facts: dict[str, Any]) -> None:
    """Change the record of a trial, questionnaire or participant, or begin it; it holds no name and no address."""
    known = _read(path) if path.exists() else {"schema": 1, "created": format_now()}
    write_json(path, known | facts)


def erase(folder: Path, participant: str) -> list[Path]:
    """Delete every file about a participant, return their paths; the plan keeps an empty place that says so.

    Raises:
        ConfigError: the study has no such participant.
    """
    data = read_study(folder)
    data.require_participant(participant)
    gone = []
    for path in sorted(folder.glob("*/*")):
        is_named = path.name.startswith((f"{participant}_", f"{participant}."))
        if is_named or _is_about(path, participant):
            try:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            except OSError as error:
                raise StorageError(
                    f"cannot delete {path}: {error.strerror}; {len(gone)} files are gone, run it again"
                ) from error
            gone.append(path)
    # The plan keeps the place, so that the sequences of the others still make sense.
    write_json(folder / PLAN, data.plan | {"erased": data.erased | {participant: format_now()}})
    return gone


def _is_about(path: Path, participant: str) -> bool:
    """Return whether a file that was renamed by hand is about the participant."""
    try:
        return path.suffix == ".json" and _read(path).get("participant") == participant
    except (ConfigError, AttributeError):
        return False


def _read_trials(data: StudyData) -> None:
    # In the order of their making, so that the first of two counts.
    found = sorted(_iterate_entries(data, TRIALS), key=lambda item: str(item[1].get("created", "")))
    for name, trial in found:
        if problem := _find_problem(data, trial):
            data.note(name, problem)
            data.spare.append(trial)
        else:
            data.trials[trial["participant"], trial["period"], trial["number"]] = trial


def _find_problem(data: StudyData, trial: dict[str, Any]) -> str:
    """Return why a trial does not count, from the gravest reason to the mildest; empty if it does."""
    key = trial.get("participant"), trial.get("period"), trial.get("number")
    planned = [one.condition for one in data.planned if one.key == key]
    if not planned:
        return f"{key[0]}, period {key[1]}, trial {key[2]} is not in the plan; kept, but it does not count"
    if trial.get("condition") != planned[0]:
        return f"done {trial.get('condition')}, but planned {planned[0]}; it does not count"
    if key in data.trials:
        return "done twice: the first counts, since the second had more practice; the other is kept"
    if trial.get("outcome") == "aborted":
        reason = trial.get("reason", "no reason given")
        return f"aborted ({reason}); kept, but it does not count"
    return ""


def _read_questionnaires(data: StudyData) -> None:
    for name, entry in _iterate_entries(data, QUESTIONNAIRES):
        who, period = str(entry.get("participant")), entry.get("period")
        if who not in data.plan["participants"] or period not in PERIODS:
            data.note(
                name, f"of '{who}', period {period}, whom the plan does not know; not counted"
            )
        elif (who, period) in data.questionnaires:
            data.note(name, "a second questionnaire for the same period; the first one counts")
        else:
            data.questionnaires[who, period] = entry


def _note_missing(data: StudyData) -> None:
    for who in data.plan["participants"]:
        if who in data.erased:
            data.note(who, f"erased on request, {data.erased[who]}")
            continue
        # Practice has period 0 and need not be complete.
        planned = [one for one in data.planned if one.participant == who and one.period]
        lost = [f"{one.period}.{one.number}" for one in planned if one.key not in data.trials]
        num_done = len(planned) - len(lost)
        known = data.participants.get(who, {})
        if known.get("stopped"):
            reason = known.get("reason", "no reason given")
            data.note(who, f"stopped after {num_done} trials ({reason}); what was done is kept")
        if not num_done:
            data.note(who, "has no trials and is in no comparison")
        elif lost:
            data.note(
                who,
                f"{len(lost)} of {len(planned)} trials are missing (period.trial {', '.join(lost)});"
                " means are over the others",
            )
        for period in PERIODS:
            # Simulated operators have no workload.
            has_answers = data.is_simulated or (who, period) in data.questionnaires
            if num_done and not has_answers:
                data.note(who, f"no questionnaire for period {period}")


def _iterate_entries(data: StudyData, part: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for path in sorted((data.folder / part).glob("*.json")):
        try:
            entry = _read(path)
        except ConfigError as error:
            data.note(path.name, f"{error}; left out")
            continue
        if isinstance(entry, dict):
            yield path.name, entry
        else:
            data.note(path.name, "expected a JSON object; left out")


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error
