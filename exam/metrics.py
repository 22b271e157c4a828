"""Metrics of an exam: rates with Wilson intervals, all others with bootstrap intervals over cases.

F1 and AUROC are those of scikit-learn (the optional extra `exam`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib import import_module
from itertools import pairwise
from operator import attrgetter
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.statistics import CONFIDENCE, compute_wilson_interval
from exam.case_distribution import KINDS
from exam.score import QUIET_KINDS, CaseScore, Claim, ParameterScore

NUM_DRAWS = 1000
"""Bootstrap draws; the usual number for 95 % intervals."""
NUM_BINS = 10
"""Bins of the reliability diagram and of the expected calibration error; the usual number."""
SIZES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.01)
"""Edges of the detection curve over the size of an effect, of typical; chosen by hand: about 30
cases a bin in an exam of 220."""
MOVED_RAD = (0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 1.0)
"""Edges of the same curve over the change of the motion, rad: each bin doubles."""

Metric = dict[str, Any]


def import_sklearn(module: str, purpose: str) -> Any:
    """Return a module of scikit-learn.

    Raises:
        ConfigError: scikit-learn is not installed.
    """
    try:
        return import_module(f"sklearn.{module}")
    except ImportError as error:
        raise ConfigError(f"{purpose} needs scikit-learn: pip install 'brokk-rl[exam]'") from error


def compute_rate(right: Sequence[bool]) -> Metric:
    """Return share, number and Wilson interval."""
    low, high = compute_wilson_interval(sum(right), len(right))
    return {
        "value": float(np.mean(right)) if right else None,
        "of": len(right),
        "ci95": [low, high],
    }


def bootstrap_over_cases(
    scores: Sequence[CaseScore],
    metric: Callable[[Sequence[CaseScore]], float | None],
    seed: int = 0,
) -> Metric:
    """Return a metric with its percentile bootstrap interval over cases."""
    value = metric(scores)
    if value is None:
        return {"value": None, "of": len(scores), "ci95": None}
    generator, drawn = np.random.default_rng(seed), []
    known: dict[bytes, float | None] = {}  # draws of a few cases repeat
    for _ in range(NUM_DRAWS):
        rows = generator.integers(len(scores), size=len(scores))
        key = rows.tobytes()
        if key not in known:
            known[key] = metric(list(map(scores.__getitem__, rows)))
        if known[key] is not None:
            drawn.append(known[key])
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(drawn, [tail, 100.0 - tail]) if drawn else (value, value)
    return {"value": float(value), "of": len(scores), "ci95": [float(low), float(high)]}


def compute_metrics(scores: Sequence[CaseScore], not_begun: int = 0) -> dict[str, Any]:
    """Return all metrics of an exam as plain JSON data.

    Args:
        scores: Of the cases that somebody began.
        not_begun: Number of further cases; they are reported and count for nothing.
    """
    by_kind: dict[str, list[CaseScore]] = {kind: [] for kind in KINDS}
    for score in scores:
        by_kind[score.kind].append(score)
    one, several, outside = by_kind["one"], by_kind["several"], by_kind["outside"]
    quiet = _select_kinds(scores, QUIET_KINDS)
    known = one + several
    joints: list[bool] = []
    for score in known:
        joints.extend(score.joints_right)
    seconds = [score.seconds for score in scores if score.seconds is not None]
    numbers = _collect_numbers(scores)
    return {
        "cases": {kind: len(of_kind) for kind, of_kind in by_kind.items()},
        "sat": {"value": len(scores), "of": len(scores) + not_begun},
        "failed": sum(score.verdict == "failed" for score in scores),
        "top1": _rate_items(one, attrgetter("first")),
        "top1_strictly": _rate_items(one, attrgetter("first_strictly")),
        "exactly_one": _rate_items(one, _is_exact),
        "macro_f1": bootstrap_over_cases(one, partial(compute_f1, average="macro")),
        "joints": compute_rate(joints),
        "exact_set": _rate_items(several, _is_exact),
        "set_f1": bootstrap_over_cases(several, partial(compute_f1, average="micro")),
        "false_alarms": _compute_false_alarms(quiet),
        "false_alarms_none": _compute_false_alarms(by_kind["none"]),
        "false_alarms_faint": _compute_false_alarms(by_kind["faint"]),
        "unknown_recall": _rate_items(outside, _is_called_unknown),
        "unknown_wrongly": _rate_items(known, _is_called_unknown),
        "unknown_auroc": bootstrap_over_cases(scores, compute_auroc),
        "ece": bootstrap_over_cases(scores, lambda drawn: compute_ece(collect_claims(drawn))),
        "reliability": compute_reliability(collect_claims(scores)),
        "parameter_error": bootstrap_over_cases(scores, compute_parameter_error),
        "cover_90": _rate_items(numbers, attrgetter("in_90")),
        "cover_95": _rate_items(numbers, attrgetter("in_95")),
        "closed_examined": bootstrap_over_cases(known, compute_examined_share),
        "closed_differs": _rate_items(_select_examined(known), attrgetter("differs")),
        "closed_missing": _rate_items(_select_named(scores), _is_without_share),
        "seconds": {"median": _take_median(seconds), "most": max(seconds, default=None)},
        "by_effect": summarize_effects(scores),
        "confusion": count_confusions(one),
        "outside": count_outside_answers(outside),
        "by_size": compute_detection_curve(one, attrgetter("size"), SIZES),
        "by_motion": compute_detection_curve(one, attrgetter("moved_rad"), MOVED_RAD),
    }


def _rate_items(items: Sequence[Any], is_right: Callable[[Any], bool]) -> Metric:
    """Return the rate of the items for which `is_right` holds."""
    return compute_rate(list(map(is_right, items)))


def _select_kinds(scores: Sequence[CaseScore], kinds: Sequence[str]) -> list[CaseScore]:
    return [score for score in scores if score.kind in kinds]


def _collect_numbers(scores: Sequence[CaseScore]) -> list[ParameterScore]:
    numbers: list[ParameterScore] = []
    for score in scores:
        numbers.extend(score.numbers)
    return numbers


def _is_called_unknown(score: CaseScore) -> bool:
    return score.verdict == "unknown"


def _is_called_none(score: CaseScore) -> bool:
    return score.verdict == "none"


def _has_named_effect(score: CaseScore) -> bool:
    return score.verdict not in ("none", "failed")


def _is_exact(score: CaseScore) -> bool:
    return len(score.hits) == len(score.truth) == len(score.named)


def _compute_false_alarms(quiet: Sequence[CaseScore]) -> Metric:
    """Return the share of cases without a visible effect whose answer names one."""
    return _rate_items(quiet, _has_named_effect)


def list_labels(score: CaseScore) -> tuple[set[str], set[str]]:
    """Return the true and the named effects of a case; a name that stands for a true one is it."""
    stands_for = {said: true for true, said in score.hits}
    return set(score.truth), {stands_for.get(name, name) for name in score.named}


def build_indicators(scores: Sequence[CaseScore]) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return the effects that occur, and which are true and which are named in each case, `(N, E)`."""
    labels = [list_labels(score) for score in scores]
    occurring: set[str] = set()
    for is_true, is_named in labels:
        occurring |= is_true | is_named
    effects = sorted(occurring)
    column = {effect: number for number, effect in enumerate(effects)}
    # one empty column more: scikit-learn takes a single column for a binary target
    true, named = np.zeros((2, len(labels), len(effects) + 1), dtype=int)
    for row, (is_true, is_named) in enumerate(labels):
        true[row, list(map(column.__getitem__, is_true))] = 1
        named[row, list(map(column.__getitem__, is_named))] = 1
    return effects, true, named


