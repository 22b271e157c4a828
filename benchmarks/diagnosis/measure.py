"""Processor and wall time of `mode=diagnose`, two versions of the code side by side on the same cases.

    taskset -c 0,1 python benchmarks/diagnosis/measure.py <out.json> --before <sources of the other version> --minutes 5 20

The cases are made by `mode=exam exam.do=make` of the version that runs this program: five-joint
machines with one to three effects, a quarter of an hour of reference, and `--minutes` of field. Each
is diagnosed by the version before, then by this one with one and with two processes. The answers are
compared: verdict, named effects, largest difference of a probability in the ranking.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

NUM_FILES = 4
"""Files of a field; see `exam.field` of `exam_recording=mixed`."""
HERE = Path(__file__).resolve().parents[2]
SINGLE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--before", type=Path, default=None, help="sources of the other version")
    parser.add_argument("--cases", type=int, default=3, help="cases of each length")
    parser.add_argument("--minutes", type=float, nargs="+", default=[5.0, 20.0])
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--makers", type=int, default=1, help="processes that make cases")
    parser.add_argument("--names", nargs=2, default=None, help="commits, where git is not there")
    given = parser.parse_args()
    versions = {"after, 1 process": (HERE, 1), "after, 2 processes": (HERE, 2)}
    if given.before:
        versions = {"before": (given.before.resolve(), None), **versions}
    commits = given.names or [find_commit(given.before or HERE), find_commit(HERE)]
    told: dict[str, Any] = {
        "command": " ".join(sys.argv), "commits": dict(zip(("before", "after"), commits, strict=True)),
        "processor": find_processor(), "cores": len(os.sched_getaffinity(0)), "python": platform.python_version(),
        "cases": [],
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="brokk") as folder:
        for minutes in given.minutes:
            exam = Path(folder) / f"exam_{minutes:g}"
            seed, count, file_s = given.seed, given.cases, 60.0 * minutes / NUM_FILES
            run(HERE, Path(folder), "mode=exam", "exam.do=make", f"session.seed={seed}", f"exam.mix.num_cases={count}",
                "exam.mix.shares={none: 0.0, faint: 0.0, one: 0.5, several: 0.5, outside: 0.0}", "exam.mix.tracked_share=0.0",
                f"exam.field.file_s={file_s}", f"session.out={exam}", "session.device=cpu",
                f"exam.workers={given.makers}")  # fmt: skip
            for case in sorted((exam / "cases").iterdir()):
                row: dict[str, Any] = {"case": case.name, "field_minutes": minutes}
                answers = []
                for number, (name, (tree, workers)) in enumerate(versions.items()):
                    out = Path(folder) / f"{minutes:g}_{case.name}_{number}"
                    row[name], answer = diagnose(tree, case, out, workers)
                    answers.append(answer)
                    print(minutes, case.name, name, row[name], flush=True)
                row["same"] = compare(answers)
                told["cases"].append(row)
                given.out.write_text(json.dumps(told, indent=1) + "\n")
    for minutes in given.minutes:
        rows = [row for row in told["cases"] if row["field_minutes"] == minutes]
        told[f"mean, {minutes:g} minutes"] = {
            name: {
                key: round(sum(row[name][key] for row in rows) / len(rows), 1)
                for key in ("cpu_s", "wall_s")
            }
            for name in versions
        }
    given.out.write_text(json.dumps(told, indent=1) + "\n")


def run(tree: Path, folder: Path, *words: str) -> tuple[float, float]:
    """Run the command of a version; return its processor and wall time, s."""
    environment = os.environ | dict.fromkeys(SINGLE, "1")
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(tree), os.environ.get("PYTHONPATH"))))  # fmt: skip
    before, begun_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    command = [sys.executable, "-m", "brokk_rl", *words]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return round(cpu_s, 1), round(time.monotonic() - begun_s, 1)


def diagnose(
    tree: Path, case: Path, out: Path, workers: int | None
) -> tuple[dict[str, float], dict[str, Any]]:
    """Diagnose a case; return its times beside the load of the machine, and the answer."""
    words = ["mode=diagnose", f"diagnosis.case={case}", f"session.out={out}", "session.device=cpu"]
    words += [] if workers is None else [f"diagnosis.workers={workers}"]
    cpu_s, wall_s = run(tree, out.parent, *words)
    times = {"cpu_s": cpu_s, "wall_s": wall_s, "load": round(os.getloadavg()[0], 1)}
    return times, json.loads((out / "diagnosis.json").read_text())


def compare(answers: list[dict[str, Any]]) -> dict[str, Any]:
    """Return whether answers agree, and the largest difference of a probability in the ranking."""
    named, ranked = [], []
    for answer in answers:
        effects = [(one["effect"], tuple(one["joints"])) for one in answer["selected"]]
        named.append((answer["verdict"], sorted(effects)))
        ranked.append(
            {(one["effect"], tuple(one["joints"])): one["probability"] for one in answer["ranking"]}
        )
    keys = {key for one in ranked for key in one}
    apart = [max(one.get(k, 0.0) for one in ranked) - min(one.get(k, 0.0) for one in ranked) for k in keys]  # fmt: skip
    return {
        "verdict_and_effects": all(one == named[0] for one in named),
        "largest_difference_of_a_probability": round(max(apart, default=0.0), 3),
        "verdict": named[-1][0],
        "effects": [name for name, _ in named[-1][1]],
    }


def find_commit(tree: Path) -> str:
    """Return the commit of a folder; empty without git."""
    words = ["git", "-C", str(tree), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def find_processor() -> str:
    """Return the name of the processor."""
    told = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    names = [
        line.split(":")[1].strip() for line in told.splitlines() if line.startswith("model name")
    ]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
