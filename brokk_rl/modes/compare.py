"""`brokk mode=compare`: one table of many runs, grouped over seeds, with intervals.

A table has a row for each run and policy: `folder`, `policy`, `seed`, a column of text for each
setting in which the runs differ, `episodes`, and the figures. A rate has its interval beside it, in
columns whose names end with `LOW` and `HIGH`.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import yaml
from annotated_types import MinLen
from scipy import stats

from brokk_rl.console_table import print_table
from brokk_rl.errors import ConfigError
from brokk_rl.plain_files import read_json
from brokk_rl.session import RESOLVED, Session, read_record, write_json, write_text
from brokk_rl.spec import spec
from brokk_rl.statistics import CONFIDENCE, compute_student_interval

log = logging.getLogger(__name__)

EVALUATION = "evaluation.json"
SUCCESS_RATE = "success_strict"
LOW, HIGH = "_low", "_high"
"""Endings of the columns with the 95 % interval of a figure."""
DIFFERENCE = "difference"
"""Column with the mean difference to the baseline."""
NOT_FIGURES = ("episodes", "seed")
"""Numbers of `evaluation.json` that are not compared."""
NOT_COMPARED = ("session", "mode", "hydra", "preset")
"""Choices and overrides that say how a run was started, not what it was."""
EVALUATED_ON = "evaluated on"
"""Column of the actuator on which policies of other runs were evaluated."""


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
    """Compare runs: success with 95 % intervals, as tables."""

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
        _print_groups(groups, columns, table)
        log.info("%d runs compared in %s", len(runs), folder)


def _print_groups(groups: pd.DataFrame, columns: Sequence[str], table: pd.DataFrame) -> None:
    cells = {}
    for name in list_figures(table):
        shown = groups[name].map("{:.3g}".format)
        if name in list_rates(table):
            half = (groups[name + HIGH] - groups[name + LOW]) / 2
            shown += half.map(lambda value: "" if pd.isna(value) else f" ±{value:.3f}")
        cells[name.replace("_", " ")] = shown.where(groups[name].notna(), None)
    cells["difference by seed"] = groups.apply(_format_difference, axis=1)
    printed = groups[["policy", *columns, "runs"]].join(pd.DataFrame(cells))
    headings = ["policy", *columns, "seeds", *cells]
    print_table(headings, printed.astype(object).where(printed.notna(), None).to_numpy().tolist())


def _format_difference(group: Any) -> str | None:
    """Return the difference of a group to the baseline with its interval, as text."""
    if pd.isna(group[DIFFERENCE]):
        return None
    text = f"{group[DIFFERENCE]:+.3f}"
    if pd.notna(group[DIFFERENCE + LOW]):
        text += f" ({group[DIFFERENCE + LOW]:+.3f} to {group[DIFFERENCE + HIGH]:+.3f})"
    return text


@dataclass(frozen=True)
class EvaluatedRun:
    """One evaluated run.

    Attributes:
        folder: Run folder.
        evaluation: Its `evaluation.json`.
        seed: Seed of the run.
        settings: Its `resolved.yaml`, flat: dotted key to value; of a config group the chosen option.
        named: Those of them that the command line or the sweep has chosen or set.
        training: The run that made the policy which this one evaluated, where it is at hand.
    """

    folder: Path
    evaluation: dict[str, Any]
    seed: int | None
    settings: dict[str, Any]
    named: set[str]
    training: EvaluatedRun | None

    @property
    def made(self) -> EvaluatedRun:
        """The run that made the policy: the training, where this is an evaluation elsewhere."""
        return self.training or self


def find_runs(patterns: Sequence[str]) -> list[Path]:
    """Return the run folders that hold an evaluation, in natural order of their paths.

    Raises:
        ConfigError: A pattern leads to no evaluation.
    """
    found: set[Path] = set()
    for pattern in patterns:
        inside = glob(f"{pattern}/**/{EVALUATION}", recursive=True)
        if not inside:
            raise ConfigError(
                f"compare.runs: no {EVALUATION} under '{pattern}'; expected run folders, "
                "a sweep's folder, or a pattern of either"
            )
        found.update(Path(name).parent for name in inside)
    return sorted(found, key=lambda path: [part.zfill(9) for part in re.split(r"(\d+)", str(path))])


def load_run(folder: Path) -> EvaluatedRun:
    """Read evaluation, session record and configuration of a run folder.

    Raises:
        ConfigError: One of its files cannot be read.
    """
    path = folder / EVALUATION
    try:
        evaluation = read_json(path)
        path = folder / RESOLVED
        resolved = yaml.safe_load(path.read_text()) if path.exists() else {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); evaluate the run again or leave it out of compare.runs"
        ) from error
    settings: Any = pd.json_normalize(resolved, sep=".").iloc[0].to_dict()
    record = read_record(folder) or {}
    policy = settings.get("policy.path")
    choices = {"actuator": evaluation["actuator"]} if "actuator" in evaluation else {}
    for key, option in record.get("choices", {}).items():
        if key not in NOT_COMPARED:
            choices[key] = option
    named = set(choices)
    for override in record.get("overrides", ()):
        key = override.partition("=")[0].lstrip("+~")
        # A key without a dot is a group: `choices` has it.
        if "." in key and key.split(".")[0] not in NOT_COMPARED:
            named.add(key)
    return EvaluatedRun(
        folder=folder,
        evaluation=evaluation,
        seed=record.get("seed", evaluation.get("seed")),
        settings=settings | choices,
        named=named,
        training=_find_training_run(folder, policy),
    )


def _find_training_run(folder: Path, policy: object) -> EvaluatedRun | None:
    """Return the run that trained the evaluated policy, also where both folders were moved."""
    if not isinstance(policy, str):
        return None
    for place in (Path(policy), folder.parent / Path(policy).name):
        is_other = place.resolve() != folder.resolve()
        if is_other and (place / EVALUATION).is_file() and (place / RESOLVED).is_file():
            return load_run(place)
    return None


def find_differences(runs: Sequence[EvaluatedRun]) -> list[str]:
    """Return the columns in which runs differ: group options first, then overridden values.

    An evaluation of a stored policy counts as the run that trained the policy. The actuator of the
    evaluation is then a column of its own.
    """
    made = [run.made for run in runs]
    named = set().union(*(run.named for run in made))
    inside = tuple(f"{key}." for key in named if "." in key)
    texts: Any = pd.DataFrame([run.settings for run in made]).map(repr)
    ordered = sorted(texts, key=lambda name: ("." in name, name))
    ours = [name for name in ordered if name in named or name.startswith(inside)]
    columns = [name for name in ours if texts[name].nunique() > 1]
    return [*columns, EVALUATED_ON] if any(run.training for run in runs) else columns


def tabulate_runs(runs: Sequence[EvaluatedRun], columns: Sequence[str]) -> pd.DataFrame:
    """Return the table of all policies that the runs evaluated.

    Raises:
        ConfigError: An evaluation lacks what every evaluation has.
    """
    rows = []
    for run in runs:
        main = str(run.evaluation.get("policy", "trained"))
        policies = run.evaluation.get("policies") or {main: run.evaluation}
        for policy, evaluation in policies.items():
            made = run.made if policy == main else run
            row = {"folder": str(run.folder), "policy": policy, "seed": made.seed}
            row |= {column: str(made.settings.get(column)) for column in columns}
            if EVALUATED_ON in columns:
                row[EVALUATED_ON] = str(run.settings.get("actuator"))
            rows.append(row | _read_figures(run.folder, evaluation))
    table = pd.DataFrame(rows)
    about = ["folder", "policy", "seed", *columns, "episodes"]
    return table[about].join(table.drop(columns=about).astype(float))


def _read_figures(folder: Path, evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """Return the number of episodes and the figures of one policy; a rate with its interval."""
    lacking = {"episodes", SUCCESS_RATE} - evaluation.keys()
    if lacking:
        names = ", ".join(sorted(lacking))
        raise ConfigError(f"{folder / EVALUATION} lacks {names}; evaluate the run again")
    found: dict[str, Any] = {"episodes": int(evaluation["episodes"])}
    for name, value in evaluation.items():
        more = {}
        if isinstance(value, dict) and {"mean", "median"} & value.keys():
            if "ci95" in value:
                more[name + LOW], more[name + HIGH] = value["ci95"]
            value = value.get("median", value.get("mean"))
        if name not in NOT_FIGURES and isinstance(value, int | float | None):
            found |= {name: value, **more}
    return found


def list_figures(table: pd.DataFrame) -> list[str]:
    """Return the names of the figures of a table, without the columns of their intervals."""
    figures = table.loc[:, "episodes":].columns[1:]
    return [name for name in figures if not name.endswith((LOW, HIGH))]


def list_rates(table: pd.DataFrame) -> list[str]:
    """Return the names of those figures of `tabulate_runs` that are rates."""
    return [name for name in list_figures(table) if name + LOW in table]


def average_seeds(table: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Return one row for each policy and setting: `seeds`, `runs`, means and intervals of figures.

    A figure of several seeds has Student's interval over seeds, since training differs between
    seeds. A rate of a single run keeps the interval over its episodes.
    """
    groups: Any = table.groupby(["policy", *columns], sort=False)
    figures = list_figures(table)
    num = groups[figures].count()
    mean = groups[figures].mean()
    half = groups[figures].sem() * stats.t.ppf(0.5 + CONFIDENCE / 2, (num - 1).where(num > 1))
    low = mean - half
    high = mean + half
    for name in list_rates(table):
        low[name] = low[name].clip(lower=0.0).fillna(groups[name + LOW].first())
        high[name] = high[name].clip(upper=1.0).fillna(groups[name + HIGH].first())
    averaged = groups.agg(seeds=("seed", list), runs=("seed", "size")).join(mean)
    return averaged.join(low.add_suffix(LOW)).join(high.add_suffix(HIGH)).reset_index()


