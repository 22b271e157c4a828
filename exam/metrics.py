"""Metrics of an exam: rates with Wilson intervals, medians with bootstrap intervals over cases; one page with their table."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.console_table import MISSING
from brokk_rl.report import render_page
from brokk_rl.session import write_text
from brokk_rl.statistics import CONFIDENCE, compute_wilson_interval
from diagnosis.answer import parse_answer
from exam.case_distribution import KINDS, CaseDistribution
from exam.run_cases import GivenAnswer
from exam.score import CaseScore, score_answer

log = logging.getLogger(__name__)

NUM_DRAWS = 1000
"""Bootstrap draws; the usual number for 95 % intervals."""
SURE = 0.9
"""Stated probability from which a statement counts as sure: of calibrated ones nine in ten or more are true."""

Metric = dict[str, Any]
"""`value`, `of` and `ci95`; `None` where there is nothing to count."""


@dataclass(frozen=True)
class MetricDefinition:
    """A row of the report.

    Attributes:
        title: Its label.
        kinds: Kinds of cases that count.
        collect: Numbers of a case; a case may have none or several.
        is_median: The median of one number a case, not the rate of true ones.
    """

    title: str
    kinds: tuple[str, ...]
    collect: Callable[[CaseScore], Sequence[Any]]
    is_median: bool = False


def list_errors(score: CaseScore) -> list[float]:
    """Return the median error of the parameters of a case, if it has any."""
    errors = [one.error for one in score.numbers]
    return [float(np.median(errors))] if errors else []


ONE, SEVERAL, KNOWN = ("one",), ("several",), ("one", "several")
ROWS: dict[str, tuple[Any, ...]] = {
    "top1": ("one effect: named first", ONE, lambda s: [s.first]),
    "top1_equivalent": ("… or an equivalent", ONE, lambda s: [s.first_equivalent]),
    "top1_other_hand": ("… field by another hand", ONE, lambda s: [s.first] if s.other_hand else []),
    "exactly_one": ("one effect: nothing else named", ONE, lambda s: [s.exact]),
    "exactly_one_equivalent": ("… nothing but equivalents", ONE, lambda s: [s.exact_equivalent]),
    "exact_set": ("several effects: exact set", SEVERAL, lambda s: [s.exact]),
    "exact_set_equivalent": ("… or equivalents", SEVERAL, lambda s: [s.exact_equivalent]),
    "joints": ("joints right", KNOWN, lambda s: s.joints_right),
    "false_alarms_none": ("unchanged machines: an effect or `unknown`", ("none",), lambda s: [s.alarm]),
    "false_alarms_other_hand": ("… of these, field by another hand", ("none",), lambda s: [s.alarm] if s.other_hand else []),
    "false_alarms_faint": ("faintly changed: a false effect or `unknown`", ("faint",), lambda s: [s.alarm]),
    "unknown_recall": ("outside causes: said unknown", ("outside",), lambda s: [s.verdict == "unknown"]),
    "unknown_wrongly": ("effects called unknown", KNOWN, lambda s: [s.verdict == "unknown"]),
    "missed": ("effects called none", KNOWN, lambda s: [s.verdict == "none"]),
    "sure": ("said with 0.9 or more: right", KINDS, lambda s: [one.is_true for one in s.claims if one.probability >= SURE]),
    "parameter_error": ("size: median error", KINDS, list_errors, True),
    "cover_90": ("size: inside 90 %", KINDS, lambda s: [one.in_90 for one in s.numbers]),
    "closed_examined": ("gap closed, withheld parts", KNOWN, lambda s: [] if s.examined is None else [s.examined], True),
}  # fmt: skip
METRICS = {key: MetricDefinition(*row) for key, row in ROWS.items()}
"""All metrics of the report's table, in its order."""