def compute_f1(scores: Sequence[CaseScore], average: str) -> float | None:
    """Return F1 of the named effects; `None` where there is nothing to count.

    Args:
        scores: Of the cases.
        average: `micro`: over all effects together; `macro`: the mean over the effects that are
            true somewhere, so that a name that is true nowhere lowers only the recall of others.
    """
    if not scores:
        return None
    effects, true, named = build_indicators(scores)
    columns = np.flatnonzero(true.any(0)) if average == "macro" else np.arange(len(effects))
    if not len(columns):
        return None
    metrics = import_sklearn("metrics", "exam.do=score")
    found = metrics.f1_score(true, named, labels=columns, average=average, zero_division=0.0)
    return float(found)


def summarize_effects(scores: Sequence[CaseScore]) -> dict[str, Metric]:
    """Return precision, recall and F1 of each effect over all cases."""
    effects, true, named = build_indicators(scores) if scores else ([], *np.zeros((2, 0, 0), int))
    parameters = _collect_numbers(scores)
    found = {}
    for number, effect in enumerate(effects):
        right = int((true[:, number] & named[:, number]).sum())
        wrong, missed = int(named[:, number].sum()) - right, int(true[:, number].sum()) - right
        f1 = 2.0 * right / (2 * right + wrong + missed) if right + missed else None
        errors = [one.error for one in parameters if one.effect == effect]
        found[effect] = {
            "right": right,
            "wrong": wrong,
            "missed": missed,
            "precision": right / (right + wrong) if right + wrong else None,
            "recall": right / (right + missed) if right + missed else None,
            "f1": f1,
            "parameter_error": _take_median(errors),
        }
    return found


