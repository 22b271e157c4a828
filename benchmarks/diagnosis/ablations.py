"""Ablations of the diagnosis: cases with known causes, answered with one ingredient switched off.

    python benchmarks/diagnosis/ablations.py <out.json> <exam> [<exam> …] --workers 32
    python benchmarks/diagnosis/ablations.py <out.json> <exam> --without whitening ageing

An exam is a folder that `brokk mode=exam` made, with its labels; names count strictly. What is switched
off, and how, stands in `ingredients.yaml`, with other values of the constants of the decision. These are
tried on one evidence, without the gates of the proof. What decides alike is one row. Called again,
the answers in `<out.json>` are kept.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
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
from diagnosis.engine import decide
from diagnosis.reference_diagnosis import ReferenceDiagnosis
from exam.dataset import open_labels

INGREDIENTS = yaml.safe_load(Path(__file__).with_name("ingredients.yaml").read_text())
NO_PROOF = "gates of the proof, and the decision alone"
"""The ingredient without which the other values of its constants are tried."""
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "no ageing": lambda model, numbers: np.zeros(len(model.fitted)),
    "no price of columns": lambda causes, joint: defaultdict(float),
}


class ManyDecisions(decide.Decider):
    """A decider that is asked with each value of each constant of the decision."""

    def decide(self) -> decide.Decision:
        """Raise `LookupError` with a decision for each."""
        found = {NO_PROOF: super().decide()}
        for name, values in INGREDIENTS[NO_PROOF].items():
            for value in values:
                with patch(f"diagnosis.{name}", value):
                    found[f"{name.split('.')[-1]} {value:g}"] = super().decide()
        raise LookupError(found)

    def weigh(self, there: Sequence[decide.EffectFinding]) -> decide.EvidenceTable:
        """Return what everything earns beside effects, which only the cost of a joint changes."""
        known = self.__dict__.setdefault("known", {})
        key = (decide.JOINT_NATS, *((one.effect, one.joints) for one in there))
        known[key] = known.get(key) or super().weigh(there)
        return known[key]


def prepare(case: str, machine_name: str) -> ReferenceDiagnosis:
    """Return the diagnosis of a case."""
    torch.set_num_threads(1)
    machine = extensions.load_option("machine", machine_name)
    given, kinds = load_case(Path(case), machine), load_effects(machine, None, None)
    return ReferenceDiagnosis(given, kinds, np.random.default_rng(0))


def decide_often(case: str, machine_name: str) -> dict[str, list[Any]]:
    """Return the answers about a case without proof, with each value of each constant of the decision."""
    work, begun = prepare(case, machine_name), time.process_time()
    with patch("diagnosis.reference_diagnosis.Decider", ManyDecisions):
        try:
            work.search((), lambda name, done: None)
        except LookupError as told:
            answers = {}
            for name, one in told.args[0].items():
                names = [shown.kind.name for shown in work.detected]
                names += [work.name(finding) for finding in one.named]
                verdict = "effects" if names else one.verdict
                answers[name] = [verdict, names, time.process_time() - begun]
            return answers
    raise AssertionError("a decider raises its decisions")


def answer(case: str, machine_name: str, ingredient: str) -> dict[str, list[Any]]:
    """Return the verdict about a case without an ingredient, the names, and the seconds that it took."""
    if ingredient == NO_PROOF:
        return decide_often(case, machine_name)
    work, begun = prepare(case, machine_name), time.process_time()
    with ExitStack() as stack:
        for target, value in INGREDIENTS[ingredient].items():
            if target.endswith("()"):
                value = FUNCTIONS.get(str(value), lambda *_, value=value: value)
            stack.enter_context(patch(f"diagnosis.{target.removesuffix('()')}", value))
        try:
            found = work.run(lambda name, done: None).answer
        except Exception as error:  # without its ingredient the engine may break in any way
            return {ingredient: ["failed", [repr(error)], time.process_time() - begun]}
    named = sorted(found.selected, key=lambda one: -one.probability)
    names = [one.effect for one in named]
    return {ingredient: [found.verdict, names, time.process_time() - begun]}


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
    row = {name: f"{sum(some)}/{len(some)}" for name, some in sorted(right.items())}
    return row | {"CPU s": round(np.mean([one[2] for one in answers.values()]))}


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
    jobs: dict[Future[dict[str, list[Any]]], str] = {}
    with ProcessPoolExecutor(given.workers) as pool:
        for name, case in product(given.without, labels):
            if case not in answers.get(name, {}):
                jobs[pool.submit(answer, case, given.machine, name)] = case
        for job in track(as_completed(jobs), total=len(jobs)):
            for name, one in job.result().items():
                answers.setdefault(name, {})[jobs[job]] = one
            alike = defaultdict(list)
            for name, some in answers.items():
                alike[json.dumps(count(labels, some))].append(name)
            rows = [{"without": ", ".join(names)} | json.loads(row) for row, names in alike.items()]
            given.out.write_text(json.dumps({"rows": rows, "answers": answers}, indent=1) + "\n")


if __name__ == "__main__":
    main()
