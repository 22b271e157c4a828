"""Make the first cases of an opened exam again, from the salt among its published labels.

    python benchmarks/exam/rivals/remake.py benchmarks/exam/held_out/second 30 runs/rivals/exam [workers]

The folder is an exam as `exam.do=make` leaves it, with fewer cases. Labels must come out as published.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from brokk_rl.extensions import load_mode
from brokk_rl.progress import ItemProgress
from brokk_rl.session import write_json
from exam import dataset
from exam.generate import CaseRecorder, Half, HalfPlan, restrict_machine


def main(opened: Path, num_cases: int, folder: Path, workers: int) -> None:
    """Write `cases/`, `withheld/`, the labels and `exam.json` into `folder`."""
    published = json.loads((opened / "labels.json").read_text())
    overrides = [
        "mode=exam",
        "exam_protocol=sealed",
        f"session.seed={published['seed']}",
        f"exam.salt={published['salt']}",
        f"session.out={folder}",
    ]
    mode = load_mode(*overrides)
    settings = mode.exam
    recorder = CaseRecorder(
        mode.machine,
        settings.plants,
        published["roughness"],
        mode.excitation,
        settings.approach,
        restrict_machine(mode.machine, published["known"]),
    )
    names: tuple[Half, ...] = ("reference", "field", "withheld")
    halves: dict[Half, HalfPlan] = {name: getattr(settings, name) for name in names}
    questions = mode.questions(published["salt"])[:num_cases]
    cases = dataset.CaseSet(recorder, questions, halves, mode.machine, folder)
    folder.mkdir(parents=True, exist_ok=True)
    with ItemProgress("cases made", num_cases) as progress:
        labels = dataset.write_cases(cases, published["salt"], workers, progress)
    for label, told in zip(labels, published["cases"], strict=False):
        same = [label[key] == told[key] for key in ("case", "kind", "machine_seed", "effects")]
        if not all(same):
            raise SystemExit(f"case {label['case']} is another one than published")
    facts = {**{key: published[key] for key in published if key not in ("cases", "salt")}}
    facts["num_cases"] = num_cases
    sealed = dataset.seal_labels(folder, {**facts, "cases": labels}, published["salt"])
    write_json(folder / "exam.json", {**facts, "labels_sha256": sealed})


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]), int((sys.argv[4:] or "1")[0]))