def compute_metrics(scores: Sequence[CaseScore], not_begun: int = 0) -> dict[str, Any]:
    """Return all metrics of an exam as plain JSON data.

    Args:
        scores: Of the cases that somebody began.
        not_begun: Number of further cases; they are reported and count for nothing.
    """
    by_kind: dict[str, list[CaseScore]] = {kind: [] for kind in KINDS}
    for score in scores:
        by_kind[score.kind].append(score)
    found: dict[str, Any] = {
        "cases": {kind: len(of_kind) for kind, of_kind in by_kind.items()},
        "sat": {"value": len(scores), "of": len(scores) + not_begun},
        "failed": sum(score.verdict == "failed" for score in scores),
    }
    for key, metric in METRICS.items():
        parts = [metric.collect(score) for score in scores if score.kind in metric.kinds]
        values = list(chain.from_iterable(parts))
        found[key] = compute_median(values) if metric.is_median else compute_rate(values)
    return found | {"said": count_answers(scores)}


def compute_rate(right: Sequence[bool]) -> Metric:
    """Return share, number and Wilson interval."""
    interval = compute_wilson_interval(sum(right), len(right))
    value = float(np.mean(right)) if len(right) else None
    return {"value": value, "of": len(right), "ci95": list(interval)}


def compute_median(values: Sequence[float]) -> Metric:
    """Return the median of one number a case, their number, and the percentile bootstrap interval."""
    if not values:
        return {"value": None, "of": 0, "ci95": None}
    interval = [values[0], values[0]]
    if len(values) > 1:
        drawn = np.random.default_rng(0).choice(values, (NUM_DRAWS, len(values)))
        tail = 0.5 * (1.0 - CONFIDENCE)
        interval = np.quantile(np.median(drawn, 1), [tail, 1.0 - tail]).tolist()
    return {"value": float(np.median(values)), "of": len(values), "ci95": interval}


def count_answers(scores: Sequence[CaseScore]) -> dict[str, dict[str, int]]:
    """Return how often each answer was given to each cause, over all cases but those below the noise."""
    found: dict[str, dict[str, int]] = {}
    for score in scores:
        if score.kind != "faint":
            cause = score.outside or "+".join(score.truth) or "none"
            said = found.setdefault(cause, {})
            answer = "+".join(score.named) or score.verdict
            said[answer] = said.get(answer, 0) + 1
    return dict(sorted(found.items()))


def build_table(
    labels: Sequence[Mapping[str, Any]], given: Mapping[str, GivenAnswer], mix: CaseDistribution
) -> dict[str, Any]:
    """Return the figures of answers; cases that nobody began are left out and counted.

    Args:
        labels: Opened labels of the exam.
        given: Answers by case.
        mix: Says which effects cannot be told apart, and which ones all joints have together.
    """
    scores = []
    for label in labels:
        case = label["case"]
        if case not in given:
            continue
        one = given[case]
        answer = None if one.answer is None else parse_answer(one.answer, f"case {case}")
        scores.append(score_answer(label, answer, mix, one.examined))
    not_begun = len(labels) - len(scores)
    if not_begun:
        log.warning("%d of %d cases were not begun and are left out", not_begun, len(labels))
    return compute_metrics(scores, not_begun)


REPORT_FILE = "exam.html"
TEMPLATE = Path(__file__).with_name("exam.html.jinja")


def build_rows(tables: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Return the rows of the table of all candidates, the title of each first."""
    rows = []
    for key, metric in METRICS.items():
        rows.append([metric.title, *(_format_metric(table[key]) for table in tables.values())])
    sat = [f"{table['sat']['value']} of {table['sat']['of']}" for table in tables.values()]
    failed = [str(table["failed"]) for table in tables.values()]
    return [*rows, ["cases sat", *sat], ["no answer", *failed]]


def _format_metric(metric: Mapping[str, Any]) -> str:
    """Return a metric with its interval."""
    value, interval = metric["value"], metric["ci95"]
    if value is None:
        return MISSING
    note = f" ({interval[0]:.2f} to {interval[1]:.2f}, of {metric['of']})" if interval else ""
    return f"{value:.2f}{note}"


def write_report(
    folder: Path, exam: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write `exam.html`: the exam, the table of all candidates, and by cause what each of them said."""
    values = {
        "title": f"Exam of {', '.join(tables)}",
        "exam": exam,
        "tables": tables,
        "rows": build_rows(tables),
    }
    write_text(folder / REPORT_FILE, render_page(TEMPLATE, values))
