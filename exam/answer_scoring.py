"""Scores of all answers of some candidates: the examiner's simulations, tables, published answers."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from actuators.contracts import ActuatorFit
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from brokk_rl.session import write_json, write_text
from diagnosis import answer
from exam import dataset, run_cases, score
from exam.dataset import end_on_interrupt
from exam.examiner import examine_case
from exam.metrics import compute_metrics

log = logging.getLogger(__name__)

BULK = ("curves", "location", "evidence")
"""Parts of an answer that fill pictures, nine in ten of its bytes, and no score."""

RUN_FILE = "run.json"
"""File beside answers: who gave them, at which commit, to which labels."""


@dataclass(frozen=True)
class AnswerScoring:
    """Everything that answers to an exam are scored by.

    Attributes:
        exam: Folder of the exam.
        labels: Its opened labels.
        machine: The machine as the candidates know it.
        fit: Fit of the examiner's simulator.
        classes: Effects that recordings of commands and positions cannot tell apart.
        of_machine: Effects that all joints have together.
    """

    exam: Path
    labels: Sequence[Mapping[str, Any]]
    machine: Machine
    fit: ActuatorFit
    classes: Sequence[Sequence[str]]
    of_machine: Sequence[str]

    def examine(
        self, folders: Mapping[str, Path], place: Path, workers: int
    ) -> dict[str, dict[str, Any]]:
        """Return the examiner's figures by candidate and case; empty without withheld recordings.

        Args:
            folders: Answers of each candidate.
            place: File that keeps the figures, so that an interrupted score goes on.
            workers: Processes.
        """
        found: dict[str, dict[str, Any]] = {name: {} for name in folders}
        if place.is_file():
            found |= json.loads(place.read_text())
        todo = []
        for label in self.labels:
            case = label["case"]
            if label["kind"] not in ("one", "several"):
                continue
            if not (self.exam / dataset.WITHHELD_FOLDER / case).is_dir():
                continue
            begun = [name for name in folders if run_cases.is_begun(folders[name] / case)]
            missing = [name for name in begun if case not in found[name]]
            if missing:
                todo.append((case, missing))
        if not todo:
            return found
        with (
            ItemProgress("repairs examined", len(todo)) as progress,
            ProcessPoolExecutor(workers, initializer=end_on_interrupt) as pool,
        ):
            jobs = {}
            for case, names in todo:
                places = [folders[name] / case for name in names]
                job = pool.submit(examine_case, self.exam, self.fit, self.machine, case, places)
                jobs[job] = (case, names)
            for job in as_completed(jobs):
                case, names = jobs[job]
                for name, result in zip(names, job.result(), strict=True):
                    found[name][case] = result
                write_json(place, found)
                progress.advance()
        return found

    def build_table(self, folder: Path, examined: Mapping[str, Any]) -> dict[str, Any]:
        """Return the figures of the answers in `folder`, and the commit that gave them.

        Args:
            folder: The answers.
            examined: The examiner's figures by case.

        Raises:
            RecordingError: there is no answer.
        """
        labels, marks = self.labels, []
        begun = [label for label in labels if run_cases.is_begun(folder / label["case"])]
        if len(begun) < len(labels):
            log.warning(
                "%s: %d of %d cases sat; the others are left out", folder, len(begun), len(labels)
            )
        for label in begun:
            place = folder / label["case"]
            said = (
                answer.read_answer(place / answer.ANSWER_FILE)
                if (place / answer.ANSWER_FILE).is_file()
                else None
            )
            marks.append(
                score.score_answer(
                    label,
                    said,
                    self.classes,
                    self.of_machine,
                    run_cases.read_seconds(place),
                    examined.get(label["case"]),
                )
            )
        if all(mark.verdict == "failed" for mark in marks):
            raise RecordingError(
                f"exam.answers: {folder} holds no answer to any case of {self.exam}"
            )
        table = compute_metrics(marks, len(labels) - len(begun))
        return {**table, "commit": _read_commit(folder)}

    def publish(self, folder: Path, path: Path) -> None:
        """Write all answers in `folder` into one file, a line a case, with its time."""
        lines = []
        for label in self.labels:
            place = folder / label["case"]
            if not run_cases.is_begun(place):
                continue
            said = None
            if (place / answer.ANSWER_FILE).is_file():
                said = json.loads((place / answer.ANSWER_FILE).read_text())
                for key in BULK:
                    said.pop(key, None)
            note = run_cases.read_note(place)
            lines.append(json.dumps({"case": label["case"], "note": note, "answer": said}) + "\n")
        write_text(path, "".join(lines))


def _read_commit(folder: Path) -> str | None:
    """Return the commit that `exam.do=run` noted beside answers; `None` where nothing is noted."""
    try:
        return json.loads((folder / RUN_FILE).read_text())["commit"]
    except (OSError, ValueError, KeyError):
        return None
