"""The report of an exam: tables of all candidates, and the confusion of each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brokk_rl.console_table import MISSING
from brokk_rl.plot import make_figure, save_figure
from brokk_rl.report import Cell, embed_picture, render_page, write_page
from brokk_rl.session import write_text

REPORT_FILE = "exam.html"
TEMPLATE = Path(__file__).with_name("exam.html.jinja")
COLUMNS = ["right", "wrong", "missed", "precision", "recall", "f1", "parameter_error"]
"""Figures of each effect."""
TABLE_FILE = "exam.md"
ROWS = {
    "top1": ("one effect: named first, over classes", True),
    "top1_strictly": ("one effect: named first, strictly", True),
    "exactly_one": ("one effect: it and no other", True),
    "macro_f1": ("one effect: macro-F1", True),
    "joints": ("joints right, when the effect is", True),
    "exact_set": ("two or three effects: exact set", True),
    "set_f1": ("two or three effects: F1", True),
    "false_alarms": ("false alarms, no gap or below noise", False),
    "false_alarms_none": ("  no gap", False),
    "false_alarms_faint": ("  below noise", False),
    "unknown_recall": ("outside the library: said unknown", True),
    "unknown_wrongly": ("a known effect called unknown", False),
    "unknown_auroc": ("AUROC of unknown", True),
    "ece": ("calibration error (ECE)", False),
    "parameter_error": ("parameter error, median", False),
    "cover_90": ("90 % intervals cover", None),
    "cover_95": ("95 % intervals cover", None),
    "closed_examined": ("gap closed on withheld parts, by the examiner, median", True),
    "closed_differs": ("stated closing disagrees with the examiner's", False),
    "closed_missing": ("effects named without a share", False),
}
"""Label of each metric, and whether more of it is better."""


def build_rows(tables: Mapping[str, Mapping[str, Any]]) -> list[list[str | Cell]]:
    """Return the rows of the table of all candidates."""
    rows: list[list[str | Cell]] = []
    for key, (label, more_is_better) in ROWS.items():
        found = [table[key] for table in tables.values()]
        known = [one["value"] for one in found if one["value"] is not None]
        # where less is better the smallest is best; a single candidate is not the best of any
        best = None
        if more_is_better is not None and len(known) > 1:
            best = max(known) if more_is_better else min(known)
        rows.append([label, *(_format_metric(one, best) for one in found)])
    last: list[list[str | Cell]] = [["seconds a case, median (most)"], ["cases sat"], ["no answer"]]
    for table in tables.values():
        sat = table["sat"]
        last[0].append(_format_seconds(table["seconds"]))
        last[1].append(Cell(f"{sat['value']} of {sat['of']}"))
        last[2].append(Cell(str(table["failed"])))
    return rows + last


def _format_metric(metric: Mapping[str, Any], best: float | None) -> Cell:
    """Return a metric with its interval."""
    value, interval = metric["value"], metric["ci95"]
    if value is None:
        return Cell(MISSING)
    note = f"{interval[0]:.2f} to {interval[1]:.2f}, of {metric['of']}" if interval else ""
    return Cell(f"{value:.2f}", note, value == best)


def _format_seconds(found: Mapping[str, float | None]) -> Cell:
    if found["median"] is None or found["most"] is None:
        return Cell(MISSING)
    return Cell(f"{found['median']:.0f} ({found['most']:.0f})")


def format_cell(cell: str | Cell) -> str:
    """Return a cell as plain text."""
    if isinstance(cell, str):
        return cell.strip()
    return f"{cell.value} ({cell.note})" if cell.note else str(cell.value)


def format_markdown(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of all candidates as Markdown."""
    lines = [["", *tables], ["---"] * (1 + len(tables))]
    for row in build_rows(tables):
        lines.append(list(map(format_cell, row)))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_report(
    folder: Path, exam: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write `exam.html`, its table `exam.md`, and `confusion_<name>.png` of each candidate."""
    cases = next(iter(tables.values()))["cases"]
    pictures = {}
    for name, one in tables.items():
        figure = draw_confusion(one)
        if figure is not None:
            path = folder / f"confusion_{name}.png"
            save_figure(figure, path)
            pictures[name] = embed_picture(path)
    values = {
        "title": f"Exam of {', '.join(tables)}",
        "exam": exam,
        "cases": _join_counts({kind: count for kind, count in cases.items() if count}),
        "tables": tables,
        "metrics": [(label, cells) for label, *cells in build_rows(tables)],
        "pictures": pictures,
        "columns": COLUMNS,
        "join_counts": _join_counts,
    }
    write_page(folder / REPORT_FILE, render_page(TEMPLATE, values))
    write_text(folder / TABLE_FILE, format_markdown(tables))


def _join_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def draw_confusion(table: Mapping[str, Any]) -> Figure | None:
    """Draw the first names over the true effects."""
    found = table["confusion"]
    if not found:
        return None
    verdicts = ("none", "unknown", "failed")
    there = sorted(found)
    names = set(there).union(*found.values())
    said = sorted(names - set(verdicts)) + [name for name in verdicts if name in names]
    counts = np.zeros((len(there), len(said)), dtype=int)
    for row, true in enumerate(there):
        for name, count in found[true].items():
            counts[row, said.index(name)] = count
    figure = make_figure(2.6 + 0.34 * len(said), 2.2 + 0.3 * len(there))
    axis = figure.add_subplot()
    shares = counts / counts.sum(1, keepdims=True)
    axis.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for row, column in np.argwhere(counts):
        colour = "white" if shares[row, column] > 0.5 else "black"  # readable on dark cells
        style = {"ha": "center", "va": "center", "color": colour, "fontsize": 8}
        axis.text(column, row, str(counts[row, column]), **style)
    axis.set_xticks(range(len(said)), said, rotation=90, fontsize=8)
    axis.set_yticks(range(len(there)), there, fontsize=8)
    axis.set(xlabel="said", ylabel="there")
    return figure
