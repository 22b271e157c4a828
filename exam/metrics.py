"""Metrics of an exam: rates with Wilson intervals, others with bootstrap intervals over cases; one page with their table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.console_table import MISSING
from brokk_rl.session import write_text
from brokk_rl.statistics import CONFIDENCE, compute_wilson_interval
from exam.case_distribution import KINDS
from exam.score import CaseScore

NUM_DRAWS = 1000
"""Bootstrap draws; the usual number for 95 % intervals."""
NUM_BINS = 10
"""Bins of the expected calibration error; the usual number."""

COUNTS = ("right", "wrong", "missed")
"""Ways in which an effect can be named."""

Metric = dict[str, Any]
"""`value`, `of` and `ci95`; `None` where there is nothing to count."""


@dataclass(frozen=True)
class MetricDefinition:
    """A row of the report.

    Attributes:
        title: Its label.
        kinds: Kinds of cases that count.
        collect: Numbers of a case; a case may have none or several.
        compute: The metric of the numbers of all cases, with an interval by bootstrap over cases;
            `None`: the rate of true ones, with Wilson's.
    """

    title: str
    kinds: tuple[str, ...]
    collect: Callable[[CaseScore], Sequence[Any]]
    compute: Callable[[np.ndarray], float | None] | None = None


def compute_ece(rows: np.ndarray) -> float:
    """Return the expected calibration error of probabilities (first column) of statements (second: 1 if true).

    It is the mean distance of stated probability and rate of true statements over the bins,
    weighted by their statements.
    """
    place = np.minimum((rows[:, 0] * NUM_BINS).astype(int), NUM_BINS - 1)
    apart = np.bincount(place, rows[:, 0] - rows[:, 1], NUM_BINS)
    return float(np.abs(apart).sum() / len(rows))


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
    "ece": ("calibration error", KINDS, lambda s: s.claims, compute_ece),
    "parameter_error": ("size: median error", KINDS, lambda s: [one.error for one in s.numbers], np.median),
    "cover_90": ("size: inside 90 %", KINDS, lambda s: [one.in_90 for one in s.numbers]),
    "closed_examined": ("gap closed, withheld parts", KNOWN, lambda s: [] if s.examined is None else [s.examined], np.median),
    "closed_missing": ("named without closing", KINDS, lambda s: [s.closed is None] if s.named else []),
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
        if metric.compute is None:
            found[key] = compute_rate(list(chain.from_iterable(parts)))
        else:
            found[key] = bootstrap_cases(parts, metric.compute)
    seconds = [score.seconds for score in scores if score.seconds is not None]
    median = float(np.median(seconds)) if seconds else None
    return found | {
        "seconds": {"median": median, "most": max(seconds, default=None)},
        "by_effect": count_effects(scores),
        "said": count_answers([*by_kind["one"], *by_kind["outside"]]),
    }


def compute_rate(right: Sequence[bool]) -> Metric:
    """Return share, number and Wilson interval."""
    interval = compute_wilson_interval(sum(right), len(right))
    value = float(np.mean(right)) if len(right) else None
    return {"value": value, "of": len(right), "ci95": list(interval)}


def bootstrap_cases(
    numbers: Sequence[Sequence[Any]], compute: Callable[[np.ndarray], float | None], seed: int = 0
) -> Metric:
    """Return a metric of the numbers of each case with its percentile bootstrap interval over cases."""
    parts = [np.array(of_case, dtype=float) for of_case in numbers]

    def compute_of(rows: Iterable[int]) -> float | None:
        given = [parts[row] for row in rows if len(parts[row])]
        return compute(np.concatenate(given)) if given else None

    value = compute_of(range(len(parts)))
    if value is None:
        return {"value": None, "of": len(parts), "ci95": None}
    generator = np.random.default_rng(seed)
    draws = generator.integers(len(parts), size=(NUM_DRAWS, len(parts)))
    drawn = [one for one in map(compute_of, draws.tolist()) if one is not None]
    tail = 50.0 * (1.0 - CONFIDENCE)
    interval = np.percentile(drawn, [tail, 100.0 - tail]).tolist()
    return {"value": value, "of": len(parts), "ci95": interval}


def count_effects(scores: Sequence[CaseScore]) -> dict[str, dict[str, int]]:
    """Return how often each effect was named rightly, wrongly and missed, over all cases but those below the noise."""
    found: dict[str, dict[str, int]] = {}
    for score in scores:
        truth, named = {*score.truth}, {*score.named}
        for effect in sorted(truth | named) if score.kind != "faint" else ():
            counts = found.setdefault(effect, dict.fromkeys(COUNTS, 0))
            right = "right" if effect in truth else "wrong"
            counts[right if effect in named else "missed"] += 1
    return dict(sorted(found.items()))


def count_answers(scores: Sequence[CaseScore]) -> dict[str, dict[str, int]]:
    """Return how often each answer was given to a cause that was alone."""
    found: dict[str, dict[str, int]] = {}
    for score in scores:
        said = found.setdefault(score.outside or score.truth[0], {})
        answer = "+".join(score.named) or score.verdict
        said[answer] = said.get(answer, 0) + 1
    return found


REPORT_FILE = "exam.md"
STRICT = (
    "Figures are strict: only the true effect counts. Rows with equivalents also count the effects that the "
    "exam lists as hard to tell apart, and those that an answer names as the same. Rates have 95 % Wilson "
    "intervals, other metrics bootstrap intervals over cases."
)
OPEN = "A development seed: the authors of the candidates may have looked at its cases."


def build_rows(tables: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Return the rows of the table of all candidates, the title of each first."""
    rows = []
    for key, metric in METRICS.items():
        rows.append([metric.title, *(_format_metric(table[key]) for table in tables.values())])
    last = [["seconds a case, median (most)"], ["cases sat"], ["no answer"]]
    for table in tables.values():
        sat, seconds = table["sat"], table["seconds"]
        text = MISSING
        if seconds["median"] is not None:
            text = f"{seconds['median']:.0f} ({seconds['most']:.0f})"
        last[0].append(text)
        last[1].append(f"{sat['value']} of {sat['of']}")
        last[2].append(str(table["failed"]))
    return rows + last


