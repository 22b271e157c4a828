"""Comparison of evaluated runs: figures over seeds, what differs, as table, CSV and pictures."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from brokk_rl.errors import ConfigError
from brokk_rl.intervals import compute_student_interval, compute_wilson_interval
from brokk_rl.session import RESOLVED, read_record

SUCCESS_RATE = "success_strict"
RATES = (SUCCESS_RATE, "success_paper")
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
"""Factors of shown figures: mm and kN."""
SUCCESS = "episode/success_strict"
REACHED = 0.95
"""Success rate whose first crossing is reported and drawn, the goal of one insertion in 20
failing."""
LABEL_WIDTH = 42
"""Characters of a row label before it wraps."""
MOST_COLUMNS = 4
"""Largest number of columns of differences. Chosen by hand; not searched."""
UNLIKE_MOST, UNLIKE_MOST_WIDTH = "unlike most", 24
"""Above `MOST_COLUMNS` columns the table has one column with the values that most rows lack."""

EVALUATION = "evaluation.json"
NOT_COMPARED = ("session", "mode", "hydra", "ablation", "preset")
"""Choices and overrides that say how a run was started, not what it was."""
PROGRESS_COLUMNS = ("seconds", "env_steps", SUCCESS)
EVALUATED_ON = "evaluated on"
"""Column of the actuator on which policies of other runs were evaluated."""

Curve = dict[str, list[float]]
"""Columns of a run's progress: seconds, control steps and strict success of training episodes."""


@dataclass(frozen=True)
class EvaluatedRun:
    """One evaluated run.

    Attributes:
        folder: Run folder.
        evaluation: Its `evaluation.json`.
        record: Its `session.json`, empty where there is none.
        values: Its `resolved.yaml`, flat: dotted key to value.
        training: The run that made the policy which this one evaluated, where it is at hand.
    """

    folder: Path
    evaluation: dict[str, Any]
    record: dict[str, Any]
    values: dict[str, Any]
    training: EvaluatedRun | None = None

    @property
    def choices(self) -> dict[str, Any]:
        """Chosen options of the config groups that describe the experiment."""
        found = {}
        for key, value in self.record.get("choices", {}).items():
            if key not in NOT_COMPARED:
                found[key] = value
        if "actuator" in self.evaluation:
            found.setdefault("actuator", self.evaluation["actuator"])
        return found

    def get_setting(self, column: str) -> Any:
        """Return the group option or single value that this run was made with."""
        return self.choices.get(column, self.values.get(column))

    @property
    def overridden(self) -> set[str]:
        """Dotted keys that the command line or the sweep has set."""
        compared = set()
        for override in self.record.get("overrides", ()):
            key = override.partition("=")[0].lstrip("+~")
            # a key without a dot is a group: `choices` has it
            if "." in key and key.split(".")[0] not in NOT_COMPARED:
                compared.add(key)
        return compared

    def results(self, columns: Sequence[str]) -> list[dict[str, Any]]:
        """Return one entry with figures for each policy that this run evaluated."""
        main = str(self.evaluation.get("policy", "trained"))
        policies = self.evaluation.get("policies") or {main: self.evaluation}
        found = []
        for policy, figures in policies.items():
            made = self.training if self.training and policy == main else self
            variation = {}
            for column in columns:
                if column != EVALUATED_ON:
                    variation[column] = made.get_setting(column)
            if EVALUATED_ON in columns:
                variation[EVALUATED_ON] = self.choices.get("actuator")
            seed = made.record.get("seed", self.evaluation.get("seed"))
            about = {
                "folder": str(self.folder),
                "policy": policy,
                "seed": seed,
                "variation": variation,
            }
            found.append({**about, **_collect_figures(self.folder, figures)})
        return found


def find_runs(patterns: Sequence[str]) -> list[Path]:
    """Return the run folders that hold an evaluation, in natural order of their paths.

    Raises:
        ConfigError: A pattern leads to no evaluation.
    """
    found: set[Path] = set()
    for pattern in patterns:
        inside = {path.parent for top in glob(pattern) for path in Path(top).rglob(EVALUATION)}
        if not inside:
            raise ConfigError(
                f"compare.runs: no {EVALUATION} under '{pattern}'; expected run folders, a sweep's folder, or a pattern of either"
            )
        found |= inside
    return sorted(found, key=lambda path: [part.zfill(9) for part in re.split(r"(\d+)", str(path))])


