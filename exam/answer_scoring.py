"""Answers of a candidate, from the folder of a run or from a published file, and their scores."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from actuators.contracts import ActuatorFit
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel, use_workers
from brokk_rl.progress import ItemProgress
from brokk_rl.session import write_text
from diagnosis.answer import ANSWER_FILE, parse_answer
from exam import run_cases, score
from exam.case_distribution import CaseDistribution
from exam.examiner import examine_case
from exam.generate import WITHHELD_FOLDER
from exam.metrics import compute_metrics

log = logging.getLogger(__name__)

PUBLISHED = ("schema", "verdict", "reason", "selected", "ranking", "gap")
"""Parts of an answer that are published: those that a score reads. The others are nine in ten of its bytes; a
published file names them as `left_out`."""
RUN_FILE = "run.json"
"""File beside answers: who gave them, at which commit, to which labels."""


@dataclass(frozen=True)
class GivenAnswer:
    """Answer of a candidate to a case; the fields of a line of a published file.

    Attributes:
        note: Seconds that it took, or the reason why there is no answer; empty where nothing was noted.
        answer: Content of its `diagnosis.json`, `None` without one.
        left_out: Parts of it that are not published; `None` where nothing was left out.
        labels_sha256: Hash of the labels of the exam that was answered; `None` where nobody noted it.
        examined: The examiner's figures; see `exam.examiner.examine_case`.
    """

    note: Mapping[str, Any]
    answer: Mapping[str, Any] | None
    left_out: Sequence[str] | None = None
    labels_sha256: str | None = None
    examined: Mapping[str, Any] | None = None


def read_answers(path: Path) -> dict[str, GivenAnswer]:
    """Return the answers in the folder of `exam.do=run`, or in a published file, by case.

    Raises:
        RecordingError: there is no answer.
    """
    found: dict[str, GivenAnswer] = {}
    where = path
    try:
        if path.is_file():
            for row in map(json.loads, path.read_text().splitlines()):
                case = row.pop("case")
                found[case] = GivenAnswer(**row)
        elif path.is_dir():
            answered = read_run(path).get("labels_sha256")
            for place in filter(run_cases.is_begun, path.iterdir()):
                where = place / ANSWER_FILE
                content = json.loads(where.read_text()) if where.is_file() else None
                note = run_cases.read_facts(place / run_cases.NOTE_FILE)
                found[place.name] = GivenAnswer(note, content, labels_sha256=answered)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"exam.answers: {where}: expected {ANSWER_FILE} in a folder a case, or a line a case of a published file "
            f"({error!r}); delete what is damaged, and exam.do=run resume=<answers> answers it again"
        ) from error
    if all(one.answer is None for one in found.values()):
        raise RecordingError(f"exam.answers: {path} holds no answer to any case")
    return found


def read_run(answers: Path) -> dict[str, Any]:
    """Return what `exam.do=run` noted beside answers; empty where nothing is noted, as of a published file."""
    return run_cases.read_facts(answers / RUN_FILE)


def publish_answers(given: Mapping[str, GivenAnswer], path: Path) -> None:
    """Write all answers into one file, a line a case, with their notes and what is left out."""
    lines = []
    for case, one in sorted(given.items()):
        note = dict(one.note)
        if note.get("error"):
            # The lines before name folders of the computer that answered.
            note["error"] = note["error"].strip().splitlines()[-1]
        kept = replace(one, note=note)
        if one.answer is not None:
            answer = {key: one.answer[key] for key in PUBLISHED if key in one.answer}
            left_out = sorted({*(one.left_out or ()), *one.answer} - {*PUBLISHED})
            kept = replace(kept, answer=answer, left_out=left_out)
        # A missing answer is told as `null`; whatever else is missing is left away.
        told = {key: value for key, value in vars(kept).items() if value is not None}
        lines.append(json.dumps({"case": case, "note": note, "answer": None} | told) + "\n")
    write_text(path, "".join(lines))


def build_table(
    labels: Sequence[Mapping[str, Any]], given: Mapping[str, GivenAnswer], mix: CaseDistribution
) -> dict[str, Any]:
    """Return the figures of answers; cases that nobody began are left out and counted.

    Args:
        labels: Opened labels of the exam.
        given: Answers by case.
        mix: Says which effects cannot be told apart, and which ones all joints have together.
    """
    scores = []
    shared = [name for name, trouble in mix.troubles.items() if trouble.joints == "all"]
    for label in labels:
        case = label["case"]
        if case not in given:
            continue
        one = given[case]
        answer = None if one.answer is None else parse_answer(one.answer, f"case {case}")
        row = score.score_answer(label, answer, mix.classes, shared, one.examined)
        scores.append(row)
    not_begun = len(labels) - len(scores)
    if not_begun:
        log.warning("%d of %d cases were not begun and are left out", not_begun, len(labels))
    return compute_metrics(scores, not_begun)


def examine_answers(
    exam: Path,
    labels: Sequence[Mapping[str, Any]],
    folders: Mapping[str, Path],
    fit: ActuatorFit,
    machine: Machine,
    workers: int,
) -> dict[str, dict[str, Any]]:
    """Return the examiner's figures by case and candidate; none without withheld recordings.

    Args:
        exam: Folder of the exam.
        labels: Its opened labels.
        folders: Answers of each candidate.
        fit: Fit of the examiner's simulator.
        machine: The machine.
        workers: Processes.
    """
    cases = []
    for label in labels:
        is_withheld = (exam / WITHHELD_FOLDER / label["case"]).is_dir()
        if label["kind"] in ("one", "several") and is_withheld:
            cases.append(label["case"])

    def examine_begun(case: str) -> dict[str, Any]:
        begun = [name for name in folders if run_cases.is_begun(folders[name] / case)]
        answers = {name: folders[name] / case for name in begun}
        return examine_case(exam, fit, machine, case, answers) if begun else {}

    with ItemProgress("repairs examined", len(cases)) as progress, use_workers(workers):
        tell = lambda _, share: progress.reach(share * len(cases))  # noqa: E731
        return dict(zip(cases, map_parallel(examine_begun, cases, tell), strict=True))
