"""Labels of an exam: one file that only its owner can read, and its hash beside it for all to see before any answer is given."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.session import write_text

LABELS, HASH = "labels.sealed.json", "labels.sha256"


def seal(folder: Path, labels: dict[str, Any], salt: str) -> str:
    """Writes labels and hash into `folder`; returns the hash. The salt keeps anyone from guessing labels and comparing hashes.

    Raises:
        StorageError: there are labels already, or the file cannot be written.
    """
    path = folder / LABELS
    text = json.dumps({"salt": salt, **labels}, indent=1, allow_nan=False, sort_keys=True) + "\n"
    found = hashlib.sha256(text.encode()).hexdigest()
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(text)
        write_text(folder / HASH, f"{found}  {LABELS}\n")  # as sha256sum writes it
    except FileExistsError as error:
        raise StorageError(
            f"{path} exists: the exam in this folder is sealed; choose another session.out=<folder>"
        ) from error
    except OSError as error:
        raise StorageError(f"cannot seal the labels in {folder}: {error.strerror}") from error
    return found


def opened(folder: Path) -> dict[str, Any]:
    """Returns the labels in `folder`, after comparing them with the published hash.

    Raises:
        RecordingError: labels or hash are missing, or do not belong together.
    """
    try:
        text, published = (folder / LABELS).read_text(), (folder / HASH).read_text().split()[0]
    except (OSError, IndexError) as error:
        raise RecordingError(
            f"{folder}: expected {LABELS} and {HASH}, as exam.do=make leaves them ({error})"
        ) from error
    if hashlib.sha256(text.encode()).hexdigest() != published:
        raise RecordingError(
            f"{folder / LABELS} is not what was sealed: its SHA-256 is not that of {HASH}; make the exam again"
        )
    return json.loads(text)
