"""The state of a participant's sitting, read from the study's folder alone: the next step after any interruption stands there.

A sitting is the participant's rows of the plan: consent, practice, the trials of the first period,
its questionnaire, the trials of the second, its questionnaire. The next step is the first one that
is not in the folder.
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
    if not known.get("consent", {}).get("agreed"):
        return Step("consent")
    for period in (0, *PERIODS):
        planned = [one for one in data.planned if (one.participant, one.period) == (who, period)]
        lacking = [one for one in planned if (who, period, one.number) not in data.trials]
        if lacking and not (period == 0 and is_practised(data, who)):
            num_done, first = len(planned) - len(lacking), lacking[0]
            return Step("trial", first, period, first.condition, num_done, len(planned))
        # A questionnaire that was typed in from paper says nothing about being finished.
        begun = data.questionnaires.get((who, period), {"finished": False})
        if period and not begun.get("finished", True):
            condition = data.plan["participants"][who][period - 1]
            return Step("questionnaire", None, period, condition)
    return Step("done")


def is_practised(data: StudyData, who: str) -> bool:
    """Return whether practice is over before all of it was done: by success, or because the experimenter said so."""
    practice = [key for key in sorted(data.trials) if key[:2] == (who, 0)]
    last = [data.trials[key].get("outcome") for key in practice[-ENOUGH:]]
    ended = bool(data.participants.get(who, {}).get("practice_ended"))
    return ended or last == ["inserted"] * ENOUGH


def list_progress(data: StudyData) -> list[dict[str, Any]]:
    """Return how far each participant is, for who chooses one."""
    found = []
    for who in data.plan["participants"]:
        counted = [one for one in data.planned if one.participant == who and one.period]
        done = sum((who, one.period, one.number) in data.trials for one in counted)
        state = "begun" if who in data.participants else "new"
        kind = find_next_step(data, who).kind
        if who in data.erased:
            state = "erased"
        elif kind in ("done", "stopped"):
            state = kind
        found.append({"name": who, "done": done, "of": len(counted), "state": state})
    return found
