"""The state of a participant's sitting, read from the study's folder alone: the next step after any interruption stands there.

Consent, practice, the trials of the first period, its questionnaire, the trials of the second, its
questionnaire.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from study.design import PERIODS, Trial
from study.study_folder import StudyData

ENOUGH = 2
"""Practice trials in a row that have to succeed for practice to be over."""


@dataclass(frozen=True)
class Step:
    """Next step of a sitting.

    Attributes:
        kind: Consent, a trial, a questionnaire, nothing more, or nothing because the participant
            has stopped.
        trial: The trial, where it is one.
        period: Of the trial or questionnaire; 0 for practice.
        condition: Of the trial, or of the period that the questionnaire is about.
        done: Trials done in the period.
        of: Trials in the period.
    """

    kind: Literal["consent", "trial", "questionnaire", "done", "stopped"]
    trial: Trial | None = None
    period: int = 0
    condition: str = ""
    done: int = 0
    of: int = 0


def find_next_step(data: StudyData, who: str) -> Step:
    """Return the next step of a participant who is known to the plan."""
    known = data.participants.get(who, {})
    if known.get("stopped"):
        return Step("stopped")
    if not (known.get("consent") or {}).get("agreed"):
        return Step("consent")
    for period in (0, *PERIODS):
        planned = []
        for trial in data.plan["trials"]:
            if trial["participant"] == who and trial["period"] == period:
                planned.append(Trial(**trial))
        lacking = [trial for trial in planned if (who, period, trial.number) not in data.trials]
        if lacking and not (period == 0 and is_practised(data, who)):
            return Step(
                "trial",
                lacking[0],
                period,
                lacking[0].condition,
                len(planned) - len(lacking),
                len(planned),
            )
        if period and not data.questionnaires.get((who, period), {"finished": False}).get(
            "finished", True
        ):
            return Step("questionnaire", None, period, data.plan["participants"][who][period - 1])
    return Step("done")


def is_practised(data: StudyData, who: str) -> bool:
    """Return whether practice is over before all of it was done: by success, by time, or because the experimenter said so."""
    done = []
    for (name, period, _), trial in sorted(data.trials.items()):
        if name == who and not period:
            done.append(trial)
    row = [trial.get("outcome") == "inserted" for trial in done[-ENOUGH:]]
    minutes = sum(float(trial.get("seconds", 0.0)) for trial in done) / 60.0
    ended = bool(data.participants.get(who, {}).get("practice_ended"))
    return ended or row == [True] * ENOUGH or minutes >= data.plan["design"]["practice_minutes"]


def progress(data: StudyData) -> list[dict[str, Any]]:
    """Return how far each participant is, for who chooses one."""
    found = []
    for who in data.plan["participants"]:
        done = sum(name == who and period > 0 for name, period, _ in data.trials)
        of = 0
        for trial in data.plan["trials"]:
            if trial["participant"] == who and trial["period"] > 0:
                of += 1
        step = find_next_step(data, who).kind
        state = (
            "erased"
            if who in data.plan.get("erased", {})
            else step
            if step in ("done", "stopped")
            else ""
        )
        begun = who in data.participants
        found.append(
            {"name": who, "done": done, "of": of, "state": state or ("begun" if begun else "new")}
        )
    return found
