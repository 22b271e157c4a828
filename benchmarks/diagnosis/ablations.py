"""Ablations of the diagnosis: cases with known causes, answered with one ingredient switched off.

    python benchmarks/diagnosis/ablations.py <out.json> <exam> [<exam> …] --workers 32
    python benchmarks/diagnosis/ablations.py <out.json> <exam> --without scatter ageing

An exam is a folder that `brokk mode=exam` made, with its labels; names count strictly. What is switched
off, and how, stands in `ingredients.yaml`. Called again, the answers in `<out.json>` are kept.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import yaml
from rich.progress import track

from brokk_rl import extensions
from diagnosis.case import load_case
from diagnosis.effect_library import load_effects
from diagnosis.reference_diagnosis import ReferenceDiagnosis
from exam.dataset import open_labels

INGREDIENTS = yaml.safe_load(Path(__file__).with_name("ingredients.yaml").read_text())
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "no ageing": lambda model, numbers: np.zeros(len(model.fitted)),
    "no price": lambda table, _, name: np.full((1, (table.names == name).sum()), -np.inf),
    "one motion": lambda side, flow: np.zeros(side.num_samples, dtype=int),
}


def answer(case: str, machine_name: str, ingredient: str) -> list[Any]:
    """Return the verdict about a case without an ingredient, the names, and the seconds that it took."""
    torch.set_num_threads(1)
    machine, begun = extensions.load_option("machine", machine_name), time.process_time()
    thresholds = extensions.load_part("thresholds")
    given, kinds = load_case(Path(case), machine), load_effects(machine, None, None)
    work = ReferenceDiagnosis(given, kinds, thresholds, np.random.default_rng(0))
    with ExitStack() as stack:
        for target, value in INGREDIENTS[ingredient].items():
            if target.endswith("()"):
                value = FUNCTIONS.get(str(value), lambda *_, value=value: value)
            stack.enter_context(patch(f"diagnosis.{target.removesuffix('()')}", value))
        try:
            found = work.run(lambda name, done: None).answer
        except Exception as error:  # without its ingredient the engine may break in any way
            return [f"failed: {error!r}", [], time.process_time() - begun]
    named = sorted(found.selected, key=lambda one: -one.probability)
    return [found.verdict, [one.effect for one in named], time.process_time() - begun]


def count(labels: Mapping[str, dict[str, Any]], answers: Mapping[str, list[Any]]) -> dict[str, Any]:
    """Return the row of an ingredient."""
    right: dict[str, list[bool]] = defaultdict(list)
    for case, (verdict, names, _) in answers.items():
        label = labels[case]
        truth = [one["effect"] for one in label["effects"]]
        if label["outside"]:
            right["unknown said"].append(verdict == "unknown")
        elif not truth:
            right["unchanged accused"].append(bool(names))
            right["unchanged called unknown"].append(verdict == "unknown")
        elif label.get("kind") == "faint":
            right["faint: a false name"].append(not set(names) <= set(truth))
        elif len(truth) == 1:
            right["one: named first"].append(names[:1] == truth)
            right["one: it alone"].append(names == truth)
        else:
            right["several: exact"].append(sorted(names) == sorted(truth))
    row = {name: f"{sum(some)} of {len(some)}" for name, some in sorted(right.items())}
    failed = sum(one[0].startswith("failed") for one in answers.values())
    return row | {"failed": failed, "CPU s": round(np.mean([one[2] for one in answers.values()]))}


def main() -> None:
    """Answer all cases without each ingredient, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("exams", type=Path, nargs="+")
    parser.add_argument("--machine", default="brokk170")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--without", nargs="+", default=[*INGREDIENTS], choices=[*INGREDIENTS])
    given = parser.parse_args()
    labels = {}
    for exam in given.exams:
        for label in open_labels(exam)[0]["cases"]:
            labels[str(exam / "cases" / label["case"])] = label
    answers = json.loads(given.out.read_text())["answers"] if given.out.is_file() else {}
    jobs: dict[Future[list[Any]], tuple[str, str]] = {}
    with ProcessPoolExecutor(given.workers) as pool:
        for name, case in product(given.without, labels):
            if case not in answers.get(name, {}):
                jobs[pool.submit(answer, case, given.machine, name)] = name, case
        for job in track(as_completed(jobs), total=len(jobs)):
            name, case = jobs[job]
            answers.setdefault(name, {})[case] = job.result()
            rows = [{"without": one} | count(labels, answers[one]) for one in answers]
            given.out.write_text(json.dumps({"rows": rows, "answers": answers}, indent=1) + "\n")


if __name__ == "__main__":
    main()
