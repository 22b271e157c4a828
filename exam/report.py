"""The report of an exam: table of all candidates, confusion, reliability, detection; and the ledger."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brokk_rl.errors import StorageError
from brokk_rl.report import DPI, MISSING, Cell, Report
from brokk_rl.session import describe_commit, write_text

HEADLINES = (
    "top1", "top1_strictly", "macro_f1", "joints", "exact_set", "set_f1", "false_alarms", "unknown_recall", "unknown_auroc",
    "ece", "parameter_error", "cover_90", "closed_of_oracle", "predicted_off",
)  # fmt: skip


def append_to_ledger(
    path: Path, when: str, exam: dict[str, Any], name: str, table: dict[str, Any]
) -> None:
    """Append one candidate's headlines.

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
        **{key: _round_float(value) for key, value in figures.items()},
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        raise StorageError(f"cannot append to the ledger {path}: {error.strerror}") from error


def _round_float(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value


REPORT_FILE = "exam.html"
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
    "closed_of_oracle": ("gap closed, of the oracle's", True),
    "predicted_off": ("predicted closing off by, median", False),
}
"""Figure, its words, and whether more of it is better."""


def build_rows(tables: Mapping[str, Mapping[str, Any]]) -> list[list[str | Cell]]:
    """Return the lines of the table of all candidates."""
    found: list[list[str | Cell]] = []
    for key, (words, more_is_better) in ROWS.items():
        values = {name: table[key]["value"] for name, table in tables.items()}
        known = [value for value in values.values() if value is not None]
        best = (
            None
            if more_is_better is None or len(known) < 2
            else (max if more_is_better else min)(known)
        )
        cells: list[str | Cell] = [words]
        for name, table in tables.items():
            value, interval = values[name], table[key]["ci95"]
            if value is None:
                cells.append(Cell(MISSING))
                continue
            note = (
                f"{interval[0]:.2f} to {interval[1]:.2f}, of {table[key]['of']}" if interval else ""
            )
            cells.append(Cell(f"{value:.2f}", note, value == best))
        found.append(cells)
    found.append(
        [
            "seconds a case, median (most)",
            *(_format_seconds(table["seconds"]) for table in tables.values()),
        ]
    )
    found.append(
        [
            "cases sat",
            *(
                Cell(f"{table['sat']['value']} of {table['sat']['of']}")
                for table in tables.values()
            ),
        ]
    )
    found.append(["no answer", *(Cell(str(table["failed"])) for table in tables.values())])
    return found


