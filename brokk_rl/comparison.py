"""How a comparison of runs looks: a table for the terminal, a picture for people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

RATES = ("success_strict", "success_paper")
MEASURES = ("time_to_insert_s", "lateral_error_m", "peak_force_n", "valve_travel")
HEADINGS = {
    "success_strict": "strict",
    "success_paper": "paper's",
    "time_to_insert_s": "time, s",
    "lateral_error_m": "lateral, mm",
    "peak_force_n": "force, kN",
    "valve_travel": "travel, 1/s",
}
SCALES = {"lateral_error_m": 1e3, "peak_force_n": 1e-3}
SUCCESS = "episode/success_strict"
REACHED = 0.95
"""Success whose time is said and drawn."""
LABEL_WIDTH = 42
"""Characters in a line beside the picture's rows."""
MOST_COLUMNS = 4
UNLIKE_MOST, UNLIKE_MOST_WIDTH = "unlike most", 24
"""With more columns than these, what sets a row apart from most others is said in one."""

Curve = dict[str, list[float]]
"""Columns of a run's progress: seconds, control steps and strict success of training episodes."""


def build_table(columns: Sequence[str], groups: Sequence[dict[str, Any]]) -> Table:
    """Returns the table for a person."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    settings = [[str(group["variation"][column]) for column in columns] for group in groups]
    if len(columns) > MOST_COLUMNS:
        columns, settings = [UNLIKE_MOST], [[text] for text in describe_differences(groups)]
    for heading in ("policy", *columns, "seeds"):
        wide = UNLIKE_MOST_WIDTH if heading == UNLIKE_MOST else None
        table.add_column(heading, no_wrap=heading == "policy", overflow="fold", min_width=wide)
    for name in (*RATES, *MEASURES):
        table.add_column(HEADINGS[name], justify="right", min_width=7)
    for group, setting in zip(groups, settings, strict=True):
        figures = [
            _format_value(group[name], SCALES.get(name, 1.0), name in RATES)
            for name in (*RATES, *MEASURES)
        ]
        table.add_row(group["policy"], *setting, str(group["runs"]), *figures)
    return table


def describe_differences(groups: Sequence[dict[str, Any]]) -> list[str]:
    """Returns, for each group, the values that it does not share with most others; of values all equally frequent, each is said."""
    counts = {
        column: Counter(repr(group["variation"][column]) for group in groups).most_common()
        for column in groups[0]["variation"]
    }
    usual = {
        column: found[0][0]
        for column, found in counts.items()
        if len(found) == 1 or found[0][1] > found[1][1]
    }
    names = _format_shortest(list(counts))
    return [
        ", ".join(
            f"{names[key]} {value}"
            for key, value in group["variation"].items()
            if repr(value) != usual.get(key)
        )
        for group in groups
    ]


def draw_comparison(groups: Sequence[dict[str, Any]]) -> Figure:
    """Draws success with its interval, peak force and valve travel, one row for each policy and variation."""
    labels = [
        ", ".join(filter(None, (group["policy"], text)))
        for group, text in zip(groups, describe_differences(groups), strict=True)
    ]
    figure = Figure(figsize=(11.0, 1.4 + 0.42 * len(groups)), layout="constrained")
    success, *others = figure.subplots(1, 3, sharey=True, width_ratios=(2, 1, 1))
    rows = np.arange(len(groups))[::-1]
    for shift, rate, color, mark in (
        (0.14, "success_strict", "#1f5f8b", "o"),
        (-0.14, "success_paper", "#c27c2c", "s"),
    ):
        _pick_marks(
            success,
            rows + shift,
            [group[rate] for group in groups],
            1.0,
            color,
            mark,
            HEADINGS[rate],
        )
    for axes, name in zip(others, ("peak_force_n", "valve_travel"), strict=True):
        _pick_marks(
            axes,
            rows,
            [group[name] for group in groups],
            SCALES.get(name, 1.0),
            "#444444",
            "o",
            None,
        )
        axes.set(xlabel=HEADINGS[name])
        axes.set_xlim(left=0.0)
    success.set(
        yticks=rows,
        yticklabels=[fill(label, LABEL_WIDTH) for label in labels],
        xlabel="success rate, 95 % interval",
    )
    success.set_xlim(right=1.005)
    success.legend(loc="lower left", frameon=False)
    for axes in (success, *others):
        axes.grid(axis="x", linewidth=0.4)
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(axis="y", length=0)
    return figure


def draw_learning(curves: Mapping[str, Sequence[Curve]]) -> Figure:
    """Draws strict success of training episodes over time and control steps: a colour for each variation, a line for each run.

    Args:
        curves: Learning curves of the runs of each variation.
    """
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    for axes, name, scale, heading in zip(
        figure.subplots(1, 2, sharey=True),
        ("seconds", "env_steps"),
        (1.0, 1e-6),
        ("wall clock of training, s", "control steps, millions"),
        strict=True,
    ):
        for index, (label, members) in enumerate(curves.items()):
            for number, curve in enumerate(members):
                x = scale * np.asarray(curve[name])
                axes.plot(
                    x,
                    curve[SUCCESS],
                    color=f"C{index % 10}",
                    linewidth=1.0,
                    alpha=0.8,
                    label=None if number else label,
                )
        axes.axhline(REACHED, color="#888888", linewidth=0.8, linestyle="--")
        axes.set(xlabel=heading, ylim=(0.0, 1.0))
        axes.set_xlim(left=0.0)
        axes.grid(linewidth=0.4)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("strict success while learning")
    if len(curves) > 1:
        figure.axes[0].legend(loc="lower right", frameon=False, fontsize=8)
    return figure


def _pick_marks(
    axes: Axes,
    rows: np.ndarray,
    figures: Sequence[dict[str, Any]],
    scale: float,
    color: str,
    mark: str,
    label: str | None,
) -> None:
    """Draws means as marks and their intervals as lines, leaving out what was not measured."""
    known = [
        (row, figure)
        for row, figure in zip(rows, figures, strict=True)
        if figure["mean"] is not None
    ]
    axes.plot(
        [scale * figure["mean"] for _, figure in known],
        [row for row, _ in known],
        mark,
        color=color,
        label=label,
    )
    for row, figure in known:
        if figure["ci95"]:
            axes.plot(
                scale * np.asarray(figure["ci95"]), [row] * 2, "-", color=color, linewidth=1.5
            )


def _format_shortest(columns: Sequence[str]) -> dict[str, str]:
    """Returns the shortest ends of dotted keys that still tell them apart."""
    parts = {column: column.split(".") for column in columns}

    def end(column: str, length: int) -> str:
        return ".".join(parts[column][-length:])

    found = {}
    for column in columns:
        lengths = range(1, len(parts[column]) + 1)
        found[column] = next(
            end(column, length)
            for length in lengths
            if [end(other, length) for other in columns].count(end(column, length)) == 1
        )
    return found


def _format_value(figure: dict[str, Any], scale: float, with_interval: bool) -> str:
    if figure["mean"] is None:
        return "–"
    text = f"{figure['mean'] * scale:.3g}"
    if figure["ci95"] and with_interval:
        low, high = figure["ci95"]
        text += f"\n[dim]±{(high - low) / 2:.3f}[/dim]"
    return text
