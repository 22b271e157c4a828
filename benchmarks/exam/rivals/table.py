"""Table of rivals: their answers to cases of an opened exam beside the published ones of the diagnosis.

    python benchmarks/exam/rivals/table.py <sitting> <exam> <opened> <work> <out.json> <rival>=<answers> ...

What they fitted stands in `changes_<rival>.jsonl` beside it. `<opened>` holds published answers and marks
of the diagnosis, as `exam.do=score` leaves them. Each rival has two rows: names by the rule of `rules.json`, and all fitted numbers
taken as they are. Scores and the closed share are those of `mode=exam`; what was examined already
stays in `<work>`, with the machine as rivals know it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import naming
import numpy as np
import yaml
from case_data import read_changes
from choose_rule import CLASSES, QUIET, THRESHOLDS, count_names
from sit import RULES_FILE
from sittings import SITTINGS, describe_command

from brokk_rl.extensions import load_mode
from brokk_rl.session import write_json, write_text
from diagnosis import effect_library, effects_file
from diagnosis.answer import read_answer
from diagnosis.effect_library import EffectType
from exam import dataset, score
from exam.answer_scoring import AnswerScoring
from exam.generate import restrict_machine
from exam.metrics import compute_rate
from exam.run_cases import MACHINE_FILE, describe_spec

OURS = "diagnosis"
ROWS = (
    "top1",
    "exact_set",
    "set_f1",
    "false_alarms",
    "unknown_recall",
    "joints",
    "parameter_error",
    "closed_examined",
)
"""Metrics of `exam.metrics` that the table has."""


def list_vocabulary(answers: Path, labels: list[dict[str, Any]]) -> set[str]:
    """Return the effects that a rival has a number for, in whatever case it fitted one."""
    known: set[str] = set()
    for label in labels:
        known.update(one.effect for one in read_changes(answers / label["case"] / "changes.json"))
    for group in [*CLASSES, *({name, *same} for name, same in naming.SAME_AS.items())]:
        known |= group if known & group else set()
    return known


def count_expressible(labels: list[dict[str, Any]], vocabulary: set[str]) -> int:
    """Return how many of the true effects are in a vocabulary."""
    truth = [one["effect"] for x in labels if x["kind"] not in QUIET for one in x["effects"]]
    return sum(effect in vocabulary for effect in truth)


def measure_within(
    folder: Path, labels: list[dict[str, Any]], vocabulary: set[str], scoring: AnswerScoring
) -> dict[str, Any]:
    """Return how many effects of a vocabulary are named: first where alone, and at all."""
    firsts, named, there = [], 0, 0
    for label in labels:
        answer = read_answer(folder / label["case"] / "diagnosis.json")
        one = score.score_answer(label, answer, scoring.classes, scoring.of_machine)
        there += sum(effect in vocabulary for effect in one.truth)
        named += sum(effect in vocabulary for effect, _ in one.hits)
        if label["kind"] == "one" and set(one.truth) <= vocabulary:
            firsts.append(one.first)
    return {"top1": compute_rate(firsts), "effects_named": {"value": named, "of": there}}


def unpack_published(
    opened: Path, cases: list[str], work: Path, kinds: Sequence[EffectType]
) -> None:
    """Write the published answers of the diagnosis as the exam left them, and their examinations where there are any."""
    for line in (opened / f"answers_{OURS}.jsonl").read_text().splitlines():
        row = json.loads(line)
        if row["case"] in cases:
            place = work / OURS / row["case"]
            place.mkdir(parents=True, exist_ok=True)
            write_json(place / "diagnosis.json", row["answer"])
            write_json(place / "sitting.json", row["note"])
            path = place / effects_file.EFFECTS_FILE  # for the examiner
            effects_file.write_effects(read_answer(place / "diagnosis.json"), kinds, path)
    published, path = opened / "examined.json", work / "examined.json"
    if published.is_file() and not path.is_file():
        examined = json.loads(published.read_text())[OURS]
        write_json(path, {OURS: {case: one for case, one in examined.items() if case in cases}})


def write_named(answers: Path, cases: list[str], rule: dict[str, Any], out: Path) -> None:
    """Write the answers that a rule makes of the fitted changes."""
    for case in cases:
        place = answers / case
        if not (place / "changes.json").is_file():
            continue
        naming.write_answer(read_changes(place / "changes.json"), rule, out / case)
        if (place / "sitting.json").is_file():
            (out / case / "sitting.json").write_text((place / "sitting.json").read_text())


def publish_changes(answers: Path, labels: list[dict[str, Any]], path: Path) -> None:
    """Write what a rival fitted, a line a case: rows of effect, parameter, joint, value, change, error."""
    lines = []
    for label in labels:
        rows = []
        for one in read_changes(answers / label["case"] / "changes.json"):
            numbers = [float(f"{value:.4g}") for value in (one.value, one.change, one.error)]
            rows.append([one.effect, one.parameter, one.joint, *numbers])
        lines.append(json.dumps({"case": label["case"], "changes": rows}) + "\n")
    path.write_text("".join(lines))


def measure_hindsight(
    answers: Path, labels: list[dict[str, Any]], spreads: dict[str, float]
) -> dict[str, Any]:
    """Return the best F1 of names that any threshold has on these very cases."""
    best: dict[str, Any] = {"f1": 0.0}
    for threshold in THRESHOLDS:
        total, alarms = np.zeros(3), 0
        for label in labels:
            path = answers / label["case"] / "changes.json"
            if not path.is_file():
                continue
            named = list(naming.select_effects(read_changes(path), spreads, float(threshold)))
            is_quiet = label["kind"] in QUIET
            truth = set() if is_quiet else {one["effect"] for one in label["effects"]}
            total += count_names(truth, named)
            alarms += is_quiet and bool(named)
        right, wrong, missed = total
        f1 = float(2 * right / max(2 * right + wrong + missed, 1))
        if f1 > best["f1"]:
            best = {"f1": round(f1, 3), "threshold": float(threshold), "false_alarms": int(alarms)}
    return best


def summarise(
    table: dict[str, Any],
    folder: Path,
    labels: list[dict[str, Any]],
    examined: dict[str, Any],
    scoring: AnswerScoring,
) -> dict[str, Any]:
    """Return the table's row of one candidate."""
    row = {name: table[name] for name in ROWS}
    hits, there, false = 0, 0, 0
    for label in labels:
        answer = read_answer(folder / label["case"] / "diagnosis.json")
        one = score.score_answer(label, answer, scoring.classes, scoring.of_machine)
        hits, there = hits + len(one.hits), there + len(one.truth)
        false += len(one.named) - len(one.hits)
    row["effects_named"] = {"value": hits, "of": there}
    row["names_false"] = {"value": false, "of": len(labels)}
    row["names_f1"] = round(2 * hits / max(there + hits + false, 1), 3)
    closed = [one["closed"] for one in examined.values() if one["closed"] is not None]
    # a repair that makes the error many times larger counts as one that doubles the gap
    row["closed_mean"] = float(np.mean(np.clip(closed, -1.0, 1.0))) if closed else None
    row["cases"], row["failed"] = table["sat"]["value"], table["failed"]
    row["seconds"] = table["seconds"]
    return row


