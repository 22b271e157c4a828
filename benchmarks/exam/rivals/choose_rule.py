"""Choose the naming rule of a rival on a development exam, whose labels may be opened.

    python benchmarks/exam/rivals/choose_rule.py <exam> <answers> <rival>

The spread of a number is the 68 % quantile of its change, over its stated error, over joints that nothing was done to: all of
cases without a visible gap, and in the others those joints that no effect of actuation is on. The
threshold has the largest F1 of names among those that raise no false alarm in quiet cases.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from case_data import Change, read_changes
from naming import SAME_AS, select_effects
from sit import RULES_FILE

THRESHOLDS = np.arange(1.0, 15.1, 0.5)
CLASSES = [{"dead_time", "clock_offset"}, {"flow_gain", "encoder_scale"}]
"""Effects that commands and positions cannot tell apart, as the exam counts them."""
QUIET = ("none", "faint")


def read_answers(exam: Path, answers: Path) -> Iterator[tuple[dict[str, Any], list[Change]]]:
    """Yield label and changes of each answered case."""
    for label in json.loads((exam / "labels.sealed.json").read_text())["cases"]:
        place = answers / label["case"] / "changes.json"
        if place.is_file():
            yield label, read_changes(place)


def measure_spreads(cases: list[tuple[dict[str, Any], list[Change]]]) -> dict[str, float]:
    """Return the spread of each number over joints that nothing was done to."""
    found: dict[str, list[float]] = defaultdict(list)
    for label, changes in cases:
        touched = set()
        if label["kind"] not in QUIET:
            for effect in [*label["effects"], *filter(None, [label["outside"]])]:
                touched.update(effect["joints"])
            touched.add("machine")
        for change in changes:
            if change.joint not in touched:
                found[f"{change.effect}.{change.parameter}"].append(
                    abs(change.change) / change.error
                )
    spreads = {}
    for name, values in found.items():
        # a number in whole steps mostly stays: then half of its smallest move
        moved = [value for value in values if value > 0.0]
        spreads[name] = float(np.quantile(values, 0.68)) or 0.5 * min(moved, default=2.0)
    return spreads


def count_names(truth: set[str], named: list[str]) -> tuple[int, int, int]:
    """Return true names, false names and missed effects, as the exam's score matches them."""
    left = set(truth)
    right = 0
    for name in named:
        stands = [group for group in [*CLASSES, {name, *SAME_AS.get(name, [])}] if name in group]
        match = next((one for one in left if one == name or any(one in g for g in stands)), None)
        if match is not None:
            left.discard(match)
            right += 1
    return right, len(named) - right, len(left)


def main(exam: Path, answers: Path, rival: str) -> None:
    """Write spreads and threshold of the rival into the file of rules."""
    cases = list(read_answers(exam, answers))
    if not cases:
        raise SystemExit(f"{answers}: expected answers to {exam} with changes.json, found none")
    spreads = measure_spreads(cases)
    table = []
    for threshold in THRESHOLDS:
        total, alarms, quiet = np.zeros(3), 0, 0
        for label, changes in cases:
            named = list(select_effects(changes, spreads, float(threshold)))
            is_quiet = label["kind"] in QUIET
            truth = set() if is_quiet else {one["effect"] for one in label["effects"]}
            total += count_names(truth, named)
            quiet += is_quiet
            alarms += is_quiet and bool(named)
        right, wrong, missed = total
        f1 = 2 * right / max(2 * right + wrong + missed, 1)
        table.append((float(threshold), round(float(f1), 3), f"{alarms} of {quiet}"))
        print(*table[-1], total.astype(int).tolist())
    calm = [row for row in table if row[2].startswith("0 ")] or table[-1:]
    best = max(calm, key=lambda row: row[1])
    rules = json.loads(RULES_FILE.read_text()) if RULES_FILE.is_file() else {}
    rules[rival] = {
        "exam_seed": json.loads((exam / "exam.json").read_text())["seed"],
        "cases": len(cases),
        "threshold": best[0],
        "f1": best[1],
        "false_alarms": best[2],
        "spreads": {name: float(f"{value:.4g}") for name, value in spreads.items()},
    }
    RULES_FILE.write_text(json.dumps(rules, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
