"""Cases of an exam on disk: recordings, labels, and the sealed file of the labels.

The labels lie in one file that only its owner can read. Its hash lies beside it before any answer
is given.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.session import write_text
from exam.case_distribution import CaseDesign, CaseFault
from exam.generate import CaseRecorder, HalfPlan, RecordedHalf

LABELS_FILE, HASH_FILE = "labels.sealed.json", "labels.sha256"


def seal_labels(folder: Path, labels: dict[str, Any], salt: str) -> str:
    """Write labels and hash into `folder` and return the hash.

    Raises:
        StorageError: there are labels already, or the file cannot be written.
    """
    path = folder / LABELS_FILE
    text = json.dumps({"salt": salt, **labels}, indent=1, allow_nan=False, sort_keys=True) + "\n"
    found = hashlib.sha256(text.encode()).hexdigest()
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(text)
        write_text(folder / HASH_FILE, f"{found}  {LABELS_FILE}\n")  # as sha256sum writes it
    except FileExistsError as error:
        raise StorageError(
            f"{path} exists: the exam in this folder is sealed; choose another session.out=<folder>"
        ) from error
    except OSError as error:
        raise StorageError(f"cannot seal the labels in {folder}: {error.strerror}") from error
    return found


def open_labels(folder: Path) -> dict[str, Any]:
    """Return the labels in `folder`, after comparing them with the published hash.

    Raises:
        RecordingError: labels or hash are missing, or do not belong together.
    """
    try:
        text, published = (
            (folder / LABELS_FILE).read_text(),
            (folder / HASH_FILE).read_text().split()[0],
        )
    except (OSError, IndexError) as error:
        raise RecordingError(
            f"{folder}: expected {LABELS_FILE} and {HASH_FILE}, as exam.do=make leaves them ({error})"
        ) from error
    if hashlib.sha256(text.encode()).hexdigest() != published:
        raise RecordingError(
            f"{folder / LABELS_FILE} was changed after it was sealed: its SHA-256 is not that of {HASH_FILE}; make the exam again"
        )
    return json.loads(text)


CASES_FOLDER = "cases"
HORIZON_S = 5.0
"""Window of `moved_rad`, s. Chosen by hand; not searched."""


def write_cases(
    workshop: CaseRecorder,
    questions: Sequence[CaseDesign],
    reference: HalfPlan,
    field: HalfPlan,
    machine: Machine,
    folder: Path,
    workers: int,
    advance: Callable[[int], None],
) -> list[dict[str, Any]]:
    """Record all cases into `folder/cases/<id>` and return their labels as plain JSON."""
    names = [f"{number:04d}" for number in range(len(questions))]
    folders = [folder / CASES_FOLDER / name for name in names]
    # both halves are planned before anything is recorded: a plan without room fails at once
    reference_jobs = workshop.planned(questions, reference, is_field=False)
    field_jobs = workshop.planned(questions, field, is_field=True)
    workshop.record(reference_jobs, folders, workers, advance)
    made = workshop.record(field_jobs, folders, workers, advance)
    labels = []
    for name, question, half in zip(names, questions, made, strict=True):
        labels.append(make_label(name, question, half, machine))
    return labels


def make_label(
    name: str, question: CaseDesign, field: RecordedHalf, machine: Machine
) -> dict[str, Any]:
    """Return the label of a case.

    `moved_rad`: root mean square change of the measured motion by its cause, over 5 s from equal
    starts, by joint.
    """
    return {
        "case": name,
        "kind": question.kind,
        "tracked": question.tracked,
        "effects": [_label_fault(fault, machine) for fault in question.faults],
        "outside": None
        if question.outside_fault is None
        else {
            "ailment": question.outside_fault.kind,
            "joints": list(question.joints),
            "size": question.size,
        },
        "moved_rad": dict(
            zip(machine.joint_names, measure_motion_change(field, machine).tolist(), strict=True)
        ),
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


def measure_motion_change(field: RecordedHalf, machine: Machine) -> np.ndarray:
    """Return the change of motion by the cause in windows of 5 s, root mean square, `(J,)`."""
    steps, total, count = round(HORIZON_S / machine.period_s), 0.0, 0
    for q, without in zip(field.q, field.without_q, strict=True):
        apart = (q - without).astype(float)
        for begin in range(0, len(apart) - steps, steps // 2):
            growth = apart[begin + 1 : begin + 1 + steps] - apart[begin]
            total, count = total + (growth**2).sum(0), count + steps
    return np.sqrt(total / max(count, 1))
