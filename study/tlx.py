"""NASA-TLX: six scales of workload, raw and weighted, and the questionnaire as it is filled in.

Each scale goes from 0 to 100 in steps of 5; that of performance from good (0) to poor (100), so
that more is more load on all six. The raw score is their mean; the weighted one weighs each by how
often it was chosen in the 15 pairs (Hart and Staveland 1988; Hart 2006). An answer that is missing
makes the score missing: a mean over the rest would be another questionnaire.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from study import study_folder as folders

SCALES = {
    "mental": "Mental demand",
    "physical": "Physical demand",
    "temporal": "Temporal demand",
    "performance": "Performance (0 good, 100 poor)",
    "effort": "Effort",
    "frustration": "Frustration",
}
SCORES = SCALES | {"raw": "raw", "weighted": "weighted"}
STEP = 5
PAIRS = tuple(combinations(SCALES, 2))
LAST = len(SCALES) + len(PAIRS)
"""Number of the screen that lists the open questions: after the scales and the pairs."""


def shuffle_pairs(generator: np.random.Generator) -> list[list[str]]:
    """Return the 15 pairs in random order, each in random order, against habits of the finger."""
    shuffled = [list(PAIRS[index]) for index in generator.permutation(len(PAIRS))]
    return [pair if generator.integers(2) else pair[::-1] for pair in shuffled]


def compute_scores(answers: Mapping) -> tuple[dict[str, float], list[str]]:
    """Return the scales, the raw and the weighted score, and the faults and gaps in words.

    NaN stands where an answer is missing or makes no sense.
    """
    given = answers.get("ratings") or {}
    scores = dict.fromkeys(SCALES, math.nan)
    lacking, faults = [], []
    for scale in SCALES:
        value = given.get(scale)
        if value is None:
            lacking.append(scale)
        elif isinstance(value, (int, float)) and 0 <= value <= 100:
            scores[scale] = float(value)
        else:
            faults.append(f"{scale} is {value!r}, expected 0 to 100: not counted")
    if lacking:
        faults.insert(0, f"{', '.join(lacking)} not answered: no raw score")
    chosen = answers.get("pairs") or []
    weights = _count_weights(chosen)
    if chosen and weights is None:
        faults.append(f"{len(chosen)} of 15 pairs answered as they should be: no weighted score")
    raw, weighted = float(np.mean(list(scores.values()))), math.nan
    if weights is not None:
        # A scale that was never chosen may be missing.
        weighted = sum(weights[scale] * scores[scale] for scale in SCALES if weights[scale])
    return scores | {"raw": raw, "weighted": weighted / len(PAIRS)}, faults


def _count_weights(chosen: list[Mapping]) -> dict[str, int] | None:
    """Return how often each scale was chosen; `None` unless each of the 15 pairs was answered once.

    Each answer is `{"pair": [a, b], "chosen": a}`.
    """
    pairs = [frozenset(answer.get("pair", ())) for answer in chosen]
    names = [answer.get("chosen") for answer in chosen]
    is_whole = set(pairs) == set(map(frozenset, PAIRS)) and len(pairs) == len(PAIRS)
    if not is_whole or any(name not in pair for name, pair in zip(names, pairs, strict=True)):
        return None
    return {scale: names.count(scale) for scale in SCALES}


class Form:
    """A questionnaire under way: every answer is on the disk at once, and one that was begun goes on.

    Args:
        folder: The study's.
        who: Participant.
        period: After which.
        seed: Of the order of pairs.
        facts: Further fields of its file.
    """

    def __init__(
        self, folder: Path, who: str, period: int, seed: int, facts: dict[str, Any]
    ) -> None:
        self._path = folder / folders.QUESTIONNAIRES / f"{who}_{period}.json"
        shown = shuffle_pairs(np.random.default_rng(seed))
        begun = {"ratings": {}, "pairs": [], "shown_pairs": shown, "finished": False}
        if not self._path.exists():
            folders.write_questionnaire(folder, who, period, begun | facts)
        self._entry: dict[str, Any] = begun | json.loads(self._path.read_text())
        self._at = min([*self._list_missing(), LAST])

    @property
    def finished(self) -> bool:
        """True once the participant has said so."""
        return bool(self._entry["finished"])

    def take(self, said: dict[str, Any]) -> str:
        """Take an answer, or a step to another screen; returns why not, where it makes no sense."""
        do, at, pair = said.get("do"), said.get("to"), said.get("pair")
        if do == "rate" and said.get("scale") in SCALES and _is_rating(said.get("value")):
            self._entry["ratings"][said["scale"]] = said["value"]
        elif do == "pair" and pair in range(len(PAIRS)) and said.get("chosen") in self._shown[pair]:
            shown = self._shown[pair]
            others = [answer for answer in self._entry["pairs"] if answer["pair"] != shown]
            self._entry["pairs"] = [*others, {"pair": shown, "chosen": said["chosen"]}]
            self._at = len(SCALES) + pair + 1
        elif do == "to" and isinstance(at, int) and 0 <= at <= LAST:
            self._at = at
            return ""
        elif do == "finish" and self._at == LAST:
            self._entry["finished"] = True
        else:
            return "malformed"
        folders.rewrite(self._path, self._entry)
        return ""

    def view(self) -> dict[str, Any]:
        """Return the questionnaire as plain data for the pages."""
        return {
            "at": self._at,
            "last": LAST,
            "scales": list(SCALES),
            "step": STEP,
            "ratings": self._entry["ratings"],
            "pairs": self._shown,
            "chosen": [self._get_chosen(pair) for pair in self._shown],
            "missing": self._list_missing(),
        }

    @property
    def _shown(self) -> list[list[str]]:
        return self._entry["shown_pairs"]

    def _get_chosen(self, pair: list[str]) -> str | None:
        for answer in self._entry["pairs"]:
            if answer["pair"] == pair:
                return answer["chosen"]
        return None

    def _list_missing(self) -> list[int]:
        """Return the screens that have no answer."""
        answers = [self._entry["ratings"].get(scale) for scale in SCALES]
        answers += [self._get_chosen(pair) for pair in self._shown]
        return [screen for screen, answer in enumerate(answers) if answer is None]


def _is_rating(value: Any) -> bool:
    return type(value) is int and 0 <= value <= 100 and value % STEP == 0
