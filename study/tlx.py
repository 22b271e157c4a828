"""NASA-TLX: six scales of workload, their mean, and the questionnaire as it is filled in.

Each scale goes from 0 to 100 in steps of 5; that of performance from good (0) to poor (100), so
that more is more load on all six. The score is the raw one, their mean (Hart and Staveland 1988;
Hart 2006). An answer that is missing makes it missing: a mean over the rest would be another
questionnaire.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
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
SCORES = SCALES | {"raw": "mean of the six scales"}
STEP = 5


def compute_scores(answers: Mapping) -> tuple[dict[str, float], list[str]]:
    """Return the scales and the raw score, NaN where an answer is missing or makes no sense, and the faults in words."""
    scores, faults = dict.fromkeys(SCALES, math.nan), []
    for scale in SCALES:
        value = (answers.get("ratings") or {}).get(scale)
        if value is None:
            faults.append(f"{scale} not answered: no mean")
        elif isinstance(value, (int, float)) and 0 <= value <= 100:
            scores[scale] = float(value)
        else:
            faults.append(f"{scale} is {value!r}, expected 0 to 100: no mean")
    return scores | {"raw": float(np.mean(list(scores.values())))}, faults


class Form:
    """A questionnaire under way: every answer is on the disk at once, and one that was begun goes on.

    Args:
        folder: The study's.
        who: Participant.
        period: After which.
    """

    def __init__(self, folder: Path, who: str, period: int) -> None:
        self._path = folder / folders.QUESTIONNAIRES / f"{who}_{period}.json"
        begun = {"participant": who, "period": period, "ratings": {}, "finished": False}
        if not self._path.exists():
            folders.update_record(self._path, begun)
        self._entry: dict[str, Any] = begun | json.loads(self._path.read_text())
        self._at = min([*self._list_missing(), len(SCALES)])

    @property
    def finished(self) -> bool:
        """True once the participant has said so."""
        return bool(self._entry["finished"])

    def take(self, said: dict[str, Any]) -> str:
        """Take an answer, or a step to another screen; returns why not, where it makes no sense."""
        do, at, value = said.get("do"), said.get("to"), said.get("value")
        is_rating = type(value) is int and 0 <= value <= 100 and value % STEP == 0
        if do == "rate" and said.get("scale") in SCALES and is_rating:
            self._entry["ratings"][said["scale"]] = value
        elif do == "to" and isinstance(at, int) and 0 <= at <= len(SCALES):
            self._at = at
        elif do == "finish" and self._at == len(SCALES):
            self._entry["finished"] = True
        else:
            return "malformed"
        folders.update_record(self._path, self._entry)
        return ""

    def view(self) -> dict[str, Any]:
        """Return the questionnaire as plain data for the pages; the last screen lists what is open."""
        ratings, missing = self._entry["ratings"], self._list_missing()
        place = {"at": self._at, "scales": list(SCALES), "step": STEP}
        return place | {"ratings": ratings, "missing": missing}

    def _list_missing(self) -> list[int]:
        """Return the screens that have no answer."""
        ratings = self._entry["ratings"]
        return [screen for screen, scale in enumerate(SCALES) if ratings.get(scale) is None]
