"""Ledger of an exam: who began to answer, with which engine, and each time that the labels were opened.

A line is written before the first answer is given. So a reader sees whether the engine was fixed before
the labels were opened, and how often answers were scored.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.record import format_now

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
