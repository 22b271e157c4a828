"""`brokk mode=compare`: one table of many runs, grouped over seeds, with intervals."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any

import numpy as np
import pandas as pd
from annotated_types import MinLen
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brokk_rl.comparison import (
    RATE,
    EvaluatedRun,
    Result,
    describe_differences,
    find_differences,
    find_runs,
    group_results,
    label_rows,
    list_figures,
    load_run,
    summarise_methods,
)
from brokk_rl.console_table import print_table
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
UNITS = {"s": ("s", 1.0), "m": ("mm", 1e3), "n": ("kN", 1e-3), "rad": ("rad", 1.0)}
"""Shown unit, and its factor, of a figure whose name ends with a unit."""
COLORS = (BLUE, ORANGE, *OTHERS)
LATEX = str.maketrans({sign: f"\\{sign}" for sign in "&%$#_{}"} | {"\\": r"\textbackslash{}"})


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
        """Print tables; write `comparison.*`, of several seeds `seeds.png`, of trainings `learning.*`."""
        patterns = (self.compare.runs,) if isinstance(self.compare.runs, str) else self.compare.runs
        runs = [load_run(folder) for folder in find_runs(patterns)]
        columns = find_differences(runs)
        results = []
        for run in runs:
            results.extend(run.list_results(columns))
        groups = group_results(results)
        generator = self.session.generator("compare")
        methods = summarise_methods(results, self.compare.baseline, generator)
        folder = self.session.folder
        content = {"columns": columns, "groups": groups, "runs": results, "methods": methods}
        write_json(folder / "comparison.json", {"schema": 1, **content})
        write_text(folder / "comparison.csv", format_csv(results))
        figures = list_figures(results)
        save_figure(draw_comparison(groups, figures), folder / "comparison.png")
        _write_learning(runs, columns, folder)
        _print_groups(groups, columns, figures)
        if any(method["ci95"] for method in methods):
            table = build_seed_table(methods)
            print_table(list(table.columns), table.to_numpy().tolist())
            write_text(folder / "comparison.tex", format_latex(table))
            save_figure(draw_seeds(methods), folder / "seeds.png")
        log.info("%d runs compared in %s", len(runs), folder)


def format_csv(results: Sequence[Result]) -> str:
    """Return CSV text with one line for each run and policy."""
    lines = []
    figures = list_figures(results)
    rates = [name for name in figures if name.startswith(RATE)]
    for result in results:
        line = {name: result[name] for name in ("folder", "policy", "seed")}
        line |= result["variation"]
        line["episodes"] = result["episodes"]
        for name in figures:
            line[name] = result.get(name, {}).get("mean")
        for name in rates:
            interval = result.get(name, {}).get("ci95")
            line[f"{name}_low"], line[f"{name}_high"] = interval or (None, None)
        lines.append(line)
    return pd.DataFrame(lines).to_csv(index=False, lineterminator="\n")


def _name_figure(name: str) -> tuple[str, float]:
    """Return heading and factor of a figure: `lateral_error_m` is shown in mm."""
    if name.startswith(RATE):
        return f"{name.removeprefix(RATE)} success", 1.0
    words, _, unit = name.rpartition("_")
    if unit not in UNITS:
        return name.replace("_", " "), 1.0
    shown, factor = UNITS[unit]
    return f"{words.replace('_', ' ')}, {shown}", factor


def _print_groups(
    groups: Sequence[Mapping[str, Any]], columns: Sequence[str], figures: Sequence[str]
) -> None:
    settings = [[str(group["variation"][column]) for column in columns] for group in groups]
    if len(columns) > MOST_COLUMNS:
        columns = ["unlike most"]
        variations = [group["variation"] for group in groups]
        settings = [[text] for text in describe_differences(variations)]
    rows = []
    for group, setting in zip(groups, settings, strict=True):
        cells = [_format_figure(group[name], name) for name in figures]
        rows.append([group["policy"], *setting, str(group["runs"]), *cells])
    headings = [_name_figure(name)[0] for name in figures]
    print_table(["policy", *columns, "seeds", *headings], rows)


def _format_figure(figure: Mapping[str, Any], name: str) -> str | None:
    if figure["mean"] is None:
        return None
    text = f"{figure['mean'] * _name_figure(name)[1]:.3g}"
    if figure["ci95"] and name.startswith(RATE):
        low, high = figure["ci95"]
        text += f" ±{(high - low) / 2:.3f}"
    return text


def build_seed_table(methods: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the table of interquartile means and differences, as text."""
    rows = []
    for label, method in zip(label_rows(methods), methods, strict=True):
        shown, spread = "baseline" if method["is_baseline"] else "–", ""
        if difference := method["difference"]:
            shown = f"{difference['mean']:+.3f}"
            spread = _format_interval(difference["ci95"], "+.3f")
        mean = f"{method['interquartile_mean']:.3f}"
        interval = _format_interval(method["ci95"], ".3f")
        rows.append([label, str(method["runs"]), mean, interval, shown, spread])
    headings = ["method", "runs", "interquartile mean", "95 %", "difference by seed", "95 %"]
    return pd.DataFrame(rows, columns=headings)


def _format_interval(interval: Sequence[float] | None, form: str) -> str:
    return f"{interval[0]:{form}} to {interval[1]:{form}}" if interval else ""


