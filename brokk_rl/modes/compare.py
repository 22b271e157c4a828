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
from rich.console import Console

from brokk_rl.comparison import (
    MEASURES,
    RATES,
    REACHED,
    SUCCESS,
    Curve,
    build_table,
    describe_differences,
    draw_comparison,
    draw_learning,
)
from brokk_rl.errors import ConfigError
from brokk_rl.intervals import compute_student_interval, compute_wilson_interval
from brokk_rl.session import RESOLVED, Session, read_record, write_json, write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

EVALUATION = "evaluation.json"
NOT_COMPARED = ("session", "mode", "hydra", "ablation", "preset")
"""Choices and overrides that say how a run was started, not what it was."""
PROGRESS_COLUMNS = ("seconds", "env_steps", SUCCESS)
MOST_ROWS = 250
"""Rows of a learning curve that `learning.csv` keeps: as many as a picture shows."""
FILE_WIDTH = 120
"""Characters of a table's line that goes into a file."""
EVALUATED_ON = "evaluated on"
"""Column of the actuator on which policies of other runs were evaluated."""


@spec
class RunSelection:
    """Which runs to compare.

    Attributes:
        runs: Run folders, folders of such (a sweep), or patterns of either.
    """

    runs: str | tuple[str, ...]


@spec
class Compare:
    """Compares runs: what differs, success with 95 % intervals, other figures, how they learned; as tables and pictures."""

    session: Session
    compare: RunSelection

    def run(self) -> None:
        """Prints the table and writes `comparison.{json,csv,png}`, and `learning.{csv,png}` where runs trained."""
        patterns = (self.compare.runs,) if isinstance(self.compare.runs, str) else self.compare.runs
        runs = [load_run(folder) for folder in find_runs(patterns)]
        columns = find_differences(runs)
        results = [result for run in runs for result in run.results(columns)]
        groups = group_results(results)
        folder = self.session.folder
        write_json(
            folder / "comparison.json",
            {"schema": 1, "columns": columns, "groups": groups, "runs": results},
        )
        write_text(folder / "comparison.csv", format_csv(columns, results))
        draw_comparison(groups).savefig(folder / "comparison.png", dpi=150)
        self._learning(runs, columns)
        console = Console()
        console.print(
            build_table(columns, groups), width=None if console.is_terminal else FILE_WIDTH
        )
        log.info("%d runs compared in %s", len(runs), folder)

    def _learning(self, runs: Sequence[EvaluatedRun], columns: Sequence[str]) -> None:
        trained = [(run, curve) for run in runs if (curve := read_progress(run.folder))]
        if not trained:
            return
        variations = describe_differences(
            [{"variation": {column: run.says(column) for column in columns}} for run, _ in trained]
        )
        curves: dict[str, list[Curve]] = {}
        lines = []
        for (run, curve), variation in zip(trained, variations, strict=True):
            seed = run.record.get("seed")
            curves.setdefault(variation, []).append(curve)
            reached = next(
                (
                    curve["seconds"][row]
                    for row, rate in enumerate(curve[SUCCESS])
                    if rate >= REACHED
                ),
                None,
            )
            when = (
                f"after {reached:.1f} s"
                if reached is not None
                else f"not in {curve['seconds'][-1]:.0f} s"
            )
            log.info("%s: strict success of %.2f while learning %s", run.folder.name, REACHED, when)
            rows = list(zip(*curve.values(), strict=True))
            lines += [(run.folder, seed, *row) for row in rows[:: -(-len(rows) // MOST_ROWS)]]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(
            [("folder", "seed", *PROGRESS_COLUMNS), *lines]
        )
        write_text(self.session.folder / "learning.csv", text.getvalue())
        draw_learning(curves).savefig(self.session.folder / "learning.png", dpi=150)


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
        """Options of the config groups that say what was run."""
        found = {
            key: value
            for key, value in self.record.get("choices", {}).items()
            if key not in NOT_COMPARED
        }
        if "actuator" in self.evaluation:
            found.setdefault("actuator", self.evaluation["actuator"])
        return found

    def says(self, column: str) -> Any:
        """Returns what this run was made with: a group's option or a single value."""
        return self.choices.get(column, self.values.get(column))

    @property
    def overridden(self) -> set[str]:
        """Dotted keys that were set by hand or by the sweep."""
        keys = {
            override.partition("=")[0].lstrip("+~") for override in self.record.get("overrides", ())
        }
        return {key for key in keys if "." in key and key.split(".")[0] not in NOT_COMPARED}

    def results(self, columns: Sequence[str]) -> list[dict[str, Any]]:
        """Returns the figures of each policy that was evaluated in this run."""
        main = str(self.evaluation.get("policy", "trained"))
        policies = self.evaluation.get("policies") or {main: self.evaluation}
        found = []
        for policy, figures in policies.items():
            made = self.training if self.training and policy == main else self
            variation = {column: made.says(column) for column in columns if column != EVALUATED_ON}
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


def load_run(folder: Path) -> EvaluatedRun:
    """Reads what a run folder says.

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
    """Returns the learning curve of a run; none where nothing was trained."""
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
    """Returns what differs between the runs: choices of groups first, then single values that were overridden.

    An evaluation of a trained policy counts as what the policy was trained with; on what it was
    evaluated is then a column.
    """
    made = [run.training or run for run in runs]
    groups = sorted({key for run in made for key in run.choices})
    groups = [key for key in groups if len({repr(run.choices.get(key)) for run in made}) > 1]
    above = {key for run in made for key in run.overridden}
    keys = sorted(
        {
            key
            for run in made
            for key in run.values
            if any(key == top or key.startswith(top + ".") for top in above)
        }
    )
    keys = [key for key in keys if len({repr(run.values.get(key)) for run in made}) > 1]
    elsewhere = [EVALUATED_ON] if any(run.training for run in runs) else []
    return groups + keys + elsewhere


def _find_training_run(folder: Path, values: dict[str, Any]) -> EvaluatedRun | None:
    """Returns the run whose policy was evaluated in a folder; runs may have been moved together."""
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
    """Returns one entry for each policy and variation, over its seeds.

    A rate of several seeds has Student's interval over the seeds, as training differs from seed to
    seed; that of a single run has Wilson's over its episodes.
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
            **{
                name: _average_seeds([member[name] for member in members], name in RATES)
                for name in (*RATES, *MEASURES)
            },
        }
        for members in sets.values()
    ]


def format_csv(columns: Sequence[str], results: Sequence[dict[str, Any]]) -> str:
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
    """Returns the compared figures of one policy, each with mean and interval."""
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
    """Returns a figure of `evaluation.json`: a number, or the middle of a distribution."""
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
    return {
        key: value
        for name, child in node.items()
        for key, value in _flatten(child, f"{prefix}.{name}" if prefix else str(name)).items()
    }