def _format_metric(metric: Mapping[str, Any]) -> str:
    """Return a metric with its interval."""
    value, interval = metric["value"], metric["ci95"]
    if value is None:
        return MISSING
    note = f" ({interval[0]:.2f} to {interval[1]:.2f}, of {metric['of']})" if interval else ""
    return f"{value:.2f}{note}"


def format_markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as Markdown."""
    lines = [list(headings), ["---"] * len(headings)]
    for row in rows:
        lines.append([cell.strip() for cell in row])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_report(
    folder: Path, exam: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write `exam.md`: the exam, the table of all candidates, and by effect what each of them said."""
    kinds = next(iter(tables.values()))["cases"]
    cases = _join_counts({kind: count for kind, count in kinds.items() if count})
    # labels of the first exams name neither
    made = f"machine {exam['machine']} ({', '.join(exam['makes'])}), " if "makes" in exam else ""
    parts = [
        f"# Exam of {', '.join(tables)}",
        f"{exam['num_cases']} cases ({cases}), {made}roughness {exam['roughness']}, seed {exam['seed']}.",
        *([] if exam["sealed"] else [OPEN]),
        STRICT,
        *exam["ledger"],
        format_markdown(["", *tables], build_rows(tables)),
    ]
    for name, table in tables.items():
        parts += [f"## {name}", f"Commit {table['commit'] or MISSING}.", _format_causes(table)]
    parts.append(f"Labels, SHA-256: {exam['labels_sha256']}.")
    write_text(folder / REPORT_FILE, "\n\n".join(part.rstrip() for part in parts) + "\n")


def _format_causes(table: Mapping[str, Any]) -> str:
    """Return a row for each cause: how often it was named, and what was said where it was alone."""
    rows, by_effect, said = [], table["by_effect"], table["said"]
    for cause in [*by_effect, *(one for one in said if one not in by_effect)]:
        counts = by_effect.get(cause, {})
        numbers = [str(counts.get(key, MISSING)) for key in COUNTS]
        rows.append([cause, *numbers, _join_counts(said.get(cause, {}))])
    return format_markdown(["cause", *COUNTS, "said where it was alone"], rows)


def _join_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
