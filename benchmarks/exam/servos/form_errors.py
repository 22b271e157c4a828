"""Model-form errors of effects on position servos, from the published answers to the two opened exams.

`python benchmarks/exam/servos/form_errors.py`, in the project's root, prints `form_of_effect` of
`conf/certainty/servo.yaml`, and what intervals would cover whose widths come from the other exam.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from score_answers import read_published

from brokk_rl.extensions import load_option
from diagnosis.effect_library import load_effects
from diagnosis.request import ProbabilityModel
from exam.calibration import PenaltyFit, WeighedCase, find_effect_forms

HERE = Path(__file__).parent
STATED = {
    "first": {"timing": 0.22, "actuation": 0.22, "sensing": 0.27},
    "second": {"timing": 0.12, "actuation": 0.12, "sensing": 0.18},
}
"""Errors with which the answers to each exam were given: `conf/certainty/servo.yaml` at 43221e5 and dfc3043."""


def read_cases(name: str) -> list[WeighedCase]:
    """Return labels and answers of an exam; what was weighed is not published."""
    folder = HERE / name
    labels = json.loads((folder / "labels.json").read_text())["cases"]
    rows = map(json.loads, (folder / "answers_diagnosis.jsonl").read_text().splitlines())
    said = {row["case"]: read_published(row) for row in rows}
    return [WeighedCase(label, {}, said[label["case"]]) for label in labels]


def main() -> None:
    """Print the errors by effect and how well they carry from one exam to the other."""
    machine, mix = load_option("machine", "so101"), load_option("exam_mix", "servos")
    shared = [name for name, one in mix.troubles.items() if one.joints == "all"]
    fit = PenaltyFit(machine, load_effects(machine), mix.classes, shared, 0, 0, 1)
    weights: ProbabilityModel = load_option("certainty", "servo")
    errors, pooled = {}, {}
    for name, stated in STATED.items():
        stating = replace(weights, form={**weights.form, **stated}, form_of_effect={})
        errors[name] = fit.collect_size_errors(read_cases(name), stating)
        for effect, sizes in errors[name].items():
            pooled[effect] = [*pooled.get(effect, []), *sizes]
    for one, other in (("first", "second"), ("second", "first")):
        forms, covered = find_effect_forms(errors[one]), []
        for effect, sizes in errors[other].items():
            if effect in forms:
                covered += [size.is_covered(forms[effect]) for size in sizes]
        share = f"{np.mean(covered):.2f} of {len(covered)}"
        print(f"widths of the {one} exam cover {share} sizes of the {other}")
    print("form_of_effect:", find_effect_forms(pooled))


if __name__ == "__main__":
    main()
