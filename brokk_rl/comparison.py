"""Evaluated runs side by side: what they differ in, means over seeds, differences to a baseline."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from brokk_rl.errors import ConfigError
from brokk_rl.session import RESOLVED, read_record
from brokk_rl.statistics import (
    compute_interquartile_mean,
    compute_student_interval,
    compute_wilson_interval,
)

EVALUATION = "evaluation.json"
SUCCESS_RATE = "success_strict"
RATE = "success_"
"""Beginning of the names of figures that are rates."""
NOT_FIGURES = ("episodes", "seed")
"""Numbers of `evaluation.json` that are not compared."""
NOT_COMPARED = ("session", "mode", "hydra", "ablation", "preset")
"""Choices and overrides that say how a run was started, not what it was."""
EVALUATED_ON = "evaluated on"
"""Column of the actuator on which policies of other runs were evaluated."""

Result = dict[str, Any]
"""One policy of one run: `folder`, `policy`, `seed`, `variation` (column of difference to value),
`episodes`, and each figure by its name: `mean` and interval `ci95`."""
ABOUT = ("folder", "policy", "seed", "variation", "episodes")
"""Fields of a result that are no figures."""


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

    def get_setting(self, column: str) -> Any:
        """Return the group option or single value that this run was made with."""
        return self.choices.get(column, self.values.get(column))

    def list_results(self, columns: Sequence[str]) -> list[Result]:
        """Return one result for each policy that this run evaluated.

        Raises:
            ConfigError: The evaluation lacks what every evaluation has.
        """
        main = str(self.evaluation.get("policy", "trained"))
        policies = self.evaluation.get("policies") or {main: self.evaluation}
        results = []
        for policy, evaluation in policies.items():
            made = self.training if self.training and policy == main else self
            variation = {column: made.get_setting(column) for column in columns}
            if EVALUATED_ON in columns:
                variation[EVALUATED_ON] = self.choices.get("actuator")
            result = {"folder": str(self.folder), "policy": policy, "seed": made.seed}
            result["variation"] = variation
            results.append(result | _collect_figures(self.folder, evaluation))
        return results


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
        values = _flatten(yaml.safe_load(path.read_text())) if path.exists() else {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); evaluate the run again or leave it out of compare.runs"
        ) from error
    record = read_record(folder) or {}
    choices = {}
    for key, option in record.get("choices", {}).items():
        if key not in NOT_COMPARED:
            choices[key] = option
    if "actuator" in evaluation:
        choices.setdefault("actuator", evaluation["actuator"])
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
        training=_find_training_run(folder, values),
    )


def _find_training_run(folder: Path, values: Mapping[str, Any]) -> EvaluatedRun | None:
    """Return the run that trained the evaluated policy, also where both folders were moved."""
    named = values.get("policy.path")
    if not isinstance(named, str):
        return None
    for place in (Path(named), folder.parent / Path(named).name):
        is_other = place.resolve() != folder.resolve()
        if is_other and (place / EVALUATION).is_file() and (place / RESOLVED).is_file():
            return load_run(place)
    return None


def _flatten(node: Any) -> dict[str, Any]:
    """Return the values of nested nodes by dotted key; a list is one value."""
    if not isinstance(node, dict):
        return {}
    flat = {}
    for name, child in node.items():
        if not isinstance(child, dict):
            flat[str(name)] = child
            continue
        for key, value in _flatten(child).items():
            flat[f"{name}.{key}"] = value
    return flat


def _collect_figures(folder: Path, evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """Return the number of episodes and the figures of one policy, with mean and interval."""
    try:
        episodes = int(evaluation["episodes"])
        evaluation[SUCCESS_RATE]
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{folder / EVALUATION} lacks {error}; evaluate the run again") from error
    found: dict[str, Any] = {"episodes": episodes}
    for name, value in evaluation.items():
        if isinstance(value, dict):
            if not {"mean", "median"} & value.keys():
                continue
            value = value.get("median", value.get("mean"))
        if name in NOT_FIGURES or not isinstance(value, int | float | None):
            continue
        interval = None
        if name.startswith(RATE) and value is not None:
            interval = compute_wilson_interval(value * episodes, episodes)
        found[name] = {"mean": value, "ci95": interval}
    return found


def find_differences(runs: Sequence[EvaluatedRun]) -> list[str]:
    """Return the columns in which runs differ: group options first, then overridden values.

    An evaluation of a stored policy counts as the run that trained the policy. The actuator of the
    evaluation is then a column of its own.
    """
    made = [run.training or run for run in runs]
    overridden = set().union(*(run.overridden for run in made))
    inside = tuple(f"{key}." for key in overridden)
    groups: set[str] = set()
    keys: set[str] = set()
    for run in made:
        groups |= run.choices.keys()
        keys |= {key for key in run.values if key in overridden or key.startswith(inside)}
    columns = [key for key in sorted(groups) if _is_varied(run.choices.get(key) for run in made)]
    columns += [key for key in sorted(keys) if _is_varied(run.values.get(key) for run in made)]
    if any(run.training for run in runs):
        columns.append(EVALUATED_ON)
    return columns


def _is_varied(values: Iterable[Any]) -> bool:
    return len(set(map(repr, values))) > 1


def list_figures(results: Sequence[Result]) -> list[str]:
    """Return the names of the figures that a result has, rates first."""
    names: dict[str, None] = {}
    for result in results:
        names.update(dict.fromkeys(name for name in result if name not in ABOUT))
    return sorted(names, key=lambda name: not name.startswith(RATE))


def group_results(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return one entry for each policy and variation, averaged over its seeds.

    A rate of several seeds has Student's interval over seeds, since training differs between seeds.
    A rate of a single run has Wilson's interval over its episodes.
    """
    frame = pd.DataFrame(results)
    keys = [json.dumps([result["policy"], result["variation"]]) for result in results]
    groups = []
    for _, members in frame.groupby(keys, sort=False):
        group = members.iloc[0][["policy", "variation"]].to_dict()
        group |= {"seeds": members["seed"].tolist(), "runs": len(members)}
        for name in list_figures(results):
            group[name] = _average_seeds(members[name].dropna().tolist(), name)
        groups.append(group)
    return groups


