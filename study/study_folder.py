"""A study on disk: plan, trials, questionnaires, who stopped; and everything of it that is not as it should be, in words.

    plan.json                          the plan
    trials/<P>_<period>_<nn>.json      one trial: who, when, where, how it ended, and the name of
    its recording recordings/<P>_<period>_<nn>.parquet
    captures/<P>_<period>_<nn>/        the loop's whole recording: messages and frames of the bus
    questionnaires/<P>_<period>.json   NASA-TLX after a period
    participants/<P>.json              a participant's record: whether they stopped, and why
    reports.json                       where reports were written, for who wants to be forgotten

Nothing that is there is passed over in silence: a file that cannot be used, stands twice or is missing
becomes a remark.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from brokk_rl.errors import ConfigError, StorageError, list_choices
from brokk_rl.session import write_json
from study.design import CONDITIONS, PERIODS

PLAN, REPORTS = "plan.json", "reports.json"
TRIALS, RECORDINGS, QUESTIONNAIRES, PARTICIPANTS = (
    "trials",
    "recordings",
    "questionnaires",
    "participants",
)
CAPTURES = "captures"
TRIAL_FIELDS = {
    "participant": str,
    "period": int,
    "condition": str,
    "number": int,
    "hole": dict,
    "limit_s": (int, float),
}
"""Required fields of a trial."""


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
        trials: Trials that count, by participant, period and number.
        questionnaires: By participant and period.
        participants: Records of participants, by pseudonym.
        spare: Trials that are kept but do not count: doubled ones, those of the unknown, those
            whose condition was not the planned one.
        remarks: Deviations from the plan and from the expected files.
    """

    folder: Path
    plan: dict[str, Any]
    trials: dict[tuple[str, int, int], dict[str, Any]] = field(default_factory=dict)
    questionnaires: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)
    participants: dict[str, dict[str, Any]] = field(default_factory=dict)
    spare: list[dict[str, Any]] = field(default_factory=list)
    remarks: list[Remark] = field(default_factory=list)

    @property
    def is_simulated(self) -> bool:
        """True if any trial comes from a simulated operator."""
        # One simulated entry marks the whole study: nobody must take it for evidence.
        entries = [*self.trials.values(), *self.spare, *self.questionnaires.values()]
        return any(entry.get("simulated") for entry in entries)


def read_plan(folder: Path) -> dict[str, Any]:
    """Return the plan of a study.

    Raises:
        ConfigError: there is none, or it cannot be read.
    """
    if not (folder / PLAN).is_file():
        raise ConfigError(
            f"{folder} holds no study ({PLAN} is missing); give study.folder=<folder>, or plan one with study.do=plan"
        )
    plan = _read(folder / PLAN)
    if not isinstance(plan, dict) or plan.get("schema") != 1 or "participants" not in plan:
        raise ConfigError(
            f"{folder / PLAN}: expected a plan of schema 1 as study.do=plan writes it"
        )
    return plan


def read_study(folder: Path) -> StudyData:
    """Read a study with all that is wrong with it."""
    # Problems are collected, not raised: a study in the field cannot be repeated.
    data = StudyData(folder, read_plan(folder))
    for name, entry in _iterate_entries(folder / PARTICIPANTS, data):
        data.participants[str(entry.get("participant", name))] = entry
    _read_trials(data)
    _read_questionnaires(data)
    _note_missing(data)
    return data


def write_trial(folder: Path, name: str, trial: dict[str, Any]) -> Path:
    """Write the record of a trial; one that is there already stays, and this becomes a second one beside it."""
    path = folder / TRIALS / f"{name}.json"
    # A hundred repetitions of one trial are an error elsewhere.
    for again in range(2, 100):
        if not path.exists():
            break
        path = folder / TRIALS / f"{name}_again{again}.json"
    return _write(path, {"schema": 1, "created": datetime.now().astimezone().isoformat(), **trial})


def rewrite(path: Path, changes: dict[str, Any]) -> None:
    """Change the record of a trial, participant or questionnaire that is still going on."""
    _write(path, _read(path) | changes)


def write_questionnaire(
    folder: Path, participant: str, period: int, answers: dict[str, Any]
) -> Path:
    """Write a questionnaire; answers given again take the place of those before, which are kept within the file."""
    path = folder / QUESTIONNAIRES / f"{participant}_{period}.json"
    entry: dict[str, Any] = {"schema": 1, "participant": participant, "period": period}
    entry |= {"created": datetime.now().astimezone().isoformat(), **answers}
    if path.exists():
        # The earlier answers stay inside, since nothing that a participant said is thrown away.
        entry["before"] = _read(path)
    return _write(path, entry)


def write_participant(folder: Path, participant: str, facts: dict[str, Any]) -> Path:
    """Write the record of a participant, such as `{"stopped": true, "reason": …}`; no name, no address."""
    return _write(
        folder / PARTICIPANTS / f"{participant}.json",
        {"schema": 1, "participant": participant, **facts},
    )


def note_report(folder: Path, report: Path) -> None:
    """Remember where a report of this study was written."""
    path = folder / REPORTS
    known = _read(path) if path.exists() else []
    # Absolute paths: reports may be written anywhere.
    if str(report.resolve()) not in known:
        _write(path, [*known, str(report.resolve())])


