"""Marks of the published answers to an exam of position servos, without the examiner's runs on withheld recordings.

`python benchmarks/exam/servos/score_answers.py <folder>`, in the project's root, reads `labels.json` and
`answers_diagnosis.jsonl` in the folder and writes `marks.json` there.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from brokk_rl.extensions import load_option
from brokk_rl.session import write_json
from diagnosis import answer
from exam import score
from exam.metrics import compute_metrics

NEEDS_EXAMINER = ("closed_examined", "closed_differs", "seconds")
"""Rates that rest on runs on withheld recordings, or on times, which are not read here."""


def read_published(row: Mapping[str, Any]) -> answer.Answer | None:
    """Return the answer in a line of `answers_diagnosis.jsonl`, `None` where there is none."""
    if row["answer"] is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / answer.ANSWER_FILE
        path.write_text(json.dumps(row["answer"]))
        return answer.read_answer(path)


def main(folder: Path) -> None:
    """Write `marks.json`."""
    labels = json.loads((folder / "labels.json").read_text())
    rows = map(json.loads, (folder / "answers_diagnosis.jsonl").read_text().splitlines())
    said = {row["case"]: row for row in rows}
    mix = load_option("exam_mix", "servos")
    shared = [name for name, one in mix.troubles.items() if one.joints == "all"]
    marks = []
    for label in labels["cases"]:
        found = read_published(said[label["case"]])
        marks.append(score.score_answer(label, found, mix.classes, shared))
    metrics = {k: v for k, v in compute_metrics(marks).items() if k not in NEEDS_EXAMINER}
    facts = {"engine": said["0000"]["note"]["engine"], "seed": labels["seed"]}
    write_json(folder / "marks.json", {**facts, "candidates": {"diagnosis": metrics}})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