def _average_seeds(figures: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    """Return mean and interval of a figure over runs."""
    if len(figures) == 1:
        return figures[0]
    values = [figure["mean"] for figure in figures if figure["mean"] is not None]
    interval = compute_student_interval(values)
    if interval and name.startswith(RATE):
        interval = max(0.0, interval[0]), min(1.0, interval[1])
    return {"mean": float(np.mean(values)) if values else None, "ci95": interval}


def summarise_methods(
    results: Sequence[Result], wanted: Mapping[str, Any] | None, generator: np.random.Generator
) -> list[dict[str, Any]]:
    """Return for each method its interquartile mean and its difference to the baseline.

    A method is a policy and what varies, over seeds and conditions of evaluation. Differences are
    those of the same seed and condition. Conditions are averaged first: the seed is the unit of
    chance.

    Args:
        results: Results; those without a rate of strict success are left out.
        wanted: Values of the baseline; `None` for the first method.
        generator: Draws the resamples of intervals.

    Raises:
        ConfigError: No method has the values of the baseline, or several have.
    """
    methods: dict[str, dict[str, Any]] = {}
    scores: dict[tuple[str, str, Any], float] = {}
    for result in results:
        if result[SUCCESS_RATE]["mean"] is None:
            continue
        variation = dict(result["variation"])
        condition = str(variation.pop(EVALUATED_ON, ""))
        method = {"policy": result["policy"], "variation": variation}
        name = json.dumps(method)
        methods[name] = method
        scores[name, condition, result["seed"]] = result[SUCCESS_RATE]["mean"]
    if not methods:
        return []
    baseline = _choose_baseline(methods, wanted)
    table = pd.Series(scores).rename_axis(["method", "condition", "seed"])
    summaries = []
    for name, method in methods.items():
        own: Any = table[name]
        strata = own.groupby("condition", sort=False).agg(np.array)
        mean, interval = compute_interquartile_mean(strata.tolist(), generator)
        summaries.append(
            {
                **method,
                "conditions": [condition for condition in strata.index if condition],
                "runs": len(own),
                "interquartile_mean": mean,
                "ci95": interval,
                "is_baseline": name == baseline,
                "difference": None
                if name == baseline
                else _compare(own, pd.Series(table[baseline])),
            }
        )
    return summaries


def _compare(own: pd.Series, baseline: pd.Series) -> dict[str, Any] | None:
    """Return by seed how much more often a method succeeds; `None` where no seed is shared."""
    by_seed: Any = (own - baseline).dropna().groupby("seed").mean()
    if by_seed.empty:
        return None
    interval = compute_student_interval(by_seed.tolist())
    return {"mean": float(by_seed.mean()), "ci95": interval, "by_seed": by_seed.to_dict()}


def _choose_baseline(
    methods: Mapping[str, Mapping[str, Any]], wanted: Mapping[str, Any] | None
) -> str:
    """Return the name of the method to which the others are compared."""
    if wanted is None:
        return next(iter(methods))
    rows = {name: {"policy": one["policy"], **one["variation"]} for name, one in methods.items()}
    found = []
    for name, row in rows.items():
        if all(key in row and str(row[key]) == str(value) for key, value in wanted.items()):
            found.append(name)
    if len(found) != 1:
        raise ConfigError(
            f"compare.baseline={dict(wanted)}: expected the values of one row, {len(found)} rows "
            f"have them; the rows are {', '.join(map(str, rows.values()))}"
        )
    return found[0]


def label_rows(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a short name of each row: its policy, and the values that most others lack."""
    differences = describe_differences([row["variation"] for row in rows])
    return [
        ", ".join(filter(None, (row["policy"], text)))
        for row, text in zip(rows, differences, strict=True)
    ]


def describe_differences(variations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return for each variation the values that it does not share with most others.

    Where no value of a column is the most frequent, every value counts as unusual.
    """
    columns = list(variations[0])
    endings = Counter(column.rpartition(".")[2] for column in columns)
    texts = [""] * len(variations)
    for column in columns:
        values = [str(variation[column]) for variation in variations]
        counts = Counter(values).most_common(2)
        has_usual = len(counts) == 1 or counts[0][1] > counts[1][1]
        usual = counts[0][0] if has_usual else None
        ending = column.rpartition(".")[2]
        name = ending if endings[ending] == 1 else column
        for row, value in enumerate(values):
            if value != usual:
                texts[row] += f"{', ' if texts[row] else ''}{name} {value}"
    return texts
