"""Statistics over seeds: interquartile means with bootstrap intervals, differences by seed.

Source: Agarwal et al. 2021, Deep reinforcement learning at the edge of the statistical precipice
(arXiv 2108.13264), sections 4.1 and 4.3, and its library rliable.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table
from scipy import stats

from brokk_rl.comparison import EVALUATED_ON, SUCCESS_RATE, describe_differences
from brokk_rl.errors import ConfigError
from brokk_rl.intervals import CONFIDENCE, compute_student_interval
from brokk_rl.plot import BLUE, GREY, ORANGE, make_figure, remove_frame

TRIMMED = 0.25
"""Share of scores dropped at each end; the middle half is left."""
RESAMPLES = 50_000
"""Bootstrap resamples, as rliable's default."""
POLICY = "policy"
LATEX = str.maketrans({sign: f"\\{sign}" for sign in "&%$#_{}"} | {"\\": r"\textbackslash{}"})


@dataclass(frozen=True)
class Method:
    """One compared method: a policy and what varies, over seeds and conditions of evaluation.

    Attributes:
        policy: The policy in `evaluation.json`.
        variation: Column of difference to value, without the condition of evaluation.
        scores: Strict success by condition and seed.
    """

    policy: str
    variation: dict[str, Any]
    scores: dict[str, dict[int, float]]

    @property
    def strata(self) -> list[np.ndarray]:
        """Scores of each condition."""
        return [np.array(list(found.values())) for found in self.scores.values()]

    def matches(self, wanted: Mapping[str, Any]) -> bool:
        """Return true if policy and variation have these values."""
        own = {POLICY: self.policy, **self.variation}
        return all(key in own and str(own[key]) == str(value) for key, value in wanted.items())


def collect_methods(results: Sequence[Mapping[str, Any]]) -> list[Method]:
    """Return the methods among the results of runs, in their order."""
    methods: dict[str, Method] = {}
    for result in results:
        rate = result[SUCCESS_RATE]["mean"]
        if rate is None:
            continue
        variation = dict(result["variation"])
        condition = str(variation.pop(EVALUATED_ON, ""))
        name = json.dumps([result[POLICY], variation])
        method = methods.setdefault(name, Method(result[POLICY], variation, {}))
        method.scores.setdefault(condition, {})[result["seed"]] = rate
    return list(methods.values())


def choose_baseline(methods: Sequence[Method], wanted: Mapping[str, Any] | None) -> Method:
    """Return the method to which the others are compared: the one asked for, else the first.

    Raises:
        ConfigError: No method has the values asked for, or several have.
    """
    if wanted is None:
        return methods[0]
    found = [method for method in methods if method.matches(wanted)]
    if len(found) != 1:
        rows = [str({POLICY: one.policy, **one.variation}) for one in methods]
        raise ConfigError(
            f"compare.baseline={dict(wanted)}: expected the values of one row, {len(found)} rows have them; "
            f"the rows are {', '.join(rows)}"
        )
    return found[0]


