"""Cases of an exam on disk: recordings, labels, and the sealed file of the labels.

The labels lie in one file that only its owner can read. Its hash lies beside it before any answer
is given.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from brokk_rl.session import write_text
from exam.case_distribution import CaseDesign, CaseFault
from exam.generate import CaseRecorder, Half, HalfPlan

LABELS_FILE, HASH_FILE = "labels.sealed.json", "labels.sha256"
OPENED_FILE = "labels.json"
"""The labels of an opened exam, beside its score: the same bytes."""
PRIVATE = 0o600
"""Mode of a file that only its owner can read."""


def seal_labels(folder: Path, labels: dict[str, Any], salt: str) -> str:
    """Write labels and hash into `folder` and return the hash.

    Raises:
        StorageError: there are labels already, or the file cannot be written.
    """
    path = folder / LABELS_FILE
    text = json.dumps({"salt": salt, **labels}, indent=1, allow_nan=False, sort_keys=True) + "\n"
    found = hashlib.sha256(text.encode()).hexdigest()
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, PRIVATE), "w") as file:
            file.write(text)
        write_text(folder / HASH_FILE, f"{found}  {LABELS_FILE}\n")  # as sha256sum writes it
        (folder / PARTIAL_FILE).unlink(missing_ok=True)
    except FileExistsError as error:
        raise StorageError(
            f"{path} exists: the exam in this folder is sealed; choose another session.out=<folder>"
        ) from error
    except OSError as error:
        raise StorageError(f"cannot seal the labels in {folder}: {error.strerror}") from error
    return found


def open_labels(folder: Path) -> tuple[dict[str, Any], str]:
    """Return the labels in `folder` with their hash, and their text as it was sealed.

    They are the sealed ones of an exam, or the published ones beside a score.

    Raises:
        RecordingError: labels or hash are missing, or do not belong together.
    """
    sealed, published = folder / LABELS_FILE, folder / OPENED_FILE
    try:
        if published.is_file() and not sealed.is_file():
            text = published.read_text()
            expected = hashlib.sha256(text.encode()).hexdigest()
        else:
            text, expected = sealed.read_text(), (folder / HASH_FILE).read_text().split()[0]
    except (OSError, IndexError) as error:
        raise RecordingError(
            f"{folder}: expected {LABELS_FILE} and {HASH_FILE}, as exam.do=make leaves them, or {OPENED_FILE} of a score ({error})"
        ) from error
    if hashlib.sha256(text.encode()).hexdigest() != expected:
        raise RecordingError(
            f"{sealed} was changed after it was sealed: its SHA-256 is not that of {HASH_FILE}; make the exam again"
        )
    return {**json.loads(text), "labels_sha256": expected}, text


CASES_FOLDER, WITHHELD_FOLDER = "cases", "withheld"
PARTIAL_FILE = "labels.partial.jsonl"
"""Salt and labels of an exam that is being made."""
BLOCK_CASES = 12
"""Cases recorded side by side: 48 runs of a step in one array. More are hardly faster a case, and
an interruption loses more."""


@dataclass(frozen=True)
class CaseSet:
    """All cases of an exam before they are recorded.

    Attributes:
        recorder: Records them.
        questions: The cases.
        halves: Plan of each half, and of the withheld part.
        machine: The machine.
        folder: Of the exam.
    """

    recorder: CaseRecorder
    questions: Sequence[CaseDesign]
    halves: Mapping[Half, HalfPlan]
    machine: Machine
    folder: Path

    def write(self, numbers: Sequence[int]) -> list[dict[str, Any]]:
        """Record the cases with these numbers and return their labels as plain JSON."""
        questions = [self.questions[number] for number in numbers]
        names = [f"{number:04d}" for number in numbers]
        # all halves are planned before anything is recorded: a plan without room fails at once
        jobs = {}
        for half, plan in self.halves.items():
            jobs[half] = self.recorder.planned(questions, plan, half)
        for half, of_half in jobs.items():
            parent = WITHHELD_FOLDER if half == "withheld" else CASES_FOLDER
            self.recorder.record(of_half, [self.folder / parent / name for name in names])
        labels = []
        for name, question in zip(names, questions, strict=True):
            other_hand = self.halves["field"].has_other_hand(question)
            labels.append(make_label(name, question, self.machine, other_hand))
        return labels


def write_cases(
    cases: CaseSet, salt: str, workers: int, progress: ItemProgress
) -> list[dict[str, Any]]:
    """Record all cases in blocks and return their labels.

    Labels of finished blocks stand in a file that only its owner can read, so that an interrupted
    exam goes on after them.

    Args:
        cases: The cases.
        salt: Of the labels.
        workers: Processes.
        progress: Told how many cases are done.
    """
    path = cases.folder / PARTIAL_FILE
    found = _read_partial(path, salt)
    progress.skip(len(found))
    count = len(cases.questions)
    todo = [number for number in range(count) if f"{number:04d}" not in found]
    # machines of one make run side by side
    todo.sort(key=lambda number: cases.recorder.find_make(cases.questions[number]))
    # a block for each process at least, so that none is idle
    size = max(1, min(BLOCK_CASES, -(-len(todo) // workers)))
    blocks = [todo[begin : begin + size] for begin in range(0, len(todo), size)]
    append_lines(path, [{"salt": salt}] if not found else [], PRIVATE)

    def keep(done: Future[list[dict[str, Any]]]) -> None:
        fresh = [label for label in done.result() if label["case"] not in found]
        append_lines(path, fresh, PRIVATE)
        found.update({label["case"]: label for label in fresh})
        progress.advance(len(fresh))

    with ProcessPoolExecutor(workers, initializer=end_on_interrupt) as pool:
        pending = [pool.submit(cases.write, block) for block in blocks]
        try:
            for done in as_completed(pending):
                keep(done)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            # what is finished is kept, in whatever order it comes
            for job in pending:
                if job.done() and not job.cancelled() and job.exception() is None:
                    keep(job)
            raise
    return [found[name] for name in sorted(found)]


def end_on_interrupt() -> None:
    """Let this process end at once when the person interrupts the command."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def read_partial_salt(folder: Path) -> str | None:
    """Return the salt of an exam that was interrupted while it was made, `None` without one."""
    try:
        return json.loads((folder / PARTIAL_FILE).read_text().splitlines()[0])["salt"]
    except (OSError, IndexError):
        return None