def format_latex(table: pd.DataFrame) -> str:
    """Return the table of `build_seed_table` for a paper, in LaTeX with the package booktabs."""
    escaped = table.map(lambda text: text.translate(LATEX))
    signed = escaped.replace(r"([-+][\d.]+)", r"$\1$", regex=True)  # the minus of mathematics
    signed.iloc[:, 0] = escaped.iloc[:, 0]
    header = ["Method", "Runs", "IQM", r"95\,\%", "Difference", r"95\,\%"]
    return signed.to_latex(index=False, header=header, column_format="lrrlrl")


def draw_comparison(groups: Sequence[Mapping[str, Any]], figures: Sequence[str]) -> Figure:
    """Draw rates with intervals, and each other figure, a row for each policy and variation."""
    rates = [name for name in figures if name.startswith(RATE)]
    others = [name for name in figures if not name.startswith(RATE)]
    figure = make_figure(6.0 + 2.0 * len(others), 1.4 + 0.42 * len(groups))
    widths = [2, *[1] * len(others)]
    axes = figure.subplots(1, len(widths), sharey=True, width_ratios=widths, squeeze=False)[0]
    success = axes[0]
    for index, name in enumerate(rates):
        heading = _name_figure(name)[0]
        _draw_rows(success, [group[name] for group in groups], COLORS[index], heading, 0.2 * index)
    success.set_xlabel("success rate, 95 % interval")
    success.set_xlim(right=1.005)
    add_legend(figure, success)
    for axis, name in zip(axes[1:], others, strict=True):
        heading, factor = _name_figure(name)
        _draw_rows(axis, [group[name] for group in groups], GREY, None, factor=factor)
        axis.set_xlabel(heading)
        axis.set_xlim(left=0.0)
    _name_rows(success, label_rows(groups))
    return figure


def draw_seeds(methods: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw interquartile means with intervals, and the difference to the baseline of each seed."""
    figure = make_figure(11.0, 1.6 + 0.45 * len(methods))
    means, differences = figure.subplots(1, 2, sharey=True)
    overall = [{"mean": method["interquartile_mean"], "ci95": method["ci95"]} for method in methods]
    _draw_rows(means, overall, BLUE)
    _draw_rows(differences, [method["difference"] for method in methods], ORANGE)
    for row, method in enumerate(methods):
        seeds = list(method["difference"]["by_seed"].values()) if method["difference"] else []
        differences.plot(seeds, [row + 0.18] * len(seeds), ".", color=GREY)
    differences.axvline(0.0, color="black", linewidth=0.8)
    means.set_xlabel("interquartile mean of success, 95 % of resamples")
    differences.set_xlabel("difference to the baseline: each seed, mean, 95 % interval")
    _name_rows(means, label_rows(methods))
    return figure


def _draw_rows(
    axis: Axes,
    figures: Sequence[Mapping[str, Any] | None],
    color: str,
    label: str | None = None,
    shift: float = 0.0,
    factor: float = 1.0,
) -> None:
    """Draw means as marks and intervals as lines; figures without a mean are left out."""
    for row, figure in enumerate(figures):
        if figure is None or figure["mean"] is None:
            continue
        axis.plot(factor * figure["mean"], row + shift, "o", color=color, label=label)
        label = None  # one entry of the legend for all rows
        if figure["ci95"]:
            axis.plot(factor * np.array(figure["ci95"]), [row + shift] * 2, color=color)
    draw_grid(axis, "x")
    axis.tick_params(axis="y", length=0)


def _name_rows(axis: Axes, labels: Sequence[str]) -> None:
    """Write labels beside rows, the first row at the top."""
    axis.set_yticks(range(len(labels)), [fill(label, LABEL_WIDTH) for label in labels])
    axis.set_ylim(len(labels) - 0.4, -0.6)


def _write_learning(runs: Sequence[EvaluatedRun], columns: Sequence[str], folder: Path) -> None:
    """Write and draw the learning curves of those runs that trained; say when they succeeded."""
    curves: list[pd.DataFrame] = []
    variations = []
    for run in runs:
        curve = _read_progress(run)
        if curve is None:
            continue
        curves.append(curve)
        variations.append({column: run.get_setting(column) for column in columns})
        reached_s: Any = curve["seconds"][curve[SUCCESS] >= REACHED]
        when = f"not in {curve['seconds'].iloc[-1]:.0f} s"
        if not reached_s.empty:
            when = f"after {reached_s.iloc[0]:.1f} s"
        log.info("%s: success of %.2f while learning %s", run.folder.name, REACHED, when)
    if not curves:
        return
    thinned = pd.concat([curve.iloc[:: -(-len(curve) // MOST_ROWS)] for curve in curves])
    write_text(folder / "learning.csv", thinned.to_csv(index=False, lineterminator="\n"))
    figure = draw_learning(describe_differences(variations), curves)
    save_figure(figure, folder / "learning.png")


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


def draw_learning(labels: Sequence[str], curves: Sequence[pd.DataFrame]) -> Figure:
    """Draw strict success of training episodes over time and over control steps.

    Args:
        labels: Variation of each run; runs of one variation share a colour.
        curves: Seconds, control steps and success of each run.
    """
    figure = make_figure(11.0, 4.2)
    left, right = figure.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(labels))
    for index, (label, curve) in enumerate(zip(labels, curves, strict=True)):
        style = {"color": f"C{names.index(label) % 10}", "linewidth": 1.0}
        if label in labels[:index]:
            label = ""  # one entry of the legend for all runs of a variation
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
    return figure
