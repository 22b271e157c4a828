"""Conductor of a sitting: takes the messages of the page, watches the machine, and writes the files.

Each finished step is written into the study's folder (`study.study_folder`) before the next
one begins. So an interruption at any time costs at most the running trial, which is kept as aborted
and repeated.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import BrokkError, ConfigError, list_choices
from brokk_rl.machine import Machine
from study import study_folder as folders
from study.form import Form
from study.steps import Step, find_next_step, progress
from study.study_folder import StudyData
from study.trial import Attempt, Times, keep
from study.twin_control import Stage

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Words:
    """Texts of a lab for its participants, by language.

    Attributes:
        version: Of the text, kept with each consent.
        consent: Text of the consent, one paragraph each.
    """

    version: str
    consent: dict[str, tuple[str, ...]]


class Conductor:
    """One sitting after the other, each step chosen from the files of the study's folder.

    Args:
        folder: The study's.
        machine: The machine.
        stage: Where trials take place.
        words: Texts of the lab.
        times: Countdown and the like.
        facts: Further fields of every trial: `simulated`, `twin`.
        seed: From which the order of pairs comes: of participant and period.
        clock: Monotonic time, s.
    """

    def __init__(
        self,
        folder: Path,
        machine: Machine,
        stage: Stage,
        words: Words,
        times: Times,
        facts: dict[str, Any],
        seed: Callable[[str], int],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder, self._machine, self._stage, self._words, self._times = (
            folder,
            machine,
            stage,
            words,
            times,
        )
        self._facts, self._seed, self._clock = facts, seed, clock
        # Trials that an interruption left half saved.
        for path in sorted((folder / folders.TRIALS).glob("*.json")):
            with suppress(ValueError):  # a file that cannot be read is said in the report
                keep(folder, path, machine, stage)
        # Read after the repair above, so that the repaired trials count.
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
        return (
            self._attempt is not None
            and self._attempt.running
            and self._attempt.trial.condition == "guided"
        )

    @property
    def running(self) -> bool:
        """True during a trial."""
        return self._attempt is not None and self._attempt.running

    def choose(self, who: str | None) -> None:
        """Begin, or goes on with, the sitting of a participant; `None` leaves it.

        Raises:
            ConfigError: the plan knows no such participant, or they were erased.
        """
        plan = self._data.plan
        # An erased participant keeps a place in the plan, but nobody may fill it again.
        if who is not None and (who not in plan["participants"] or who in plan.get("erased", {})):
            raise ConfigError(
                f"study.participant={who}: no participant of the plan; {list_choices(who, plan['participants'])}"
            )
        # Leaving is an abort: the trial under way is kept and done again.
        if self._attempt is not None:
            self._attempt.abort("the sitting was left")
            self._attempt.close()
        self._who, self._attempt, self._form = who, None, None
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
        do, step = said.get("do"), self._step
        try:
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
                self._note({"stopped": False, "went_on": _format_now()})
            elif do == "consent" and step.kind == "consent":
                self._consent(said)
            elif (
                do == "end_practice"
                and step.kind == "trial"
                and not step.period
                and not self.running
            ):
                self._close_attempt()
                self._note({"practice_ended": True})
            elif step.kind == "trial" and self._attempt is not None:
                return self._in_trial(str(do), self._attempt)
            elif step.kind == "questionnaire" and self._form is not None:
                if refused := self._form.take(said):
                    return refused
                if self._form.finished:
                    self._go_on()
            else:
                return "not now"
        except BrokkError as error:
            self._fall_back(error)
            return "failed"
        return ""

    def view(self) -> dict[str, Any]:
        """Return the view of the pages, as plain data."""
        found: dict[str, Any] = {
            "kind": "choose",
            "who": self._who,
            "problem": self.problem,
            "simulated": self._facts["simulated"],
        }
        # Nobody is chosen: the list of participants is shown.
        if self._who is None or self._step is None:
            return found | {"participants": progress(self._data)}
        step = self._step
        found |= {
            "kind": step.kind,
            "period": step.period,
            "condition": step.condition,
            "done": step.done,
            "of": step.of,
        }
        if step.kind == "consent":
            return found | {"text": self._words.consent, "version": self._words.version}
        if self._attempt is not None:
            return found | self._attempt.view()
        return found | (self._form.view() if self._form is not None else {})

    def close(self) -> None:
        """End trial or questionnaire at once."""
        if self._attempt is not None:
            self._attempt.leave()

    def _fall_back(self, error: BrokkError) -> None:
        """Go back to the list of participants, and show the error there; the files on the disk are continued later."""
        log.error("%s", error)
        # No recording may go on behind the list of participants.
        self._stage.record(None)
        self._who, self._step, self._attempt, self._form, self.problem = (
            None,
            None,
            None,
            None,
            str(error),
        )

    def _in_trial(self, do: str, attempt: Attempt) -> str:
        if do == "begin":
            return attempt.begin()
        if do in ("stop_trial", "abort"):
            return attempt.stop() if do == "stop_trial" else attempt.abort("by the experimenter")
        if do == "next" and attempt.over:
            self._close_attempt()
            self._go_on()
            return ""
        return "not now"

    def _go_on(self) -> None:
        """Read the folder again, and begin the next step."""
        # The folder and not memory decides the next step: a crash anywhere then costs nothing.
        self._data, self._step, self._form = folders.read_study(self._folder), None, None
        self.problem = ""
        if self._who is None:
            return
        step = self._step = find_next_step(self._data, self._who)
        log.info(
            "%s: %s %s", self._who, step.kind, step.trial.name if step.trial else step.period or ""
        )
        if step.trial is not None:
            hole = self._data.plan["design"]["holes"][step.trial.hole]
            start = np.array(self._data.plan["design"]["starts"][step.trial.start])
            self._attempt = Attempt(
                self._folder, self._data.plan["design"], step.trial, hole, start, self._machine, self._stage, self._times,
                self._facts, self._clock,
            )  # fmt: skip
        elif step.kind == "questionnaire":
            # Seeded by participant and period, so that a resumed questionnaire asks the same
            # pairs.
            seed = self._seed(f"pairs {self._who} {step.period}")
            self._form = Form(
                self._folder, self._who, step.period, seed, {"simulated": self._facts["simulated"]}
            )

    def _close_attempt(self) -> None:
        if self._attempt is not None:
            self._attempt.close()
        self._attempt = None

    def _consent(self, said: dict[str, Any]) -> None:
        agreed = said.get("agreed") is True
        consent = {
            "agreed": agreed,
            "version": self._words.version,
            # A language tag is short; longer text is no tag.
            "language": str(said.get("language", ""))[:5],
            "at": _format_now(),
        }
        self._note(
            {"consent": consent}
            if agreed
            else {"consent": consent, "stopped": True, "reason": "no consent"}
        )

    def _stop(self, reason: str) -> None:
        if self._attempt is not None:
            self._attempt.stop()
            self._close_attempt()
        self._note(
            {"stopped": True, "reason": reason or "no reason given", "stopped_at": _format_now()}
        )

    def _note(self, facts: dict[str, Any]) -> None:
        assert self._who is not None
        # The record is written whole, so that earlier facts stay.
        known = {}
        for key, value in self._data.participants.get(self._who, {}).items():
            if key != "participant":
                known[key] = value
        folders.write_participant(
            self._folder, self._who, known | facts | {"simulated": self._facts["simulated"]}
        )
        self._go_on()


def _format_now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
