"""The report of an exam: one Markdown page with the table of all candidates, and what each said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from brokk_rl.console_table import MISSING
from brokk_rl.session import write_text
from exam.metrics import COUNTS, METRICS

REPORT_FILE = "exam.md"
STRICT = (
    "Figures are strict: only the true effect counts. Rows with equivalents also count the effects that the "
    "exam lists as hard to tell apart, and those that an answer names as the same. Rates have 95 % Wilson "
    "intervals, other metrics bootstrap intervals over cases."
)
OPEN = "A development seed: the authors of the candidates may have looked at its cases."


def build_rows(tables: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Return the rows of the table of all candidates, the title of each first."""
    rows = []
    for key, metric in METRICS.items():
        rows.append([metric.title, *(_format_metric(table[key]) for table in tables.values())])
    last = [["seconds a case, median (most)"], ["cases sat"], ["no answer"]]
    for table in tables.values():
        sat, seconds = table["sat"], table["seconds"]
        text = MISSING
        if seconds["median"] is not None:
            text = f"{seconds['median']:.0f} ({seconds['most']:.0f})"
        last[0].append(text)
        last[1].append(f"{sat['value']} of {sat['of']}")
        last[2].append(str(table["failed"]))
    return rows + last


def _format_metric(metric: Mapping[str, Any]) -> str:
    """Return a metric with its interval."""
    value, interval = metric["value"], metric["ci95"]
    if value is None:
        return MISSING
    note = f" ({interval[0]:.2f} to {interval[1]:.2f}, of {metric['of']})" if interval else ""
    return f"{value:.2f}{note}"


def format_markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as Markdown."""
    lines = [list(headings), ["---"] * len(headings)]
    for row in rows:
        lines.append([cell.strip() for cell in row])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_report(
    folder: Path, exam: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write `exam.md`: the exam, the table of all candidates, and by effect what each of them said."""
    kinds = next(iter(tables.values()))["cases"]
    cases = _join_counts({kind: count for kind, count in kinds.items() if count})
    # labels of the first exams name neither
    made = f"machine {exam['machine']} ({', '.join(exam['makes'])}), " if "makes" in exam else ""
    parts = [
        f"# Exam of {', '.join(tables)}",
        f"{exam['num_cases']} cases ({cases}), {made}roughness {exam['roughness']}, seed {exam['seed']}.",
        *([] if exam["sealed"] else [OPEN]),
        STRICT,
        *exam["ledger"],
        format_markdown(["", *tables], build_rows(tables)),
    ]
    for name, table in tables.items():
        parts += [f"## {name}", f"Commit {table['commit'] or MISSING}.", _format_causes(table)]
    parts.append(f"Labels, SHA-256: {exam['labels_sha256']}.")
    write_text(folder / REPORT_FILE, "\n\n".join(part.rstrip() for part in parts) + "\n")


def _format_causes(table: Mapping[str, Any]) -> str:
    """Return a row for each cause: how often it was named, and what was said where it was alone."""
    rows, by_effect, said = [], table["by_effect"], table["said"]
    for cause in [*by_effect, *(one for one in said if one not in by_effect)]:
        counts = by_effect.get(cause, {})
        numbers = [str(counts.get(key, MISSING)) for key in COUNTS]
        rows.append([cause, *numbers, _join_counts(said.get(cause, {}))])
    return format_markdown(["cause", *COUNTS, "said where it was alone"], rows)


def _join_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
