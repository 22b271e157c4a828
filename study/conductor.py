"""Conductor of a sitting: takes the messages of the page, watches the machine, and writes the files.

A sitting is the participant's rows of the plan: consent, practice, the trials of the first period,
its questionnaire, the trials of the second, its questionnaire. The next step is the first one that
is not in the study's folder. Each finished step is written there before the next one begins. So an
interruption at any time costs at most the running trial, which is kept as aborted and repeated.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from brokk_rl.errors import BrokkError, ConfigError
from brokk_rl.machine import Machine
from brokk_rl.record import format_now
from brokk_rl.spec import spec
from study import study_folder as folders
from study.design import PERIODS, Trial
from study.study_folder import StudyData
from study.tlx import Form
from study.trial import Attempt, LoopStage, Times

log = logging.getLogger(__name__)


ENOUGH = 2
"""Practice trials in a row that have to succeed for practice to be over."""


@spec
class Consent:
    """Consent text for participants; a lab replaces it with its own.

    Attributes:
        version: Kept with each consent.
        text: Paragraphs by language, `en` and `de`.
    """

    version: str
    text: dict[str, tuple[str, ...]]

    def check(self) -> None:
        if missing := {"en", "de"} - set(self.text):
            raise ConfigError(f"text: expected en and de, got no {' and '.join(sorted(missing))}")


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
        lacking = [one for one in planned if one.key not in data.trials]
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
        done = sum(one.key in data.trials for one in counted)
        state = "begun" if who in data.participants else "new"
        kind = find_next_step(data, who).kind
        if who in data.erased:
            state = "erased"
        elif kind in ("done", "stopped"):
            state = kind
        found.append({"name": who, "done": done, "of": len(counted), "state": state})
    return found


class Conductor:
    """One sitting after the other, each step chosen from the files of the study's folder.

    Args:
        folder: The study's.
        machine: The machine.
        stage: Where trials take place.
        consent: Text of the lab.
        times: Countdown and the like.
        facts: Further fields of every trial, such as `twin`.
        clock: Monotonic time, s.
    """

    def __init__(
        self,
        folder: Path,
        machine: Machine,
        stage: LoopStage,
        consent: Consent,
        times: Times,
        facts: dict[str, Any],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder, self._machine, self._stage = folder, machine, stage
        self._consent, self._times, self._facts, self._clock = consent, times, facts, clock
        self._data: StudyData = folders.read_study(folder)
        self._who: str | None = None
        self._step: Step | None = None
        self._attempt: Attempt | None = None
        self._form: Form | None = None
        self.problem = ""
        """Last error, for the leader of the sitting; empty without one."""

    @property
    def shows_advice(self) -> bool:
        """True during a guided trial."""
        attempt = self._attempt
        return self.running and attempt is not None and attempt.trial.condition == "guided"

    @property
    def running(self) -> bool:
        """True during a trial."""
        return self._attempt is not None and self._attempt.phase == "running"

    def choose(self, who: str | None) -> None:
        """Begin, or goes on with, the sitting of a participant; `None` leaves it.

        Raises:
            ConfigError: the plan knows no such participant, or they were erased.
        """
        if who is not None:
            self._data.require_participant(who)
        # Leaving is an abort: the trial under way is kept and done again.
        if self._attempt is not None:
            self._attempt.abort("the sitting was left")
        self._who = who
        self._go_on()

    def tick(self) -> None:
        """Look at the machine; called some twenty times a second."""
        try:
            if self._attempt is not None:
                self._attempt.tick()
        # Errors show on the page; the server of the page must not die of them.
        except BrokkError as error:
            self._fall_back(error)

    def take(self, said: dict[str, Any]) -> str:
        """Take a message of a page; return the reason of a refusal, else an empty string."""
        try:
            return self._take(str(said.get("do")), said)
        except BrokkError as error:
            self._fall_back(error)
            return "failed"

    def view(self) -> dict[str, Any]:
        """Return the view of the pages, as plain data."""
        found: dict[str, Any] = {"who": self._who, "problem": self.problem}
        step = self._step
        # Nobody is chosen: the list of participants is shown.
        if self._who is None or step is None:
            return {**found, "kind": "choose", "participants": list_progress(self._data)}
        found |= asdict(step)
        if step.kind == "consent":
            return {**found, "text": self._consent.text, "version": self._consent.version}
        shown = self._attempt or self._form
        return found if shown is None else {**found, **shown.view()}

    def close(self) -> None:
        """End the trial under way at once; it is kept as aborted, and done again."""
        if self._attempt is not None:
            self._attempt.abort("the program ended")

    def _take(self, do: str, said: dict[str, Any]) -> str:
        step, attempt, form = self._step, self._attempt, self._form
        # During a trial the only way out is to stop it.
        if do == "choose" and isinstance(said.get("who"), str) and not self.running:
            self.choose(said["who"])
        elif do == "leave" and not self.running:
            self.choose(None)
        elif self._who is None or step is None:
            return "nobody"
        elif do == "stop_sitting":
            # A reason is a short text; the page's own limit may be circumvented.
            self._stop(str(said.get("reason", ""))[:200])
        elif do == "go_on" and step.kind == "stopped":
            self._note({"stopped": False, "went_on": format_now()})
        elif do == "consent" and step.kind == "consent":
            self._take_consent(said)
        elif do == "end_practice" and attempt and not step.period and not self.running:
            self._note({"practice_ended": True})
        elif do == "next" and attempt and attempt.phase == "over":
            self._go_on()
        elif do == "begin" and attempt:
            return attempt.begin()
        elif do == "stop_trial" and attempt:
            return attempt.stop()
        elif do == "abort" and attempt:
            return attempt.abort("by the experimenter")
        elif form:
            refused = form.take(said)
            if form.finished:
                self._go_on()
            return refused
        else:
            return "not now"
        return ""

    def _fall_back(self, error: BrokkError) -> None:
        """Go back to the list of participants, and show the error there; the files on the disk are continued later."""
        log.error("%s", error)
        # No recording may go on behind the list of participants.
        self._stage.record(None)
        self._who = self._step = self._attempt = self._form = None
        self.problem = str(error)

    def _go_on(self) -> None:
        """End what is under way, read the folder again, and begin the next step."""
        if self._attempt is not None:
            self._attempt.close()
        # The folder and not memory decides the next step: a crash anywhere then costs nothing.
        self._data, self.problem = folders.read_study(self._folder), ""
        self._step = self._attempt = self._form = None
        if self._who is None:
            return
        step = self._step = find_next_step(self._data, self._who)
        what = step.trial.name if step.trial else step.period or ""
        log.info("%s: %s %s", self._who, step.kind, what)
        if step.trial is not None:
            self._attempt = Attempt(
                self._data, step.trial, self._machine, self._stage, self._times, self._facts, self._clock
            )  # fmt: skip
        elif step.kind == "questionnaire":
            self._form = Form(self._folder, self._who, step.period)

    def _take_consent(self, said: dict[str, Any]) -> None:
        consent = {
            "agreed": said.get("agreed") is True,
            "version": self._consent.version,
            # A language tag is short; longer text is no tag.
            "language": str(said.get("language", ""))[:5],
            "at": format_now(),
        }
        refusal = {} if consent["agreed"] else {"stopped": True, "reason": "no consent"}
        self._note({"consent": consent, **refusal})

    def _stop(self, reason: str) -> None:
        if self._attempt is not None:
            self._attempt.stop()
        reason = reason or "no reason given"
        self._note({"stopped": True, "reason": reason, "stopped_at": format_now()})

    def _note(self, facts: dict[str, Any]) -> None:
        assert self._who is not None
        path = self._folder / folders.PARTICIPANTS / f"{self._who}.json"
        folders.update_record(path, {"participant": self._who, **facts})
        self._go_on()