def compare_to_baseline(
    groups: pd.DataFrame,
    table: pd.DataFrame,
    columns: Sequence[str],
    wanted: Mapping[str, Any] | None,
) -> pd.DataFrame:
    """Return the groups with their difference to a baseline in strict success.

    Differences are those of the same seed, evaluated on the same actuator.

    Args:
        groups: Result of `average_seeds`.
        table: The rows that were averaged.
        columns: Settings of both.
        wanted: Values of the baseline; `None` for those of the first group.

    Returns:
        `groups` with `difference`, its interval (Student's, over seeds), and `by_seed`; missing
        values for the baseline itself.

    Raises:
        ConfigError: No method has the values of the baseline, or several have.
    """
    keys = ["policy", *(column for column in columns if column != EVALUATED_ON)]
    distinct: Any = groups[keys].drop_duplicates()
    methods = distinct.to_dict("records")
    baseline = _choose_baseline(methods, wanted)
    found = []
    settings: Any = groups[["policy", *columns]]
    for setting in settings.to_dict("records"):
        opponent = setting | baseline
        own = _select_scores(table, setting)
        by_seed: Any = (own - _select_scores(table, opponent)).dropna()
        if opponent == setting:
            by_seed = by_seed.iloc[:0]
        low, high = compute_student_interval(by_seed.tolist()) or (None, None)
        row = {"by_seed": by_seed.to_dict(), DIFFERENCE: by_seed.mean()}
        found.append(row | {DIFFERENCE + LOW: low, DIFFERENCE + HIGH: high})
    return groups.join(pd.DataFrame(found, index=groups.index))


def _select_scores(table: pd.DataFrame, setting: Mapping[str, Any]) -> Any:
    """Return strict success by seed of the rows with these values."""
    own = table[(table[list(setting)] == pd.Series(setting)).all(axis=1)]
    return own.groupby("seed", sort=False)[SUCCESS_RATE].last()


def _choose_baseline(
    methods: Sequence[dict[str, Any]], wanted: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the method to which the others are compared."""
    if wanted is None:
        return methods[0]
    words = {key: str(value) for key, value in wanted.items()}
    found = [row for row in methods if words.items() <= row.items()]
    if len(found) != 1:
        raise ConfigError(
            f"compare.baseline={dict(wanted)}: expected the values of one row, {len(found)} rows "
            f"have them; the rows are {', '.join(map(str, methods))}"
        )
    return found[0]
