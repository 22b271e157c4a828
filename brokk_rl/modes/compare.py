"""`brokk mode=compare`: one table of many runs, grouped over seeds, with intervals."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
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
from brokk_rl.errors import ConfigError
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

SUCCESS = "episode/success_strict"
PROGRESS_COLUMNS = ["seconds", "env_steps", SUCCESS]
REACHED = 0.95
"""Success rate whose first crossing is reported and drawn, the goal of one insertion in 20
failing."""
MOST_ROWS = 250
"""Rows of a learning curve in `learning.csv`: about the horizontal pixels of one axis at 50 dpi."""
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
    """Compare runs: success with 95 % intervals and learning curves, as tables and pictures."""

    session: Session
    compare: RunSelection

    def run(self) -> None:
        """Print the table; write `comparison.*`, and of trainings `learning.*`."""
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
        _write_learning(runs, columns, folder)
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


def _write_learning(runs: Sequence[EvaluatedRun], columns: Sequence[str], folder: Path) -> None:
    """Write and draw the learning curves of those runs that trained; say when they succeeded."""
    curves: list[pd.DataFrame] = []
    settings = []
    for run in runs:
        curve = _read_progress(run)
        if curve is None:
            continue
        curves.append(curve)
        settings.append({column: run.describe_setting(column) for column in columns})
        reached_s: Any = curve["seconds"][curve[SUCCESS] >= REACHED]
        when = f"not in {curve['seconds'].iloc[-1]:.0f} s"
        if not reached_s.empty:
            when = f"after {reached_s.iloc[0]:.1f} s"
        log.info("%s: success of %.2f while learning %s", run.folder.name, REACHED, when)
    if not curves:
        return
    thinned = pd.concat([curve.iloc[:: -(-len(curve) // MOST_ROWS)] for curve in curves])
    write_text(folder / "learning.csv", thinned.to_csv(index=False, lineterminator="\n"))
    labels = describe_differences(pd.DataFrame(settings, index=range(len(curves))))
    save_figure(draw_learning(labels, curves), folder / "learning.png")


def _read_progress(run: EvaluatedRun) -> pd.DataFrame | None:
    """Return the learning curve of a run; `None` where nothing was trained."""
    path = run.folder / "progress.csv"
    if not path.is_file():
        return None
    try:
        curve: Any = pd.read_csv(path, usecols=PROGRESS_COLUMNS, dtype=float)[PROGRESS_COLUMNS]
    except ValueError as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); leave the run out of compare.runs"
        ) from error
    curve = curve.dropna(subset=[SUCCESS])
    curve.insert(0, "folder", str(run.folder))
    curve.insert(1, "seed", run.seed)
    return None if curve.empty else curve


def draw_learning(labels: Sequence[str], curves: Sequence[pd.DataFrame]) -> Picture:
    """Draw strict success of training episodes over time and over control steps.

    Args:
        labels: Settings of each run; runs of the same settings share a colour.
        curves: Seconds, control steps and success of each run.
    """
    picture = make_figure(11.0, 4.2)
    left, right = picture.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(labels))
    for index, (label, curve) in enumerate(zip(labels, curves, strict=True)):
        style = {"color": f"C{names.index(label) % 10}", "linewidth": 1.0}
        if label in labels[:index]:
            label = ""  # one entry of the legend for all runs of the same settings
        left.plot(curve["seconds"], curve[SUCCESS], label=label, **style)
        right.plot(1e-6 * curve["env_steps"], curve[SUCCESS], **style)
    left.set(xlabel="wall clock of training, s", ylabel="success while learning")
    right.set(xlabel="control steps, millions", ylim=(0.0, 1.0))
    for axis in (left, right):
        axis.axhline(REACHED, color=GREY, linewidth=0.8, linestyle="--")
        axis.set_xlim(left=0.0)
        draw_grid(axis)
    if len(names) > 1:
        left.legend(loc="lower right", frameon=False, fontsize=8)
    return picture
