"""Let rivals sit an exam from end to end; run it again to go on after an interruption.

    python benchmarks/exam/rivals/run_sitting.py servos <exam> <marks> <work> --workers 16
    python benchmarks/exam/rivals/run_sitting.py held_out <exam> benchmarks/exam/held_out/second <work> --workers 16

`<exam>` is a folder of `exam.do=make`; for `held_out` it is made from the published salt where it is
missing. `<marks>` holds the published answers of the diagnosis; closings that its `examined.json` lacks are measured.
Answers, examinations and a development exam go to `<work>`. A rival without a rule in `rules.json`
first sits the development exam, and its rule is chosen there. Results stand beside this file.
`--until answers` stops before the labels are opened, so that `<marks>` need not exist yet.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from sittings import SITTINGS, Sitting

HERE = Path(__file__).parent
RULES_FILE = HERE / "rules.json"
HELD_OUT_CASES = 36
"""The first cases of the held-out sitting, as many as were made again."""


def call(*words: object) -> None:
    """Run a program of this environment, and stop where it fails."""
    subprocess.run([sys.executable, *map(str, words)], check=True)


def call_exam(*overrides: str, folder: Path) -> None:
    """Run a step of `mode=exam` in a folder, or go on with it."""
    begun = [f"resume={folder}"] if (folder / "resolved.yaml").is_file() else []
    call("-P", "-m", "brokk_rl", "mode=exam", *overrides, *begun, f"session.out={folder}")


def sit_exam(
    rival: str, exam: Path, sitting: Sitting, answers: Path, args: argparse.Namespace
) -> None:
    """Have a rival answer all cases of an exam that it has not answered."""
    program = [str(args.python.absolute()), str(HERE.resolve() / "sit.py"), rival]
    words = ",".join([*program, "'{case}'", "'{out}'", "'{machine}'"])
    call_exam(
        *sitting.run_options,
        "exam.do=run",
        f"exam.folder={exam}",
        f"exam.workers={args.workers}",
        f"exam.candidate.command=[{words}]",
        f"exam.candidate.limit_s={args.limit_s}",
        folder=answers,
    )


def choose_rules(sitting: Sitting, args: argparse.Namespace) -> None:
    """Choose the rule of each rival that has none, on a development exam."""
    known = json.loads(RULES_FILE.read_text())
    missing = [rival for rival in sitting.rivals if rival not in known]
    exam = args.work / "development"
    if missing and not (exam / "exam.json").is_file():
        call_exam(
            *sitting.run_options, *sitting.development, f"exam.workers={args.workers}", folder=exam
        )
    for rival in missing:
        answers = args.work / f"development_{rival}"
        sit_exam(rival, exam, sitting, answers, args)
        call(HERE / "choose_rule.py", exam, answers, rival)


def main(args: argparse.Namespace) -> None:
    """Choose rules, sit, open the labels, write the results."""
    sitting = SITTINGS[args.sitting]
    args.work.mkdir(parents=True, exist_ok=True)
    choose_rules(sitting, args)
    if args.sitting == "held_out" and not (args.exam / "exam.json").is_file():
        call(HERE / "remake.py", args.marks, HELD_OUT_CASES, args.exam, args.workers)
    for rival in sitting.rivals:
        sit_exam(rival, args.exam, sitting, args.work / rival, args)
    if args.until == "answers":
        return
    pairs = [f"{rival}={args.work / rival}" for rival in sitting.rivals]
    scored = args.work / "scored"
    call(
        *(HERE / "table.py", args.sitting, args.exam, args.marks, scored),
        *(HERE / f"{sitting.name}.json", *pairs, "--workers", args.workers),
    )
    gaps = HERE / f"{sitting.name}_own_gap.json"
    words = (args.sitting, args.exam, scored, gaps, *pairs)
    subprocess.run([args.python, HERE / "own_gap.py", *words], check=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Let rivals sit an exam.")
    parser.add_argument("sitting", choices=SITTINGS)
    for folder in ("exam", "marks", "work"):
        parser.add_argument(folder, type=Path)
    parser.add_argument("--workers", type=int, default=2, help="cases answered at once")
    parser.add_argument(
        "--python", type=Path, default=Path(sys.executable), help="environment of the rivals"
    )
    parser.add_argument("--limit-s", type=float, default=900.0, help="longest time for a case, s")
    parser.add_argument("--until", choices=("answers", "end"), default="end")
    main(parser.parse_args())