def format_markdown(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of all candidates as Markdown, to be pasted where figures stand."""
    lines = [["", *tables], ["---"] * (1 + len(tables))]
    for words, *cells in build_rows(tables):
        told = (cell if isinstance(cell, Cell) else Cell(cell) for cell in cells)
        lines.append(
            [
                str(words).strip(),
                *(f"{one.value} ({one.note})" if one.note else str(one.value) for one in told),
            ]
        )
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_report(
    folder: Path, exam: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write `exam.html`, its table `exam.md`, and the pictures of each candidate."""
    first = next(iter(tables.values()))
    kinds = ", ".join(f"{count} {kind}" for kind, count in first["cases"].items() if count)
    page = Report(
        f"Exam of {', '.join(tables)}",
        f"{exam['num_cases']} cases ({kinds}), roughness {exam['roughness']}, seed {exam['seed']}.",
    )
    for name, table in tables.items():
        if table["sat"]["value"] < table["sat"]["of"]:
            page.add_text(
                f"{name} sat {table['sat']['value']} of {table['sat']['of']} cases; the others are left out.",
                "warn",
            )
    if not exam["sealed"]:
        page.add_text(
            "A development seed: its cases may have been looked at while the candidates were made.",
            "warn",
        )
    page.add_heading("Marks")
    page.add_table(
        ["", *tables],
        build_rows(tables),
        "Rates with 95 % Wilson intervals, other figures with bootstrap intervals over cases",
    )
    for name, table in tables.items():
        page.add_heading(name)
        drawings = {
            "confusion": draw_confusion(table),
            "reliability": draw_reliability(table),
            "size": draw_detection(table),
        }
        for stem, figure in drawings.items():
            if figure is not None:
                figure.savefig(folder / f"{stem}_{name}.png", dpi=DPI)
                page.add_picture(folder / f"{stem}_{name}.png", CAPTIONS[stem])
        with page.add_details("By effect, all cases"):
            columns = ["right", "wrong", "missed", "precision", "recall", "f1", "parameter_error"]
            lines = [
                [effect, *(figures[column] for column in columns)]
                for effect, figures in table["by_effect"].items()
            ]
            page.add_table(["effect", *(column.replace("_", " ") for column in columns)], lines)
        with page.add_details("Faults outside the library, and the answers"):
            said = [
                [kind, ", ".join(f"{count} {answer}" for answer, count in row.items())]
                for kind, row in table["outside"].items()
            ]
            page.add_table(["outside", "said"], said)
    page.add_facts({"labels, SHA-256": exam["labels_sha256"]})
    page.write(folder / REPORT_FILE)
    write_text(folder / TABLE_FILE, format_markdown(tables))


CAPTIONS = {
    "confusion": "One effect: the truth (rows) and the first name of the answer (columns). "
    "A name of its class counts as the true one.",
    "reliability": "Share of true statements over their probability. Larger points are more "
    "statements, bars are 95 % intervals.",
    "size": "One effect: share of right names and of the verdict none, over its size (of typical) "
    "and over its change of the motion.",
}


def draw_confusion(table: Mapping[str, Any]) -> Figure | None:
    """Draw who is taken for whom."""
    found = table["confusion"]
    if not found:
        return None
    there = sorted(found)
    said = sorted(
        {name for row in found.values() for name in row} - {"none", "unknown", "failed"}
        | set(there)
    )
    said += [
        name for name in ("none", "unknown", "failed") if any(name in row for row in found.values())
    ]
    counts = np.array([[found[true].get(name, 0) for name in said] for true in there])
    figure = Figure(figsize=(2.6 + 0.34 * len(said), 2.2 + 0.3 * len(there)), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(
        counts / counts.sum(1, keepdims=True), cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto"
    )
    for row, column in np.argwhere(counts):
        dark = counts[row, column] > 0.5 * counts[row].sum()
        axes.text(
            column,
            row,
            str(counts[row, column]),
            ha="center",
            va="center",
            color="white" if dark else "black",
            fontsize=8,
        )
    axes.set_xticks(range(len(said)), said, rotation=90, fontsize=8)
    axes.set_yticks(range(len(there)), there, fontsize=8)
    axes.set_xlabel("said")
    axes.set_ylabel("there")
    return figure


def draw_reliability(table: Mapping[str, Any]) -> Figure | None:
    """Draw true against stated frequency."""
    bins = table["reliability"]
    if not bins:
        return None
    figure = Figure(figsize=(4.6, 4.2), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="#8c8c8c", linewidth=1)
    stated, true = (
        np.array([one["stated"] for one in bins]),
        np.array([one["value"] for one in bins]),
    )
    low, high = np.array([one["ci95"] for one in bins]).T
    axes.errorbar(
        stated,
        true,
        [np.maximum(true - low, 0), np.maximum(high - true, 0)],
        fmt="none",
        ecolor="#0072b2",
        linewidth=1,
    )
    axes.scatter(stated, true, s=[12 + 4 * one["of"] for one in bins], color="#0072b2", zorder=3)
    axes.set(xlabel="stated probability", ylabel="true", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    return figure


def draw_detection(table: Mapping[str, Any]) -> Figure | None:
    """Draw how detection grows with size."""
    if not table["by_size"]:
        return None
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    scales = (
        ("by_size", "size, of typical", 1.0),
        ("by_motion", "change of motion over 5 s, mrad", 1000.0),
    )
    for axes, (key, words, scale) in zip(figure.subplots(1, 2, sharey=True), scales, strict=True):
        bins = table[key]
        places = range(len(bins))
        for name, colour in (("right", "#0072b2"), ("none", "#e69f00")):
            value = np.array([one[name]["value"] for one in bins])
            low, high = np.array([one[name]["ci95"] for one in bins]).T
            error = [np.maximum(value - low, 0), np.maximum(high - value, 0)]
            axes.errorbar(
                places,
                value,
                error,
                color=colour,
                marker="o",
                label={"right": "rightly named", "none": "none"}[name],
            )
        labels = [
            f"{one['from'] * scale:g} to {one['to'] * scale:g}\n({one['right']['of']})"
            for one in bins
        ]
        axes.set_xticks(places, labels, fontsize=7)
        axes.set(xlabel=words, ylim=(-0.03, 1.03))
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=2,
        frameon=False,
    )
    return figure


def _format_seconds(found: Mapping[str, float | None]) -> Cell:
    if found["median"] is None or found["most"] is None:
        return Cell(MISSING)
    return Cell(f"{found['median']:.0f} ({found['most']:.0f})")