def _read_partial(path: Path, salt: str) -> dict[str, dict[str, Any]]:
    """Return the labels of the cases that are finished, by name."""
    try:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
    except OSError:
        return {}
    if not lines or lines[0].get("salt") != salt:
        raise StorageError(f"{path} is of another exam: choose another session.out=<folder>")
    return {line["case"]: line for line in lines[1:]}


def append_lines(path: Path, lines: Sequence[Mapping[str, Any]], mode: int = 0o644) -> None:
    """Append a line of JSON each to a file that is made with this mode.

    Raises:
        StorageError: the file cannot be written.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
    try:
        with os.fdopen(os.open(path, flags, mode), "a") as file:
            for line in lines:
                file.write(json.dumps(line) + "\n")
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror}") from error


def make_label(
    name: str, question: CaseDesign, machine: Machine, other_hand: bool
) -> dict[str, Any]:
    """Return the label of a case; `other_hand`: another hand drives the field than the reference."""
    return {
        "case": name,
        "kind": question.kind,
        "tracked": question.tracked,
        "other_hand": other_hand,
        "effects": [_label_fault(fault, machine) for fault in question.faults],
        "outside": None
        if question.outside_fault is None
        else {
            "ailment": question.outside_fault.kind,
            "joints": list(question.joints),
            "size": question.size,
        },
        "machine_seed": question.machine_seed,
        "chance": question.chance,
    }


def _label_fault(fault: CaseFault, machine: Machine) -> dict[str, Any]:
    """Return the part of a label about one effect; only drawn parameters can be asked for."""
    parameters: dict[str, dict[str, float]] = {}
    for key in fault.drawn:
        by_joint = dict(zip(machine.joint_names, fault.parameters[key].tolist(), strict=True))
        parameters[key] = {joint: float(by_joint[joint]) for joint in fault.joints}
    return {
        "effect": fault.effect,
        "joints": list(fault.joints),
        "size": fault.size,
        "parameters": parameters,
        "nothing": fault.drawn,
    }
