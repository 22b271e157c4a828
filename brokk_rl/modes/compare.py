"""`brokk mode=compare`: one table of many runs, grouped over seeds, with intervals."""

from __future__ import annotations

import csv
import io
import json
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from brokk_rl.errors import ConfigError
from brokk_rl.intervals import student, wilson
from brokk_rl.session import RESOLVED, Session, read_record, write_json, write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

EVALUATION = "evaluation.json"
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
NOT_COMPARED = ("session", "mode", "hydra", "ablation", "preset")
"""Choices and overrides that say how a run was started, not what it was."""


@spec
class Runs:
    """Which runs to compare.

    Attributes:
        runs: Run folders, folders of such (a sweep), or patterns of either.
    """

    runs: str | tuple[str, ...]


@spec
class Compare:
    """Compares runs: what differs between them, their success with 95 % intervals, their figures; as table, CSV and picture."""

    session: Session
    compare: Runs

    def run(self) -> None:
        """Prints the table and writes `comparison.json`, `comparison.csv` and `comparison.png`."""
        patterns = (self.compare.runs,) if isinstance(self.compare.runs, str) else self.compare.runs
        runs = [load(folder) for folder in find(patterns)]
        columns = differing(runs)
        results = [result for run in runs for result in run.results(columns)]
        groups = grouped(results)
        folder = self.session.folder
        write_json(folder / "comparison.json", {"schema": 1, "columns": columns, "groups": groups, "runs": results})
        write_text(folder / "comparison.csv", as_csv(columns, results))
        draw(groups).savefig(folder / "comparison.png", dpi=150)
        Console().print(as_table(columns, groups))
        log.info("%d runs compared in %s", len(runs), folder)


@dataclass(frozen=True)
class Run:
    """One evaluated run.

    Attributes:
        folder: Run folder.
        evaluation: Its `evaluation.json`.
        record: Its `session.json`, empty where there is none.
        values: Its `resolved.yaml`, flat: dotted key to value.
    """

    folder: Path
    evaluation: dict[str, Any]
    record: dict[str, Any]
    values: dict[str, Any]

    @property
    def choices(self) -> dict[str, Any]:
        """Options of the config groups that say what was run."""
        found = {key: value for key, value in self.record.get("choices", {}).items() if key not in NOT_COMPARED}
        if "actuator" in self.evaluation:
            found.setdefault("actuator", self.evaluation["actuator"])
        return found

    @property
    def overridden(self) -> set[str]:
        """Dotted keys that were set by hand or by the sweep."""
        keys = {override.partition("=")[0].lstrip("+~") for override in self.record.get("overrides", ())}
        return {key for key in keys if "." in key and key.split(".")[0] not in NOT_COMPARED}

    def results(self, columns: Sequence[str]) -> list[dict[str, Any]]:
        """Returns the figures of each policy that was evaluated in this run."""
        policies = self.evaluation.get("policies") or {str(self.evaluation.get("policy", "trained")): self.evaluation}
        variation = {column: self.choices.get(column, self.values.get(column)) for column in columns}
        seed = self.record.get("seed", self.evaluation.get("seed"))
        return [
            {"folder": str(self.folder), "policy": policy, "seed": seed, "variation": variation, **_figures(self.folder, figures)}
            for policy, figures in policies.items()
        ]


def find(patterns: Sequence[str]) -> list[Path]:
    """Returns the run folders that hold an evaluation, in natural order of their paths.

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


def load(folder: Path) -> Run:
    """Reads what a run folder says.

    Raises:
        ConfigError: One of its files cannot be read.
    """
    path = folder / EVALUATION
    try:
        evaluation = json.loads(path.read_text())
        path = folder / RESOLVED
        values = _flat(yaml.safe_load(path.read_text())) if path.exists() else {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); evaluate the run again or leave it out of compare.runs") from error
    return Run(folder, evaluation, read_record(folder) or {}, values)


def differing(runs: Sequence[Run]) -> list[str]:
    """Returns what differs between the runs: choices of groups first, then single values that were overridden."""
    groups = sorted({key for run in runs for key in run.choices})
    groups = [key for key in groups if len({repr(run.choices.get(key)) for run in runs}) > 1]
    keys = sorted({key for run in runs for key in run.overridden})
    keys = [key for key in keys if len({repr(run.values.get(key)) for run in runs}) > 1]
    return groups + keys


def grouped(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns one entry for each policy and variation, over its seeds.

    A rate of several seeds has Student's interval over the seeds, as training differs from seed to seed; that of a single run has
    Wilson's over its episodes.
    """
    sets: dict[str, list[dict[str, Any]]] = {}
    for result in results:
        sets.setdefault(json.dumps([result["policy"], result["variation"]]), []).append(result)
    return [
        {
            "policy": members[0]["policy"],
            "variation": members[0]["variation"],
            "seeds": [member["seed"] for member in members],
            "runs": len(members),
            **{name: _over_seeds([member[name] for member in members], name in RATES) for name in (*RATES, *MEASURES)},
        }
        for members in sets.values()
    ]


