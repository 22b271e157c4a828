"""Labels of an exam: the sealed file of them, and the ledger of who answered and when they were opened.

The labels lie in one file that only its owner can read. Its hash lies beside it before any case is recorded.
A line of the ledger is written before the first answer is given, and each time that the labels are opened: so a
reader sees whether the engine was fixed before, and how often answers were scored.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.record import format_now
from brokk_rl.session import write_text
from exam.case_distribution import CaseDesign

LABELS_FILE, HASH_FILE = "labels.sealed.json", "labels.sha256"
OPENED_FILE = "labels.json"
"""The labels of an opened exam, beside its score: the same bytes."""
OTHERS = 0o077
"""Rights that nobody but the owner of the labels' file has."""


def seal_labels(folder: Path, labels: dict[str, Any], salt: str) -> str:
    """Write labels and hash into `folder` and return the hash; the same labels may be there already.

    Raises:
        StorageError: there are other labels, or a file cannot be written.
    """
    path = folder / LABELS_FILE
    text = json.dumps({"salt": salt, **labels}, indent=1, allow_nan=False, sort_keys=True) + "\n"
    found = hashlib.sha256(text.encode()).hexdigest()
    if not path.exists():
        mask = os.umask(OTHERS)
        try:
            write_text(path, text)
        finally:
            os.umask(mask)
    if path.read_text() != text:
        raise StorageError(
            f"{path} holds other labels: the exam in this folder is sealed. Go on with its own options and seed, or "
            "choose another session.out=<folder>"
        )
    write_text(folder / HASH_FILE, f"{found}  {LABELS_FILE}\n")  # as sha256sum writes it
    return found


def read_salt(folder: Path) -> str | None:
    """Return the salt of the labels that are sealed in a folder, `None` without any.

    Raises:
        RecordingError: they are damaged.
    """
    path = folder / LABELS_FILE
    try:
        return json.loads(path.read_text())["salt"] if path.exists() else None
    except (OSError, ValueError, KeyError) as error:
        raise RecordingError(f"{path} is damaged ({error!r}); make the exam again") from error


def open_labels(folder: Path) -> tuple[dict[str, Any], str]:
    """Return the labels in `folder` with their hash, and their text as it was sealed.

    They are the sealed ones of an exam, or the published ones beside a score.

    Raises:
        RecordingError: labels or hash are missing, or do not belong together.
    """
    sealed, published = folder / LABELS_FILE, folder / OPENED_FILE
    is_published = published.is_file() and not sealed.is_file()
    try:
        text = (published if is_published else sealed).read_text()
        found = hashlib.sha256(text.encode()).hexdigest()
        expected = found if is_published else (folder / HASH_FILE).read_text().split()[0]
    except (OSError, IndexError) as error:
        raise RecordingError(
            f"{folder}: expected {LABELS_FILE} and {HASH_FILE}, as exam.do=make leaves them, or {OPENED_FILE} of a score ({error})"
        ) from error
    if found != expected:
        raise RecordingError(
            f"{sealed} was changed after it was sealed: its SHA-256 is not that of {HASH_FILE}; make the exam again"
        )
    return {**json.loads(text), "labels_sha256": expected}, text


def make_label(
    name: str, question: CaseDesign, machine: Machine, other_hand: bool
) -> dict[str, Any]:
    """Return the label of a case; `other_hand`: another hand drives the field than the reference."""
    effects, outside = [], None
    for fault in question.faults:
        told = {"joints": list(fault.joints), "size": fault.size}
        if question.kind == "outside":
            outside = {"ailment": fault.effect, **told}
            continue
        # only drawn parameters can be asked for
        parameters: dict[str, dict[str, float]] = {}
        for key in fault.drawn:
            by_joint = dict(zip(machine.joint_names, fault.parameters[key].tolist(), strict=True))
            parameters[key] = {joint: by_joint[joint] for joint in fault.joints}
        numbers = {"parameters": parameters, "nothing": fault.drawn}
        effects.append({"effect": fault.effect, **told, **numbers})
    return {
        "case": name,
        "kind": question.kind,
        "tracked": question.tracked,
        "other_hand": other_hand,
        "effects": effects,
        "outside": outside,
        "machine_seed": question.machine_seed,
        "chance": question.chance,
    }


LEDGER_FILE = "ledger.jsonl"
BEGUN, OPENED = "answers begin", "labels opened"
"""Events."""


def read_ledger(exam: Path) -> list[dict[str, Any]]:
    """Return the entries of an exam, oldest first.

    Raises:
        RecordingError: a line is damaged.
    """
    path = exam / LEDGER_FILE
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except FileNotFoundError:
        return []
    except ValueError as error:
        raise RecordingError(
            f"{path}: expected JSON in each line ({error}); keep a copy, and delete the damaged line"
        ) from error


def append_entry(exam: Path, event: str, facts: Mapping[str, Any]) -> None:
    """Append an entry with the present time.

    Args:
        exam: Folder of the exam.
        event: `BEGUN` or `OPENED`.
        facts: Hash of the labels, and of answers their `run`.

    Raises:
        StorageError: the ledger cannot be written.
    """
    path, line = exam / LEDGER_FILE, json.dumps({"when": format_now(), "event": event, **facts})
    try:
        with path.open("a") as file:
            file.write(line + "\n")
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror}") from error


def describe_registration(exam: Path, answers: Path, run: Mapping[str, Any]) -> str:
    """Return a sentence that says whether an engine was registered before the labels were first opened.

    Args:
        exam: Folder of the exam.
        answers: The answers.
        run: Content of `run.json` beside them; empty where there is none.
    """
    entries = read_ledger(exam)
    if not run or not entries:
        return f"{answers.name}: no ledger says when its engine was fixed."
    opened = [n for n, one in enumerate(entries) if one["event"] == OPENED]
    begun = [n for n, one in enumerate(entries) if one["event"] == BEGUN and one["run"] == run]
    engine, times = run["commit"], f"labels opened {len(opened)} times before"
    if not begun:
        return f"{answers.name}: engine {engine} is not in the ledger; {times}."
    state = "before" if not opened or begun[0] < opened[0] else "after"
    return (
        f"{answers.name}: engine {engine} was registered {state} the labels were opened; {times}."
    )
