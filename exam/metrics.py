"""Metrics of an exam: rates with Wilson intervals, all others with bootstrap intervals over cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import rankdata

from brokk_rl.intervals import CONFIDENCE, compute_wilson_interval
from exam.score import QUIET_KINDS, CaseScore, Claim

NUM_DRAWS = 1000
NUM_BINS = 10
SIZES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.01)
"""Bins of the curve of detection against size."""
MOVED_RAD = (0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 1.0)
"""Bins of the same against what a cause does to the motion."""

MIN_ORACLE_CLOSED = 0.1
"""Share of the gap that the true effects must close before anybody is compared with them."""

Figure = dict[str, Any]


def compute_rate(right: Sequence[bool]) -> Figure:
    """Returns share, number and Wilson interval."""
    low, high = compute_wilson_interval(sum(right), len(right))
    return {
        "value": float(np.mean(right)) if right else None,
        "of": len(right),
        "ci95": [low, high],
    }


def bootstrap_over_cases(
    marks: Sequence[CaseScore], figure: Callable[[Sequence[CaseScore]], float | None], seed: int = 0
) -> Figure:
    """Returns any figure of marks with its percentile bootstrap interval over cases."""
    value = figure(marks)
    if value is None:
        return {"value": None, "of": len(marks), "ci95": None}
    generator, drawn = np.random.default_rng(seed), []
    for _ in range(NUM_DRAWS):
        again = figure([marks[i] for i in generator.integers(len(marks), size=len(marks))])
        if again is not None:
            drawn.append(again)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(drawn, [tail, 100.0 - tail]) if drawn else (value, value)
    return {"value": float(value), "of": len(marks), "ci95": [float(low), float(high)]}


def compute_metrics(marks: Sequence[CaseScore], not_begun: int = 0) -> dict[str, Any]:
    """Returns all figures of an exam, plain JSON; cases that nobody has begun, `not_begun`, are told and count for nothing."""
    one = [mark for mark in marks if mark.kind == "one"]
    several = [mark for mark in marks if mark.kind == "several"]
    quiet = [mark for mark in marks if mark.kind in QUIET_KINDS]
    outside = [mark for mark in marks if mark.kind == "outside"]
    joints = [right for mark in one + several for right in mark.joints_right]
    seconds = [mark.seconds for mark in marks if mark.seconds is not None]
    return {
        "cases": {
            kind: sum(mark.kind == kind for mark in marks)
            for kind in ("none", "faint", "one", "several", "outside")
        },
        "sat": {"value": len(marks), "of": len(marks) + not_begun},
        "failed": sum(mark.verdict == "failed" for mark in marks),
        "top1": compute_rate([mark.first for mark in one]),
        "top1_strictly": compute_rate([mark.first_strictly for mark in one]),
        "exactly_one": compute_rate([_is_exact(mark) for mark in one]),
        "macro_f1": bootstrap_over_cases(one, compute_macro_f1),
        "joints": compute_rate(joints),
        "exact_set": compute_rate([_is_exact(mark) for mark in several]),
        "set_f1": bootstrap_over_cases(several, compute_micro_f1),
        "false_alarms": compute_rate([mark.verdict not in ("none", "failed") for mark in quiet]),
        "false_alarms_none": compute_rate(
            [mark.verdict not in ("none", "failed") for mark in quiet if mark.kind == "none"]
        ),
        "false_alarms_faint": compute_rate(
            [mark.verdict not in ("none", "failed") for mark in quiet if mark.kind == "faint"]
        ),
        "unknown_recall": compute_rate([mark.verdict == "unknown" for mark in outside]),
        "unknown_wrongly": compute_rate([mark.verdict == "unknown" for mark in one + several]),
        "unknown_auroc": bootstrap_over_cases(marks, compute_auroc),
        "ece": bootstrap_over_cases(marks, lambda drawn: compute_ece(collect_claims(drawn))),
        "reliability": compute_reliability(collect_claims(marks)),
        "parameter_error": bootstrap_over_cases(
            marks, lambda drawn: _take_median([n.error for mark in drawn for n in mark.numbers])
        ),
        "cover_90": compute_rate([number.in_90 for mark in marks for number in mark.numbers]),
        "cover_95": compute_rate([number.in_95 for mark in marks for number in mark.numbers]),
        "closed_of_oracle": bootstrap_over_cases(one + several, compute_closed_of_oracle),
        "predicted_off": bootstrap_over_cases(one + several, compute_prediction_error),
        "seconds": {"median": _take_median(seconds), "most": max(seconds, default=None)},
        "by_effect": summarize_effects(marks),
        "confusion": count_confusions(one),
        "outside": count_outside_answers(outside),
        "by_size": compute_detection_curve(one, [mark.size for mark in one], SIZES),
        "by_motion": compute_detection_curve(one, [mark.moved_rad for mark in one], MOVED_RAD),
    }


def _is_exact(mark: CaseScore) -> bool:
    return len(mark.hits) == len(mark.truth) == len(mark.named)


def count_by_effect(marks: Sequence[CaseScore]) -> dict[str, list[int]]:
    """Returns true positives, false positives and false negatives by effect; a name of its class is right."""
    found: dict[str, list[int]] = {}
    for mark in marks:
        hit, said = [true for true, _ in mark.hits], [name for _, name in mark.hits]
        for effect in mark.truth:
            found.setdefault(effect, [0, 0, 0])[0 if effect in hit else 2] += 1
        for effect in mark.named:
            if effect in said:
                said.remove(effect)
            else:
                found.setdefault(effect, [0, 0, 0])[1] += 1
    return found


def compute_f1(right: int, wrong: int, missed: int) -> float:
    """Returns the harmonic mean of precision and recall."""
    return 2.0 * right / max(2 * right + wrong + missed, 1)


def compute_macro_f1(marks: Sequence[CaseScore]) -> float | None:
    """Returns the mean F1 over the effects that are there; what is named and is nowhere lowers that of no effect but its recall."""
    found, there = count_by_effect(marks), {effect for mark in marks for effect in mark.truth}
    return (
        float(np.mean([compute_f1(*found[effect]) for effect in sorted(there)])) if there else None
    )


def compute_micro_f1(marks: Sequence[CaseScore]) -> float | None:
    """Returns F1 over all effects together."""
    total = np.sum([*count_by_effect(marks).values(), [0, 0, 0]], 0)
    return compute_f1(*total.tolist()) if total.any() else None


def summarize_effects(marks: Sequence[CaseScore]) -> dict[str, Figure]:
    """Returns precision, recall and F1 of each effect over all cases."""
    found = {}
    for effect, (right, wrong, missed) in sorted(count_by_effect(marks).items()):
        found[effect] = {
            "right": right,
            "wrong": wrong,
            "missed": missed,
            "precision": right / (right + wrong) if right + wrong else None,
            "recall": right / (right + missed) if right + missed else None,
            "f1": compute_f1(right, wrong, missed) if right + missed else None,
            "parameter_error": _take_median(
                [n.error for mark in marks for n in mark.numbers if n.effect == effect]
            ),
        }
    return found


def count_confusions(one: Sequence[CaseScore]) -> dict[str, dict[str, int]]:
    """Returns, by true effect, how often each name came first, or `none`, `unknown`, `failed`."""
    found: dict[str, dict[str, int]] = {}
    for mark in one:
        # a name that stands for the true one, over classes, is counted as it
        said = mark.truth[0] if mark.first else mark.named[0] if mark.named else mark.verdict
        row = found.setdefault(mark.truth[0], {})
        row[said] = row.get(said, 0) + 1
    return found


def count_outside_answers(outside: Sequence[CaseScore]) -> dict[str, dict[str, int]]:
    """Returns, by what lies outside the library, how often what was said."""
    found: dict[str, dict[str, int]] = {}
    for mark in outside:
        said = "+".join(mark.named) or mark.verdict
        row = found.setdefault(str(mark.outside), {})
        row[said] = row.get(said, 0) + 1
    return found


def compute_detection_curve(
    marks: Sequence[CaseScore], at: Sequence[float], edges: Sequence[float]
) -> list[Figure]:
    """Returns, by size, how often an effect was rightly named and how often nothing was seen."""
    found = []
    for low, high in pairwise(edges):
        inside = [mark for mark, value in zip(marks, at, strict=True) if low <= value < high]
        if inside:
            quiet = [mark.verdict == "none" for mark in inside]
            found.append(
                {
                    "from": low,
                    "to": high,
                    "right": compute_rate([mark.first for mark in inside]),
                    "none": compute_rate(quiet),
                }
            )
    return found


def compute_auroc(marks: Sequence[CaseScore]) -> float | None:
    """Returns how often a case outside the library has a higher probability of `unknown` than another; ties count half."""
    is_outside = np.array([mark.kind == "outside" for mark in marks])
    positive, negative = int(is_outside.sum()), int((~is_outside).sum())
    if not positive or not negative:
        return None
    ranks = rankdata([mark.unknown for mark in marks])
    return float((ranks[is_outside].sum() - positive * (positive + 1) / 2) / (positive * negative))


def collect_claims(marks: Sequence[CaseScore]) -> list[Claim]:
    """Returns all statements with a probability."""
    return [claim for mark in marks for claim in mark.claims]


def compute_reliability(made: Sequence[Claim]) -> list[Figure]:
    """Returns, by bins of the stated probability, its mean and how often such a statement is true."""
    found = []
    for k in range(NUM_BINS):
        inside = [
            claim for claim in made if min(int(claim.probability * NUM_BINS), NUM_BINS - 1) == k
        ]
        if inside:
            found.append(
                {
                    "stated": float(np.mean([claim.probability for claim in inside])),
                    **compute_rate([c.is_true for c in inside]),
                }
            )
    return found


def compute_ece(made: Sequence[Claim]) -> float | None:
    """Returns the expected calibration error: the mean distance of stated and true frequency, over bins, by their statements."""
    if not made:
        return None
    bins = compute_reliability(made)
    return sum(one["of"] * abs(one["stated"] - one["value"]) for one in bins) / len(made)


def compute_closed_of_oracle(marks: Sequence[CaseScore]) -> float | None:
    """Returns the share of the gap closed over what the true effects close, the median of the cases where they close something.

    The median, as the gap itself is a difference of two errors: where it is small, shares of it are
    wild.
    """
    return _take_median(
        [
            (mark.closed or 0.0) / mark.oracle
            for mark in marks
            if mark.oracle is not None and mark.oracle > MIN_ORACLE_CLOSED
        ]
    )


def compute_prediction_error(marks: Sequence[CaseScore]) -> float | None:
    """Returns the median distance of predicted and achieved closing."""
    return _take_median(
        [
            abs(m.predicted - m.closed)
            for m in marks
            if m.predicted is not None and m.closed is not None
        ]
    )


def _take_median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None
