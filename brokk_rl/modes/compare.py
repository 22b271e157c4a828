"""`brokk mode=compare`: one table of many runs, grouped over seeds, with intervals."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Annotated, Any

import pandas as pd
from annotated_types import MinLen
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from brokk_rl.comparison import (
    DIFFERENCE,
    HIGH,
    LOW,
    EvaluatedRun,
    average_seeds,
    compare_to_baseline,
    describe_differences,
    find_differences,
    find_runs,
    list_figures,
    list_rates,
    load_run,
    tabulate_runs,
)
from brokk_rl.console_table import print_table
from brokk_rl.contracts.task import Figure
from brokk_rl.plot import (
    BLUE,
    GREY,
    ORANGE,
    OTHERS,
    add_legend,
    draw_grid,
    make_figure,
    save_figure,
)
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

MOST_COLUMNS = 4
"""Largest number of columns of differences; above it one column has the values that most rows lack.
Chosen by hand."""
LABEL_WIDTH = 42
"""Characters of a row label in a picture before it wraps."""
COLORS = (BLUE, ORANGE, *OTHERS)


@spec
class RunSelection:
    """Runs to compare.

    Attributes:
        runs: Run folders, folders of such (a sweep), or patterns of either.
        baseline: Values of the row to which others are compared; `None`: the first.
    """

    runs: str | Annotated[tuple[str, ...], MinLen(1)]
    baseline: dict[str, Any] | None


@spec
class Compare:
    """Compare runs: success with 95 % intervals, as tables and a picture."""

    session: Session
    compare: RunSelection

    def run(self) -> None:
        """Print the table; write `comparison.*`."""
        patterns = (self.compare.runs,) if isinstance(self.compare.runs, str) else self.compare.runs
        runs = [load_run(folder) for folder in find_runs(patterns)]
        columns = find_differences(runs)
        table = tabulate_runs(runs, columns)
        averaged = average_seeds(table, columns)
        groups = compare_to_baseline(averaged, table, columns, self.compare.baseline)
        folder = self.session.folder
        content: dict[str, Any] = {"schema": 3, "columns": columns}
        for name, rows in (("groups", groups), ("runs", table)):
            text = str(rows.to_json(orient="records", double_precision=15))
            content[name] = json.loads(text)
        write_json(folder / "comparison.json", content)
        write_text(folder / "comparison.csv", table.to_csv(index=False, lineterminator="\n"))
        words = collect_words(runs, list_figures(table))
        picture = draw_comparison(groups, columns, words, list_rates(table))
        save_figure(picture, folder / "comparison.png")
        _print_groups(groups, columns, words, list_rates(table))
        log.info("%d runs compared in %s", len(runs), folder)


def collect_words(runs: Sequence[EvaluatedRun], names: Sequence[str]) -> dict[str, Figure]:
    """Return the words of figures: those of the runs' tasks, else their names."""
    told: dict[str, Mapping[str, Any]] = {}
    for run in runs:
        told |= run.evaluation.get("figures", {})
    words = {}
    for name in names:
        plain = Figure(name.replace("_", " "), "", 1.0, 3, of_success=False)
        words[name] = Figure(**told[name]) if name in told else plain
    return words


def _name_figure(figure: Figure) -> str:
    unit = "" if figure.unit in ("share", "") else f", {figure.unit}"
    return figure.title + unit


def _print_groups(
    groups: pd.DataFrame, columns: Sequence[str], words: Mapping[str, Figure], rates: Sequence[str]
) -> None:
    settings: Any = groups[list(columns)]
    if len(columns) > MOST_COLUMNS:
        settings = pd.DataFrame({"unlike most": describe_differences(settings)})
    cells = {}
    for name, figure in words.items():
        shown = groups[name].map(lambda value, by=figure.factor: f"{by * value:.3g}")
        if name in rates:
            half = (groups[name + HIGH] - groups[name + LOW]) / 2
            shown += half.map(lambda value: "" if pd.isna(value) else f" ±{value:.3f}")
        cells[_name_figure(figure)] = shown.where(groups[name].notna(), None)
    cells["difference by seed"] = groups.apply(_format_difference, axis=1)
    table = pd.concat([groups["policy"], settings, groups["runs"], pd.DataFrame(cells)], axis=1)
    headings = ["policy", *settings.columns, "seeds", *cells]
    print_table(headings, table.astype(object).where(table.notna(), None).to_numpy().tolist())


def _format_difference(group: Any) -> str | None:
    """Return the difference of a group to the baseline with its interval, as text."""
    if pd.isna(group[DIFFERENCE]):
        return None
    text = f"{group[DIFFERENCE]:+.3f}"
    if pd.notna(group[DIFFERENCE + LOW]):
        text += f" ({group[DIFFERENCE + LOW]:+.3f} to {group[DIFFERENCE + HIGH]:+.3f})"
    return text


def label_rows(rows: Any, columns: Sequence[str]) -> list[str]:
    """Return a short name of each row: its policy, and the values that most others lack."""
    texts = describe_differences(rows[list(columns)])
    return [", ".join(filter(None, pair)) for pair in zip(rows["policy"], texts, strict=True)]


def draw_comparison(
    groups: pd.DataFrame, columns: Sequence[str], words: Mapping[str, Figure], rates: Sequence[str]
) -> Picture:
    """Draw rates with intervals, and each other figure, a row for each policy and setting."""
    others = {name: figure for name, figure in words.items() if name not in rates}
    picture = make_figure(6.0 + 2.0 * len(others), 1.4 + 0.42 * len(groups))
    widths = [2, *[1] * len(others)]
    success, *axes = picture.subplots(
        1, len(widths), sharey=True, width_ratios=widths, squeeze=False
    )[0]
    for index, name in enumerate(rates):
        _draw_rows(success, groups, name, COLORS[index], words[name].title, shift=0.2 * index)
    success.set_xlabel("success rate, 95 % interval")
    success.set_xlim(right=1.005)
    add_legend(picture, success)
    for axis, (name, figure) in zip(axes, others.items(), strict=True):
        _draw_rows(axis, groups, name, GREY, factor=figure.factor)
        axis.set_xlabel(_name_figure(figure))
        axis.set_xlim(left=0.0)
    _name_rows(success, label_rows(groups, columns))
    return picture


def _draw_rows(
    axis: Axes,
    table: pd.DataFrame,
    name: str,
    color: str,
    label: str | None = None,
    shift: float = 0.0,
    factor: float = 1.0,
) -> None:
    """Draw a figure as marks and its intervals as lines; what is missing is left out."""
    places = [row + shift for row in range(len(table))]
    values = factor * table[[name, name + LOW, name + HIGH]].astype(float)
    axis.plot(values[name], places, "o", color=color, label=label)
    axis.hlines(places, values[name + LOW], values[name + HIGH], color=color)
    draw_grid(axis, "x")
    axis.tick_params(axis="y", length=0)


def _name_rows(axis: Axes, labels: Sequence[str]) -> None:
    """Write labels beside rows, the first row at the top."""
    axis.set_yticks(range(len(labels)), [fill(label, LABEL_WIDTH) for label in labels])
    axis.set_ylim(len(labels) - 0.4, -0.6)
