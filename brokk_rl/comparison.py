"""Evaluated runs side by side: what they differ in, means over seeds, differences to a baseline.

A table has a row for each run and policy: `folder`, `policy`, `seed`, a column of text for each
setting in which the runs differ, `episodes`, and the figures. A rate has its interval beside it, in
columns whose names end with `LOW` and `HIGH`.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from scipy import stats

from brokk_rl.errors import ConfigError
from brokk_rl.session import RESOLVED, read_record
from brokk_rl.statistics import CONFIDENCE, compute_student_interval

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


@dataclass(frozen=True)
class EvaluatedRun:
    """One evaluated run.

    Attributes:
        folder: Run folder.
        evaluation: Its `evaluation.json`.
        seed: Seed of the run.
        choices: Chosen options of the config groups that describe the experiment.
        overridden: Dotted keys that the command line or the sweep has set.
        values: Its `resolved.yaml`, flat: dotted key to value.
        training: The run that made the policy which this one evaluated, where it is at hand.
    """

    folder: Path
    evaluation: dict[str, Any]
    seed: int | None
    choices: dict[str, Any]
    overridden: set[str]
    values: dict[str, Any]
    training: EvaluatedRun | None

    @property
    def made(self) -> EvaluatedRun:
        """The run that made the policy: the training, where this is an evaluation elsewhere."""
        return self.training or self

    def describe_setting(self, column: str) -> str:
        """Return the group option or single value that this run was made with, as text."""
        return str(self.choices.get(column, self.values.get(column)))


def find_runs(patterns: Sequence[str]) -> list[Path]:
    """Return the run folders that hold an evaluation, in natural order of their paths.

    Raises:
        ConfigError: A pattern leads to no evaluation.
    """
    found: set[Path] = set()
    for pattern in patterns:
        inside: set[Path] = set()
        for top in glob(pattern):
            inside.update(path.parent for path in Path(top).rglob(EVALUATION))
        if not inside:
            raise ConfigError(
                f"compare.runs: no {EVALUATION} under '{pattern}'; expected run folders, "
                "a sweep's folder, or a pattern of either"
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
        resolved = yaml.safe_load(path.read_text()) if path.exists() else {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); evaluate the run again or leave it out of compare.runs"
        ) from error
    values: Any = pd.json_normalize(resolved, sep=".").iloc[0].to_dict()
    record = read_record(folder) or {}
    choices = {"actuator": evaluation["actuator"]} if "actuator" in evaluation else {}
    for key, option in record.get("choices", {}).items():
        if key not in NOT_COMPARED:
            choices[key] = option
    overridden = set()
    for override in record.get("overrides", ()):
        key = override.partition("=")[0].lstrip("+~")
        # A key without a dot is a group: `choices` has it.
        if "." in key and key.split(".")[0] not in NOT_COMPARED:
            overridden.add(key)
    return EvaluatedRun(
        folder=folder,
        evaluation=evaluation,
        seed=record.get("seed", evaluation.get("seed")),
        choices=choices,
        overridden=overridden,
        values=values,
        training=_find_training_run(folder, values.get("policy.path")),
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
    overridden = set().union(*(run.overridden for run in made))
    inside = tuple(f"{key}." for key in overridden)
    choices = pd.DataFrame([run.choices for run in made])
    values = pd.DataFrame([run.values for run in made])
    values = values[[key for key in values if key in overridden or str(key).startswith(inside)]]
    columns = []
    for table in (choices, values):
        texts: Any = table.map(repr)
        columns += sorted(name for name in texts if texts[name].nunique() > 1)
    return [*columns, EVALUATED_ON] if any(run.training for run in runs) else columns


def tabulate_runs(runs: Sequence[EvaluatedRun], columns: Sequence[str]) -> pd.DataFrame:
    """Return the table of all policies that the runs evaluated; rates come first of the figures.

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
            row |= {column: made.describe_setting(column) for column in columns}
            if EVALUATED_ON in columns:
                row[EVALUATED_ON] = str(run.choices.get("actuator"))
            rows.append(row | _read_figures(run.folder, evaluation))
    table = pd.DataFrame(rows)
    about = ["folder", "policy", "seed", *columns, "episodes"]
    figures = list(table.columns.drop(about))
    ordered = sorted(
        figures, key=lambda name: re.sub(f"{LOW}$|{HIGH}$", "", name) + LOW not in table
    )
    return table[about].join(table[ordered].astype(float))


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
    behind = list(table.columns).index("episodes") + 1 if "episodes" in table else 0
    return [name for name in table.columns[behind:] if not name.endswith((LOW, HIGH))]


def list_rates(table: pd.DataFrame) -> list[str]:
    """Return the names of those figures of `tabulate_runs` that are rates."""
    return [name for name in list_figures(table) if name + LOW in table]


def average_seeds(table: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Return one row for each policy and setting: `seeds`, `runs`, means and intervals of figures.

    A figure of several seeds has Student's interval over seeds, since training differs between
    seeds. A rate of a single run keeps the interval over its episodes.
    """
    groups: Any = table.groupby(["policy", *columns], sort=False)
    figures, rates = list_figures(table), list_rates(table)
    num, mean = groups[figures].count(), groups[figures].mean()
    half = groups[figures].sem() * stats.t.ppf(0.5 + CONFIDENCE / 2, (num - 1).where(num > 1))
    low, high = mean - half, mean + half
    for name in rates:
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


def describe_differences(settings: pd.DataFrame) -> list[str]:
    """Return for each row the values that it does not share with most others.

    Where no value of a column is the most frequent, every value counts as unusual.
    """
    endings = Counter(column.rpartition(".")[2] for column in settings)
    texts: list[list[str]] = [[] for _ in range(len(settings))]
    for column in settings:
        frequent = settings[column].mode()
        ending = column.rpartition(".")[2]
        name = ending if endings[ending] == 1 else column
        for words, value in zip(texts, settings[column], strict=True):
            if len(frequent) > 1 or value != frequent[0]:
                words.append(f"{name} {value}")
    return [", ".join(words) for words in texts]
