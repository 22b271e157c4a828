"""The report of an exam: tables of all candidates, and the confusion of each."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brokk_rl.console_table import MISSING
from brokk_rl.plot import make_figure, save_figure
from brokk_rl.report import Cell, embed_picture, render_page
from brokk_rl.session import write_text
from exam.metrics import METRICS

REPORT_FILE = "exam.html"
TEMPLATE = Path(__file__).with_name("exam.html.jinja")
TABLE_FILE = "exam.md"
VERDICTS = ("none", "unknown", "failed")


def build_rows(tables: Mapping[str, Mapping[str, Any]]) -> list[list[str | Cell]]:
    """Return the rows of the table of all candidates."""
    rows: list[list[str | Cell]] = []
    for key, metric in METRICS.items():
        found = [table[key] for table in tables.values()]
        known = [one["value"] for one in found if one["value"] is not None]
        # A single candidate is not the best of any.
        best = None
        if metric.more_is_better is not None and len(known) > 1:
            best = max(known) if metric.more_is_better else min(known)
        rows.append([metric.title, *(_format_metric(one, best) for one in found)])
    last: list[list[str | Cell]] = [["seconds a case, median (most)"], ["cases sat"], ["no answer"]]
    for table in tables.values():
        sat, seconds = table["sat"], table["seconds"]
        text = MISSING
        if seconds["median"] is not None:
            text = f"{seconds['median']:.0f} ({seconds['most']:.0f})"
        last[0].append(Cell(text))
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


def format_cell(cell: str | Cell) -> str:
    """Return a cell as plain text."""
    if isinstance(cell, str):
        return cell
    return f"{cell.value} ({cell.note})" if cell.note else str(cell.value)


def format_markdown(headings: list[str], rows: list[list[str | Cell]]) -> str:
    """Return a table as Markdown."""
    lines = [headings, ["---"] * len(headings)]
    for row in rows:
        lines.append([format_cell(cell).strip() for cell in row])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_report(
    folder: Path, exam: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write `exam.html`, its table `exam.md`, and `confusion_<name>.png` of each candidate."""
    cases = next(iter(tables.values()))["cases"]
    pictures = {}
    for name, one in tables.items():
        if one["confusion"]:
            path = folder / f"confusion_{name}.png"
            save_figure(draw_confusion(one["confusion"]), path)
            pictures[name] = embed_picture(path)
    rows = build_rows(tables)
    values = {
        "title": f"Exam of {', '.join(tables)}",
        "exam": exam,
        "cases": _join_counts({kind: count for kind, count in cases.items() if count}),
        "tables": tables,
        "metrics": [(label, cells) for label, *cells in rows],
        "pictures": pictures,
        "join_counts": _join_counts,
    }
    write_text(folder / REPORT_FILE, render_page(TEMPLATE, values))
    write_text(folder / TABLE_FILE, format_markdown(["", *tables], rows))


def _join_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def draw_confusion(confusion: Mapping[str, Mapping[str, int]]) -> Figure:
    """Draw the first names over the true effects."""
    there = sorted(confusion)
    said = sorted(
        {*chain.from_iterable(confusion.values())}, key=lambda name: (name in VERDICTS, name)
    )
    counts = np.zeros((len(there), len(said)), dtype=int)
    for row, true in enumerate(there):
        for name, count in confusion[true].items():
            counts[row, said.index(name)] = count
    figure = make_figure(2.6 + 0.34 * len(said), 2.2 + 0.3 * len(counts))
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