def as_csv(columns: Sequence[str], results: Sequence[dict[str, Any]]) -> str:
    """Returns one line for each run and policy."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    bounds = [f"{rate}_{bound}" for rate in RATES for bound in ("low", "high")]
    writer.writerow(["folder", "policy", "seed", *columns, "episodes", *RATES, *bounds, *MEASURES])
    for result in results:
        ends = [bound for rate in RATES for bound in (result[rate]["ci95"] or (None, None))]
        setting = [result["variation"][column] for column in columns]
        rates, measures = ([result[name]["mean"] for name in names] for names in (RATES, MEASURES))
        writer.writerow(
            [result["folder"], result["policy"], result["seed"], *setting, result["episodes"], *rates, *ends, *measures]
        )
    return text.getvalue()


def as_table(columns: Sequence[str], groups: Sequence[dict[str, Any]]) -> Table:
    """Returns the table for a person."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for heading in ("policy", *columns, "seeds"):
        table.add_column(heading, no_wrap=heading == "policy", overflow="fold")
    for name in (*RATES, *MEASURES):
        table.add_column(HEADINGS[name], justify="right", min_width=7)
    for group in groups:
        setting = [str(group["variation"][column]) for column in columns]
        figures = [_text(group[name], SCALES.get(name, 1.0), name in RATES) for name in (*RATES, *MEASURES)]
        table.add_row(group["policy"], *setting, str(group["runs"]), *figures)
    return table


def draw(groups: Sequence[dict[str, Any]]) -> Figure:
    """Draws success with its interval, one row for each policy and variation."""
    labels = [", ".join([group["policy"], *(f"{key} {value}" for key, value in group["variation"].items())]) for group in groups]
    figure = Figure(figsize=(8.0, 1.2 + 0.4 * len(groups)), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(len(groups))[::-1]
    for shift, rate, mark in ((0.12, "success_strict", "o"), (-0.12, "success_paper", "s")):
        for row, group in zip(rows, groups, strict=True):
            if group[rate]["mean"] is None:
                continue
            color = "#1f5f8b" if rate == "success_strict" else "#c27c2c"
            axes.plot(group[rate]["mean"], row + shift, mark, color=color, label=HEADINGS[rate] if row == rows[0] else None)
            if interval := group[rate]["ci95"]:
                axes.plot(np.clip(interval, 0, 1), [row + shift] * 2, "-", color=color, linewidth=1.5)
    axes.set(yticks=rows, yticklabels=labels, xlim=(-0.02, 1.02), xlabel="success rate, 95 % interval")
    axes.grid(axis="x", linewidth=0.4)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    figure.legend(title="criterion", loc="outside right upper", frameon=False)
    return figure


def _figures(folder: Path, evaluation: dict[str, Any]) -> dict[str, Any]:
    """Returns the compared figures of one policy, each with mean and interval."""
    try:
        episodes = int(evaluation["episodes"])
        rates = {name: _number(evaluation[name]) for name in RATES}
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{folder / EVALUATION} lacks {error}; evaluate the run again") from error
    found: dict[str, Any] = {"episodes": episodes}
    for name, rate in rates.items():
        found[name] = {"mean": rate, "ci95": None if rate is None else wilson(rate * episodes, episodes)}
    for name in MEASURES:
        found[name] = {"mean": _number(evaluation.get(name)), "ci95": None}
    return found


def _number(value: Any) -> float | None:
    """Returns a figure of `evaluation.json`: a number, or the middle of a distribution."""
    if isinstance(value, dict):
        value = value.get("median", value.get("mean"))
    return None if value is None else float(value)


def _over_seeds(figures: Sequence[dict[str, Any]], is_rate: bool) -> dict[str, Any]:
    if len(figures) == 1:
        return figures[0]
    values = [figure["mean"] for figure in figures if figure["mean"] is not None]
    interval = student(values)
    if interval and is_rate:
        interval = max(0.0, interval[0]), min(1.0, interval[1])
    return {"mean": float(np.mean(values)) if values else None, "ci95": interval}


def _text(figure: dict[str, Any], scale: float, with_interval: bool) -> str:
    if figure["mean"] is None:
        return "–"
    text = f"{figure['mean'] * scale:.3g}"
    if figure["ci95"] and with_interval:
        text += f"\n[dim]{figure['ci95'][0]:.2f}–{figure['ci95'][1]:.2f}[/dim]"
    return text


def _flat(node: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(node, dict):
        return {prefix: node}
    return {
        key: value
        for name, child in node.items()
        for key, value in _flat(child, f"{prefix}.{name}" if prefix else str(name)).items()
    }