def load_run(folder: Path) -> EvaluatedRun:
    """Read evaluation, session record and configuration of a run folder.

    Raises:
        ConfigError: One of its files cannot be read.
    """
    path = folder / EVALUATION
    try:
        evaluation = json.loads(path.read_text())
        path = folder / RESOLVED
        values = _flatten(yaml.safe_load(path.read_text())) if path.exists() else {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); evaluate the run again or leave it out of compare.runs"
        ) from error
    return EvaluatedRun(
        folder, evaluation, read_record(folder) or {}, values, _find_training_run(folder, values)
    )


def read_progress(folder: Path) -> Curve | None:
    """Return the learning curve of a run, `None` where nothing was trained."""
    path = folder / "progress.csv"
    if not path.is_file():
        return None
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get(SUCCESS)]
    try:
        return (
            {name: [float(row[name]) for row in rows] for name in PROGRESS_COLUMNS}
            if rows
            else None
        )
    except (KeyError, ValueError) as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); leave the run out of compare.runs"
        ) from error


def find_differences(runs: Sequence[EvaluatedRun]) -> list[str]:
    """Return the columns in which runs differ: group options first, then overridden values.

    An evaluation of a stored policy counts as the run that trained the policy. The actuator of the
    evaluation is then a column of its own.
    """
    made = [run.training or run for run in runs]
    groups = sorted({key for run in made for key in run.choices})
    groups = [key for key in groups if len({repr(run.choices.get(key)) for run in made}) > 1]
    above: set[str] = set()
    for run in made:
        above |= run.overridden
    inside = tuple(f"{top}." for top in above)
    touched: set[str] = set()
    for run in made:
        touched.update(key for key in run.values if key in above or key.startswith(inside))
    keys = [key for key in sorted(touched) if len({repr(run.values.get(key)) for run in made}) > 1]
    elsewhere = [EVALUATED_ON] if any(run.training for run in runs) else []
    return groups + keys + elsewhere


def _find_training_run(folder: Path, values: dict[str, Any]) -> EvaluatedRun | None:
    """Return the run that trained the evaluated policy, also where both folders were moved together."""
    named = values.get("policy.folder")
    if not isinstance(named, str):
        return None
    for place in (Path(named), folder.parent / Path(named).name):
        if (
            place.resolve() != folder.resolve()
            and (place / EVALUATION).is_file()
            and (place / RESOLVED).is_file()
        ):
            return load_run(place)
    return None