def main(
    sitting: str,
    exam: Path,
    opened: Path,
    work: Path,
    out: Path,
    rivals: dict[str, Path],
    workers: int,
) -> None:
    """Name, examine, score, write."""
    labels = dataset.open_labels(exam)["cases"]
    cases = [label["case"] for label in labels]
    rules = json.loads(RULES_FILE.read_text())
    folders = {OURS: work / OURS}
    for name, answers in rivals.items():
        everything = {**rules[name], "threshold": 0.0}
        for title, rule in ((name, rules[name]), (f"{name} as fitted", everything)):
            folders[title] = work / title.replace(" ", "_")
            write_named(answers, cases, rule, folders[title])
    overrides = ["mode=exam", *SITTINGS[sitting].options, f"session.out={work}"]
    mode = load_mode(*overrides)
    settings = mode.exam
    known = json.loads((exam / "exam.json").read_text())["known"]
    machine = restrict_machine(mode.machine, known)
    unpack_published(opened, cases, work, effect_library.load_effects(machine))
    write_text(work / MACHINE_FILE, yaml.safe_dump(describe_spec(machine), sort_keys=False))
    # those that some rival has not answered are left out for all
    sat = [
        label
        for label in labels
        if all((folder / label["case"] / "diagnosis.json").is_file() for folder in folders.values())
    ]
    scoring = AnswerScoring(
        exam=exam,
        labels=sat,
        machine=machine,
        fit=settings.fit,
        classes=settings.mix.classes,
        of_machine=[n for n, one in settings.mix.troubles.items() if one.joints == "all"],
    )
    # numbers taken as they are repair the rival's own simulator only: `own_gap.py`
    repairs = {name: folder for name, folder in folders.items() if "as fitted" not in name}
    examined = scoring.examine(repairs, work / "examined.json", workers)
    rows, chosen = {}, {label["case"] for label in sat}
    for name, folder in folders.items():
        table = scoring.build_table(folder, examined.get(name, {}))
        shares = {case: one for case, one in examined.get(name, {}).items() if case in chosen}
        rows[name] = summarise(table, folder, sat, shares, scoring)
    kinds: dict[str, int] = {}
    for label in sat:
        kinds[label["kind"]] = kinds.get(label["kind"], 0) + 1
    words = {name: list_vocabulary(answers, sat) for name, answers in rivals.items()}
    result = {
        "command": describe_command(sitting),
        "cases": kinds,
        "candidates": rows,
        "expressible": {name: count_expressible(sat, one) for name, one in words.items()},
        "within": {
            name: {
                "vocabulary": sorted(one),
                **{who: measure_within(folders[who], sat, one, scoring) for who in (name, OURS)},
            }
            for name, one in words.items()
        },
        "hindsight": {
            name: measure_hindsight(answers, sat, rules[name]["spreads"])
            for name, answers in rivals.items()
        },
        "rules": {
            name: {key: rules[name][key] for key in ("threshold", "f1", "cases", "exam_seed")}
            for name in rivals
        },
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "commit": subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
        ).stdout.strip(),
    }
    write_json(out, result)
    for name, answers in rivals.items():
        publish_changes(answers, sat, out.with_name(f"changes_{name}.jsonl"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Table of rivals on one exam.")
    parser.add_argument("sitting", choices=SITTINGS)
    for folder in ("exam", "opened", "work", "out"):
        parser.add_argument(folder, type=Path)
    parser.add_argument("rivals", nargs="+", help="<rival>=<folder of its answers>")
    parser.add_argument("--workers", type=int, default=1)
    given = vars(parser.parse_args())
    pairs = [one.partition("=") for one in given.pop("rivals")]
    main(**given, rivals={name: Path(folder) for name, _, folder in pairs})
