"""The ledger: every scoring run of an exam in one line, appended and never changed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from brokk_rl.errors import StorageError
from brokk_rl.session import describe_commit

HEADLINES = (
    "top1", "top1_strictly", "macro_f1", "joints", "exact_set", "set_f1", "false_alarms", "unknown_recall", "unknown_auroc",
    "ece", "parameter_error", "cover_90", "closed_of_oracle", "predicted_off",
)  # fmt: skip


def append(path: Path, when: str, exam: dict[str, Any], name: str, table: dict[str, Any]) -> None:
    """Appends one candidate's headlines.

    Args:
        path: The ledger.
        when: Time, ISO 8601.
        exam: Seed, whether sealed, roughness, number of cases, hash of the labels.
        name: The candidate.
        table: Its figures; see `tally`.

    Raises:
        StorageError: it cannot be written.
    """
    figures = {key: table[key]["value"] for key in HEADLINES} | {
        "seconds": table["seconds"]["median"],
        "sat": table["sat"]["value"],
        "failed": table["failed"],
    }
    line = {
        "when": when,
        "commit": describe_commit(),
        "candidate": name,
        **exam,
        **{key: _short(value) for key, value in figures.items()},
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        raise StorageError(f"cannot append to the ledger {path}: {error.strerror}") from error


def _short(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value