def erase(folder: Path, participant: str) -> tuple[list[Path], list[Path]]:
    """Delete every file about a participant; the plan keeps an empty place that says so.

    Returns:
        Deleted paths, and folders with reports that were made with the participant's data, to be
        deleted and made again.

    Raises:
        ConfigError: the study has no such participant.
    """
    plan = read_plan(folder)
    if participant not in plan["participants"]:
        raise ConfigError(
            f"study.participant={participant}: the study has no such participant; {list_choices(participant, plan['participants'])}"
        )
    gone = []
    for part in (TRIALS, RECORDINGS, CAPTURES, QUESTIONNAIRES, PARTICIPANTS):
        for path in sorted((folder / part).glob("*")):
            # Also files that were renamed by hand: their content tells whose they are.
            if (
                path.stem == participant
                or path.stem.startswith(f"{participant}_")
                or _is_of_participant(path, participant)
            ):
                try:
                    if path.is_dir():
                        shutil.rmtree(path)
                    else:
                        path.unlink()
                except OSError as error:
                    raise StorageError(
                        f"cannot delete {path}: {error.strerror}; {len(gone)} files are gone, run it again"
                    ) from error
                gone.append(path)
    # The plan keeps the place, so that the sequences of the others still make sense.
    plan.setdefault("erased", {})[participant] = (
        datetime.now().astimezone().isoformat(timespec="seconds")
    )
    _write(folder / PLAN, plan)
    reports = []
    for name in _read(folder / REPORTS) if (folder / REPORTS).exists() else []:
        if Path(name).exists():
            reports.append(Path(name))
    return gone, reports


def _is_of_participant(path: Path, participant: str) -> bool:
    """Return whether a file with another name is about the participant."""
    if path.suffix != ".json":
        return False
    try:
        entry = json.loads(path.read_text())
    except (OSError, ValueError):
        return False
    return isinstance(entry, dict) and entry.get("participant") == participant


def _read_trials(data: StudyData) -> None:
    # In the order of their making, so that the first of two counts.
    found = sorted(
        _iterate_entries(data.folder / TRIALS, data),
        key=lambda item: str(item[1].get("created", "")),
    )
    for name, trial in found:
        lacking = []
        for key, kind in TRIAL_FIELDS.items():
            if not isinstance(trial.get(key), kind):
                lacking.append(key)
        if lacking:
            data.remarks.append(
                Remark(name, f"the trial lacks {', '.join(lacking)}; it does not count")
            )
            data.spare.append(trial)
            continue
        # Checks from the gravest to the mildest: one problem is reported for a trial.
        who, period, condition = trial["participant"], trial["period"], trial["condition"]
        key = (who, period, trial["number"])
        if who not in data.plan["participants"]:
            problem = f"'{who}' is no participant of the plan; kept, but it does not count"
        elif period not in (0, *PERIODS) or condition not in CONDITIONS:
            problem = (
                f"period {period}, condition '{condition}': expected 0, 1 or 2 and"
                f" {' or '.join(CONDITIONS)}; it does not count"
            )
        elif period and data.plan["participants"][who][period - 1] != condition:
            problem = f"done {condition}, but planned {data.plan['participants'][who][period - 1]}; kept, but it does not count"
        elif key in data.trials:
            problem = "done twice: the first counts, since the second had more practice; the other is kept"
        elif trial.get("outcome") == "aborted":
            problem = (
                f"aborted ({trial.get('reason', 'no reason given')}); kept, but it does not count"
            )
        else:
            data.trials[key] = trial
            continue
        data.remarks.append(Remark(name, problem))
        data.spare.append(trial)


def _read_questionnaires(data: StudyData) -> None:
    for name, entry in _iterate_entries(data.folder / QUESTIONNAIRES, data):
        who, period = str(entry.get("participant")), entry.get("period")
        if who not in data.plan["participants"] or period not in PERIODS:
            data.remarks.append(
                Remark(
                    name,
                    f"a questionnaire of '{who}', period {period}, whom the plan does not know; not counted",
                )
            )
        elif (who, period) in data.questionnaires:
            data.remarks.append(
                Remark(
                    name,
                    "a second questionnaire for the same period: the one that is named as it should be counts",
                )
            )
        else:
            data.questionnaires[who, period] = entry
            if "before" in entry:
                data.remarks.append(
                    Remark(
                        name,
                        "was filled in twice: the later answers count, the earlier are kept in the file",
                    )
                )


def _note_missing(data: StudyData) -> None:
    # Practice has period 0 and need not be complete.
    planned: dict[str, set[tuple[int, int]]] = {}
    for trial in data.plan["trials"]:
        if trial["period"]:
            planned.setdefault(trial["participant"], set()).add((trial["period"], trial["number"]))
    for who in data.plan["participants"]:
        done = {(period, number) for name, period, number in data.trials if name == who and period}
        known = data.participants.get(who, {})
        if when := data.plan.get("erased", {}).get(who):
            data.remarks.append(Remark(who, f"erased on request, {when}"))
            continue
        if known.get("stopped"):
            data.remarks.append(
                Remark(
                    who,
                    f"stopped after {len(done)} trials ({known.get('reason', 'no reason given')}); what was done is kept",
                )
            )
        lost = sorted(planned.get(who, set()) - done)
        if not done:
            data.remarks.append(Remark(who, "has no trials"))
        elif lost:
            names = ", ".join(f"{period}.{number}" for period, number in lost)
            data.remarks.append(
                Remark(
                    who,
                    f"{len(lost)} of {len(planned[who])} trials are missing (period.trial {names}); means are over the others",
                )
            )
        for period in PERIODS:
            if done and (who, period) not in data.questionnaires:
                data.remarks.append(Remark(who, f"no questionnaire for period {period}"))


def _iterate_entries(folder: Path, data: StudyData) -> Iterator[tuple[str, dict[str, Any]]]:
    for path in sorted(folder.glob("*.json")):
        try:
            entry = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            data.remarks.append(Remark(path.name, f"cannot be read ({error}); left out"))
            continue
        if isinstance(entry, dict):
            yield path.name, entry
        else:
            data.remarks.append(Remark(path.name, "expected a JSON object; left out"))


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error


def _write(path: Path, value: Any) -> Path:
    write_json(path, value)
    return path