def group_results(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one entry for each policy and variation, averaged over its seeds.

    A rate of several seeds has Student's interval over seeds, since training differs between seeds.
    A rate of a single run has Wilson's interval over its episodes.
    """
    sets: dict[str, list[dict[str, Any]]] = {}
    for result in results:
        sets.setdefault(json.dumps([result["policy"], result["variation"]]), []).append(result)
    averaged = []
    for members in sets.values():
        averaged.append(
            {
                "policy": members[0]["policy"],
                "variation": members[0]["variation"],
                "seeds": [member["seed"] for member in members],
                "runs": len(members),
                **{
                    name: _average_seeds([member[name] for member in members], name in RATES)
                    for name in (*RATES, *MEASURES)
                },
            }
        )
    return averaged


def format_csv(columns: Sequence[str], results: Sequence[dict[str, Any]]) -> str:
    """Return CSV text with one line for each run and policy."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    bounds = []
    for rate in RATES:
        bounds += [f"{rate}_low", f"{rate}_high"]
    writer.writerow(["folder", "policy", "seed", *columns, "episodes", *RATES, *bounds, *MEASURES])
    for result in results:
        ends = []
        for rate in RATES:
            ends.extend(result[rate]["ci95"] or (None, None))
        setting = [result["variation"][column] for column in columns]
        rates, measures = ([result[name]["mean"] for name in names] for names in (RATES, MEASURES))
        writer.writerow(
            [
                result["folder"],
                result["policy"],
                result["seed"],
                *setting,
                result["episodes"],
                *rates,
                *ends,
                *measures,
            ]
        )
    return text.getvalue()


def _collect_figures(folder: Path, evaluation: dict[str, Any]) -> dict[str, Any]:
    """Return the compared figures of one policy, each with mean and interval."""
    try:
        episodes = int(evaluation["episodes"])
        rates = {name: _read_number(evaluation[name]) for name in RATES}
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{folder / EVALUATION} lacks {error}; evaluate the run again") from error
    found: dict[str, Any] = {"episodes": episodes}
    for name, rate in rates.items():
        found[name] = {
            "mean": rate,
            "ci95": None if rate is None else compute_wilson_interval(rate * episodes, episodes),
        }
    for name in MEASURES:
        found[name] = {"mean": _read_number(evaluation.get(name)), "ci95": None}
    return found


def _read_number(value: Any) -> float | None:
    """Return a figure of `evaluation.json`: a number, or the median of a distribution."""
    if isinstance(value, dict):
        value = value.get("median", value.get("mean"))
    return None if value is None else float(value)


def _average_seeds(figures: Sequence[dict[str, Any]], is_rate: bool) -> dict[str, Any]:
    if len(figures) == 1:
        return figures[0]
    values = [figure["mean"] for figure in figures if figure["mean"] is not None]
    interval = compute_student_interval(values)
    if interval and is_rate:
        interval = max(0.0, interval[0]), min(1.0, interval[1])
    return {"mean": float(np.mean(values)) if values else None, "ci95": interval}


def _flatten(node: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(node, dict):
        return {prefix: node}
    flat = {}
    for name, child in node.items():
        for key, value in _flatten(child, f"{prefix}.{name}" if prefix else str(name)).items():
            flat[key] = value
    return flat


def build_table(columns: Sequence[str], groups: Sequence[dict[str, Any]]) -> Table:
    """Return the table that the terminal shows."""
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


def describe_differences(groups: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return for each group the values that it does not share with most others.

    Where no value of a column is the most frequent, every value counts as unusual.
    """
    counts = {}
    for column in groups[0]["variation"]:
        counts[column] = Counter(repr(group["variation"][column]) for group in groups).most_common()
    usual = {}
    for column, found in counts.items():
        if len(found) == 1 or found[0][1] > found[1][1]:
            usual[column] = found[0][0]
    names = _format_shortest(list(counts))
    differences = []
    for group in groups:
        differences.append(
            ", ".join(
                f"{names[key]} {value}"
                for key, value in group["variation"].items()
                if repr(value) != usual.get(key)
            )
        )
    return differences


def draw_comparison(groups: Sequence[dict[str, Any]]) -> Figure:
    """Draw success with interval, peak force and valve travel, a row for each policy and variation."""
    labels = []
    for group, text in zip(groups, describe_differences(groups), strict=True):
        labels.append(", ".join(filter(None, (group["policy"], text))))
    figure = Figure(figsize=(11.0, 1.4 + 0.42 * len(groups)), layout="constrained")
    success, *others = figure.subplots(1, 3, sharey=True, width_ratios=(2, 1, 1))
    rows = np.arange(len(groups))[::-1]
    for shift, rate, color, mark in (
        (0.14, "success_strict", "#1f5f8b", "o"),
        (-0.14, "success_paper", "#c27c2c", "s"),
    ):
        rates = [group[rate] for group in groups]
        _pick_marks(success, rows + shift, rates, 1.0, color, mark, HEADINGS[rate])
    for axes, name in zip(others, ("peak_force_n", "valve_travel"), strict=True):
        measures = [group[name] for group in groups]
        _pick_marks(axes, rows, measures, SCALES.get(name, 1.0), "#444444", "o", None)
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
    """Draw strict success of training episodes over time and over control steps.

    Args:
        curves: Learning curves of each variation, one colour a variation and one line a run.
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
    """Draw means as marks and intervals as lines; figures without a mean are left out."""
    x, y = [], []
    for row, figure in zip(rows, figures, strict=True):
        if figure["mean"] is None:
            continue
        x.append(scale * figure["mean"])
        y.append(row)
    axes.plot(x, y, mark, color=color, label=label)
    for row, figure in zip(rows, figures, strict=True):
        if figure["mean"] is not None and figure["ci95"]:
            axes.plot(
                scale * np.asarray(figure["ci95"]), [row] * 2, "-", color=color, linewidth=1.5
            )


def _format_shortest(columns: Sequence[str]) -> dict[str, str]:
    """Return for each dotted key its shortest ending that no other key shares."""
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
