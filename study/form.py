"""NASA-TLX as it is filled in: every answer is written down when it is given, so that half a questionnaire is half of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from study import study_folder as folders
from study import tlx

NUM_RATINGS, NUM_PAIRS = len(tlx.SCALES), len(tlx.PAIRS)
LAST = NUM_RATINGS + NUM_PAIRS
"""Number of the screen that lists the open questions: after the scales and the pairs."""


class Form:
    """A questionnaire under way; one that was begun before goes on.

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
        path = folder / folders.QUESTIONNAIRES / f"{who}_{period}.json"
        if not path.exists():
            shown = [list(pair) for pair in tlx.list_pairs(np.random.default_rng(seed))]
            begun = {"ratings": {}, "pairs": [], "shown_pairs": shown, "finished": False}
            folders.write_questionnaire(folder, who, period, begun | facts)
        entry = json.loads(path.read_text())
        self._path = path
        self._ratings: dict[str, int] = dict(entry.get("ratings") or {})
        self._shown: list[list[str]] = entry.get("shown_pairs") or list(map(list, tlx.PAIRS))
        self._chosen = {}
        for answer in entry.get("pairs") or []:
            self._chosen[frozenset(answer["pair"])] = answer["chosen"]
        self.finished = bool(entry.get("finished"))
        self._at = min([*self._missing(), LAST])

    def take(self, said: dict[str, Any]) -> str:
        """Take an answer, or a step to another screen; returns why not, where it makes no sense."""
        do, at = said.get("do"), said.get("to")
        if do == "rate" and self._fits(said):
            self._ratings[said["scale"]] = said["value"]
        elif (
            do == "pair"
            and said.get("pair") in range(NUM_PAIRS)
            and said.get("chosen") in self._shown[said["pair"]]
        ):
            self._chosen[frozenset(self._shown[said["pair"]])] = said["chosen"]
            self._at = NUM_RATINGS + said["pair"] + 1
        elif do == "to" and isinstance(at, int) and 0 <= at <= LAST:
            self._at = at
        elif do == "finish" and self._at == LAST:
            self.finished = True
        else:
            return "malformed"
        if do != "to":
            self._write()
        return ""

    def view(self) -> dict[str, Any]:
        """Return the questionnaire as plain data for the pages."""
        chosen = [self._chosen.get(frozenset(pair)) for pair in self._shown]
        return {
            "at": self._at, "last": LAST, "scales": list(tlx.SCALES), "step": tlx.STEP, "ratings": self._ratings,
            "pairs": self._shown, "chosen": chosen, "missing": self._missing(),
        }  # fmt: skip

    def _fits(self, said: dict[str, Any]) -> bool:
        value = said.get("value")
        return (
            said.get("scale") in tlx.SCALES
            and type(value) is int
            and 0 <= value <= 100
            and value % tlx.STEP == 0
        )

    def _missing(self) -> list[int]:
        """Return the screens that have no answer."""
        scales = []
        for index, scale in enumerate(tlx.SCALES):
            if self._ratings.get(scale) is None:
                scales.append(index)
        pairs = []
        for index, pair in enumerate(self._shown):
            if frozenset(pair) not in self._chosen:
                pairs.append(NUM_RATINGS + index)
        return scales + pairs

    def _write(self) -> None:
        answers = []
        for pair in self._shown:
            if frozenset(pair) in self._chosen:
                answers.append({"pair": pair, "chosen": self._chosen[frozenset(pair)]})
        folders.rewrite(
            self._path, {"ratings": self._ratings, "pairs": answers, "finished": self.finished}
        )