def compute_interquartile_mean(
    strata: Sequence[np.ndarray], generator: np.random.Generator
) -> tuple[float, tuple[float, float] | None]:
    """Return the interquartile mean of all scores with its stratified bootstrap interval.

    Runs are drawn again within each stratum. The interval is that of percentiles; it is `None`
    where no stratum has two runs.

    Args:
        strata: Scores of the runs on each task or plant, `(seeds,)` each.
        generator: Draws the resamples.
    """
    mean = float(stats.trim_mean(np.concatenate(strata), TRIMMED))
    if max(len(scores) for scores in strata) < 2:
        return mean, None
    drawn = []
    for scores in strata:
        drawn.append(scores[generator.integers(len(scores), size=(RESAMPLES, len(scores)))])
    means = stats.trim_mean(np.concatenate(drawn, axis=1), TRIMMED, axis=1)
    low, high = np.quantile(means, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return mean, (float(low), float(high))


def compute_differences(method: Method, baseline: Method) -> dict[int, float]:
    """Return by seed how much more often a method succeeds than the baseline.

    Only seeds and conditions that both have count. Conditions are averaged before the difference
    is taken: the seed is the unit of chance.
    """
    by_seed: dict[int, list[float]] = {}
    for condition in method.scores.keys() & baseline.scores.keys():
        own, other = method.scores[condition], baseline.scores[condition]
        for seed in own.keys() & other.keys():
            by_seed.setdefault(seed, []).append(own[seed] - other[seed])
    return {seed: float(np.mean(found)) for seed, found in sorted(by_seed.items())}


def summarise_methods(
    methods: Sequence[Method], baseline: Method, generator: np.random.Generator
) -> list[dict[str, Any]]:
    """Return for each method its interquartile mean and its difference to the baseline."""
    summaries = []
    for method in methods:
        mean, interval = compute_interquartile_mean(method.strata, generator)
        by_seed = {} if method is baseline else compute_differences(method, baseline)
        difference = None
        if by_seed:
            values = list(by_seed.values())
            difference = {
                "mean": float(np.mean(values)),
                "ci95": compute_student_interval(values),
                "by_seed": by_seed,
            }
        summaries.append(
            {
                POLICY: method.policy,
                "variation": method.variation,
                "conditions": [name for name in method.scores if name],
                "runs": sum(len(found) for found in method.scores.values()),
                "interquartile_mean": mean,
                "ci95": interval,
                "is_baseline": method is baseline,
                "difference": difference,
            }
        )
    return summaries


def build_seed_table(summaries: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table that the terminal shows."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    table.add_column("method", overflow="fold")
    for heading in ("runs", "interquartile mean", "95 %", "difference by seed", "95 %"):
        table.add_column(heading, justify="right")
    for label, summary in zip(_label(summaries), summaries, strict=True):
        mean, interval, difference, spread = _format_figures(summary)
        table.add_row(label, str(summary["runs"]), mean, interval, difference, spread)
    return table


def format_latex(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Return the table for a paper, in LaTeX with the package booktabs."""
    lines = [
        r"\begin{tabular}{lrrlrl}",
        r"\toprule",
        r"Method & Runs & IQM & 95\,\% & Difference & 95\,\% \\",
        r"\midrule",
    ]
    for label, summary in zip(_label(summaries), summaries, strict=True):
        cells = [label.translate(LATEX), str(summary["runs"])]
        for figure in _format_figures(summary):
            cells.append(re.sub(r"[-+][\d.]+", r"$\g<0>$", figure))  # the minus of mathematics
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join((*lines, r"\bottomrule", r"\end{tabular}", ""))


def draw_seeds(summaries: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw interquartile means with intervals, and the difference to the baseline of each seed."""
    figure = make_figure(11.0, 1.6 + 0.45 * len(summaries))
    means, differences = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(summaries))[::-1]
    for row, summary in zip(rows, summaries, strict=True):
        means.plot(summary["interquartile_mean"], row, "o", color=BLUE)
        if summary["ci95"]:
            means.plot(summary["ci95"], [row, row], "-", color=BLUE)
        difference = summary["difference"]
        if difference is None:
            continue
        seeds = list(difference["by_seed"].values())
        differences.plot(seeds, [row - 0.18] * len(seeds), ".", color=GREY)
        differences.plot(difference["mean"], row, "o", color=ORANGE)
        if difference["ci95"]:
            differences.plot(difference["ci95"], [row, row], "-", color=ORANGE)
    means.set(
        yticks=rows,
        yticklabels=_label(summaries),
        xlabel="interquartile mean of strict success, 95 % of resamples",
        ylim=(-0.6, len(summaries) - 0.4),
    )
    means.tick_params(axis="y", length=0)
    differences.axvline(0.0, color="black", linewidth=0.8)
    differences.set_xlabel("difference to the baseline: each seed, mean, 95 % interval")
    for axis in (means, differences):
        axis.grid(axis="x", linewidth=0.4)
        remove_frame(axis)
    return figure


def _label(summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a short name of each method."""
    labels = []
    for summary, text in zip(summaries, describe_differences(summaries), strict=True):
        labels.append(", ".join(filter(None, (summary[POLICY], text))))
    return labels


def _format_figures(summary: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Return interquartile mean, its interval, difference and its interval as text."""
    difference = summary["difference"]
    if difference is None:
        shown, spread = ("baseline" if summary["is_baseline"] else "–"), ""
    else:
        shown = f"{difference['mean']:+.3f}"
        spread = _format_interval(difference["ci95"], "+.3f")
    interval = _format_interval(summary["ci95"], ".3f")
    return f"{summary['interquartile_mean']:.3f}", interval, shown, spread


def _format_interval(interval: Sequence[float] | None, form: str) -> str:
    return f"{interval[0]:{form}} to {interval[1]:{form}}" if interval else ""
