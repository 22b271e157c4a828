"""Share of the gap that a rival closes in its own simulator, with everything it fitted.

    python benchmarks/exam/rivals/own_gap.py <sitting> <exam> <scored> <out.json> <rival>=<answers> ...

`<scored>` is the work folder of `table.py`, with the machine and what was examined.

Free runs of 5 s over the withheld recordings, as the exam's examiner has them: before is the rival's
simulator as fitted to the reference, after as fitted to the field, floor the first against the same
machine without the cause. No name of an effect counts here. `paired` has the cases with a gap that all rivals answered, beside
the diagnosis's closing by its named effects. Runs in the rivals' environment.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
from case_data import Arm, Windows, read_arm, read_windows
from sittings import describe_command

STRIDE_S = 2.5
MIN_GAP_RATIO = 1.05
"""As in `exam.examiner`: distance of windows, and error over floor from which there is a gap."""


def measure_error(paths: np.ndarray, windows: Windows) -> float:
    """Return the root mean square error over all joints, rad."""
    return float(np.sqrt(np.square(paths - windows.q[:, 1:]).mean()))


def close_gap(rival: str, exam: Path, case: str, answer: Path, arm: Arm) -> dict[str, float | None]:
    """Return before, after, floor and closed share of one case."""
    module = importlib.import_module(rival)
    fitted = json.loads((answer / "fitted.json").read_text())
    withheld = read_windows(exam / "withheld" / case, arm, STRIDE_S)
    unchanged = read_windows(exam / "withheld" / case / "unchanged", arm, STRIDE_S)
    before, after = (
        measure_error(paths, withheld) for paths in module.simulate_halves(arm, withheld, fitted)
    )
    floor = measure_error(module.simulate_halves(arm, unchanged, fitted)[0], unchanged)
    closed = None
    if before >= MIN_GAP_RATIO * floor:
        gap = max(before - floor, (1.0 - 1.0 / MIN_GAP_RATIO) * before)
        closed = (before - after) / gap
    return {"before": before, "after": after, "floor": floor, "closed": closed}


def main(sitting: str, exam: Path, scored: Path, out: Path, rivals: dict[str, Path]) -> None:
    """Write the shares of all cases with one or several effects."""
    arm, found = read_arm(scored / "machine.yaml"), {}
    for label in json.loads((exam / "labels.sealed.json").read_text())["cases"]:
        for rival, answers in rivals.items():
            place = answers / label["case"]
            if label["kind"] in ("one", "several") and (place / "fitted.json").is_file():
                found.setdefault(rival, {})[label["case"]] = close_gap(
                    rival, exam, label["case"], place, arm
                )
    ours = json.loads((scored / "examined.json").read_text())["diagnosis"]
    shares = {name: {case: one["closed"] for case, one in x.items()} for name, x in found.items()}
    shares["diagnosis"] = {case: one["closed"] for case, one in ours.items()}
    paired = []
    for case in ours:
        if all(one.get(case) is not None for one in shares.values()):
            paired.append(case)
    result = {
        "command": describe_command(sitting),
        "paired": {
            case: {name: one[case] for name, one in shares.items()} for case in sorted(paired)
        },
        "median": {
            name: float(np.median([one[case] for case in paired])) if paired else None
            for name, one in shares.items()
        },
        "of": len(paired),
        "cases": found,
    }
    out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(
        sys.argv[1],
        *map(Path, sys.argv[2:5]),
        {name: Path(folder) for name, _, folder in (one.partition("=") for one in sys.argv[5:])},
    )