def count_confusions(one: Sequence[CaseScore]) -> dict[str, dict[str, int]]:
    """Return, by true effect, the counts of the first names, or of the verdict without a name."""
    found: dict[str, dict[str, int]] = {}
    for score in one:
        # over classes: a name that stands for the true one is counted as it
        named = score.named[0] if score.named else score.verdict
        _count(found.setdefault(score.truth[0], {}), score.truth[0] if score.first else named)
    return found


def count_outside_answers(outside: Sequence[CaseScore]) -> dict[str, dict[str, int]]:
    """Return, by fault outside the library, the counts of the answers."""
    found: dict[str, dict[str, int]] = {}
    for score in outside:
        _count(found.setdefault(str(score.outside), {}), "+".join(score.named) or score.verdict)
    return found


def _count(row: dict[str, int], name: str) -> None:
    row[name] = row.get(name, 0) + 1


def compute_detection_curve(
    scores: Sequence[CaseScore], measure: Callable[[CaseScore], float], edges: Sequence[float]
) -> list[Metric]:
    """Return, by bins of a size, the rate of right names and of the verdict `none`.

    Args:
        scores: Of cases with one effect.
        measure: Size of one of them.
        edges: Edges of the bins; empty bins are left out.
    """
    found = []
    for low, high in pairwise(edges):
        inside = []
        for score in scores:
            if low <= measure(score) < high:
                inside.append(score)
        if inside:
            right = _rate_items(inside, attrgetter("first"))
            none = _rate_items(inside, _is_called_none)
            found.append({"from": low, "to": high, "right": right, "none": none})
    return found


def compute_auroc(scores: Sequence[CaseScore]) -> float | None:
    """Return the AUROC of the probability of `unknown` for cases outside the library."""
    is_outside = [score.kind == "outside" for score in scores]
    if len(set(is_outside)) < 2:
        return None
    metrics = import_sklearn("metrics", "exam.do=score")
    chances = list(map(attrgetter("unknown"), scores))
    return float(metrics.roc_auc_score(is_outside, chances))


def collect_claims(scores: Sequence[CaseScore]) -> list[Claim]:
    """Return all statements with a probability."""
    claims: list[Claim] = []
    for score in scores:
        claims.extend(score.claims)
    return claims


def compute_reliability(made: Sequence[Claim]) -> list[Metric]:
    """Return, by bins of the stated probability, its mean and the rate of true statements.

    Not `sklearn.calibration.calibration_curve`: it gives no counts, which the intervals need, and
    puts a probability on an edge into the bin below it.
    """
    bins: list[list[Claim]] = [[] for _ in range(NUM_BINS)]
    for claim in made:
        # a certain statement (1.0) belongs to the last bin
        bins[min(int(claim.probability * NUM_BINS), NUM_BINS - 1)].append(claim)
    found = []
    for inside in filter(None, bins):
        stated = float(np.mean(list(map(attrgetter("probability"), inside))))
        found.append({"stated": stated, **_rate_items(inside, attrgetter("is_true"))})
    return found


def compute_ece(made: Sequence[Claim]) -> float | None:
    """Return the expected calibration error.

    It is the mean distance of stated probability and rate of true statements over the bins,
    weighted by their statements.
    """
    if not made:
        return None
    bins = compute_reliability(made)
    return sum(one["of"] * abs(one["stated"] - one["value"]) for one in bins) / len(made)


def compute_parameter_error(scores: Sequence[CaseScore]) -> float | None:
    """Return the median relative error of the parameters."""
    return _take_median(map(attrgetter("error"), _collect_numbers(scores)))


def _select_examined(scores: Sequence[CaseScore]) -> list[CaseScore]:
    """Return the cases with a share of the examiner's and one of the answer's."""
    found = []
    for score in scores:
        if score.examined is not None and score.closed is not None:
            found.append(score)
    return found


def _select_named(scores: Sequence[CaseScore]) -> list[CaseScore]:
    return [score for score in scores if score.named]


def _is_without_share(score: CaseScore) -> bool:
    return score.closed is None


def compute_examined_share(scores: Sequence[CaseScore]) -> float | None:
    """Return the median closed share of the gap by the examiner's own simulation."""
    return _take_median(score.examined for score in scores if score.examined is not None)


def _take_median(values: Iterable[float]) -> float | None:
    given = list(values)
    return float(np.median(given)) if given else None
