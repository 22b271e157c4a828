"""NASA-TLX: six scales of workload, raw and weighted.

Each scale goes from 0 to 100 in steps of 5; that of performance from good (0) to poor (100), so
that more is more load on all six. The raw score is their mean; the weighted one weighs each by how
often it was chosen in the 15 pairs (Hart and Staveland 1988; Hart 2006). An answer that is missing
makes the score missing: a mean over the rest would be another questionnaire.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from brokk_rl.errors import list_choices

SCALES = {
    "mental": "Mental demand",
    "physical": "Physical demand",
    "temporal": "Temporal demand",
    "performance": "Performance (0 good, 100 poor)",
    "effort": "Effort",
    "frustration": "Frustration",
}
STEP = 5
PAIRS = tuple(combinations(SCALES, 2))


def list_pairs(generator: np.random.Generator) -> list[tuple[str, str]]:
    """Return the 15 pairs in random order, each in random order, as they are to be shown."""
    # Pairs in random order, and each pair in random order, against habits of the finger.
    shuffled = [PAIRS[index] for index in generator.permutation(len(PAIRS))]
    return [pair if generator.integers(2) else pair[::-1] for pair in shuffled]


def check(answers: Mapping) -> list[str]:
    """Return the faults and gaps of a questionnaire, in words; empty where it is whole."""
    found = []
    ratings, chosen = answers.get("ratings") or {}, answers.get("pairs") or []
    lacking = []
    for name in SCALES:
        if ratings.get(name) is None:
            lacking.append(name)
    if lacking:
        found.append(f"{', '.join(lacking)} not answered: no raw score")
    for scale, value in ratings.items():
        if scale not in SCALES:
            found.append(f"unknown scale '{scale}'; {list_choices(scale, SCALES)}")
        elif value is not None and not (isinstance(value, (int, float)) and 0 <= value <= 100):
            found.append(f"{scale} is {value!r}, expected 0 to 100: not counted")
    if chosen and _count_weights(chosen) is None:
        found.append(f"{len(chosen)} of 15 pairs answered as they should be: no weighted score")
    return found


def read_ratings(answers: Mapping) -> dict[str, float]:
    """Return the rating of each scale, NaN where there is none that makes sense."""
    given = answers.get("ratings") or {}
    values = {scale: given.get(scale) for scale in SCALES}
    # NaN and not 0: a missing rating is no light workload.
    ratings = dict.fromkeys(SCALES, math.nan)
    for scale, value in values.items():
        if isinstance(value, (int, float)) and 0 <= value <= 100:
            ratings[scale] = float(value)
    return ratings


def compute_raw_tlx(answers: Mapping) -> float:
    """Return the mean of the six scales, NaN where one is missing."""
    return float(np.mean(list(read_ratings(answers).values())))


def compute_weighted_tlx(answers: Mapping) -> float:
    """Return the sum of ratings times weights over 15, NaN where a pair, or a scale that was ever chosen, is missing."""
    weights = _count_weights(answers.get("pairs") or [])
    if weights is None:
        return math.nan
    given = read_ratings(answers)
    return sum(weights[scale] * given[scale] for scale in SCALES if weights[scale]) / len(PAIRS)


def _count_weights(chosen: Sequence[Mapping]) -> dict[str, int] | None:
    """Return how often each scale was chosen; `None` unless each of the 15 pairs was answered once.

    Each answer is `{"pair": [a, b], "chosen": a}`.
    """
    seen: dict[frozenset, str] = {}
    for answer in chosen:
        pair = frozenset(answer.get("pair", ()))
        if answer.get("chosen") not in pair or pair in seen:
            return None
        seen[pair] = answer["chosen"]
    if set(seen) != {frozenset(pair) for pair in PAIRS}:
        return None
    return {scale: list(seen.values()).count(scale) for scale in SCALES}
