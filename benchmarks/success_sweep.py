"""Seconds of training until a policy succeeds, over worlds, epochs, mini-batches and seeds.

    python benchmarks/success_sweep.py runs/sweep --num-envs 2048 4096 --epochs 2 4 --mini-batches 4 8 \
      --seeds 1 2 3 4 5 --max-seconds 60 preset=gpu

Each point is a `brokk mode=train` of its own; further words go to it. A point whose folder holds a
finished training is read again. Writes `sweep.json`, a row for each training.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import subprocess
from pathlib import Path
from typing import Any

from brokk_rl.rl.logger import LEVELS, PROGRESS, find_passing
from brokk_rl.session import read_record

SIZES = ["num_envs", "epochs", "mini_batches"]
EPISODE_STEPS = 400
"""Control steps of a whole episode of borehole_insertion: 20 s at 20 Hz."""


def train(folder: Path, point: dict[str, int], max_seconds: float, words: list[str]) -> None:
    """Train one policy, unless its folder holds it."""
    record = read_record(folder) if folder.exists() else None
    if record and record.get("outcome") == "finished":
        return
    command = ["brokk", "mode=train", f"session.out={folder}", f"session.seed={point['seed']}"]
    command += [f"sim.num_worlds={point['num_envs']}", f"rl.budget.max_seconds={max_seconds}"]
    algorithm = "rl.runner.algorithm"
    command += [f"{algorithm}.num_learning_epochs={point['epochs']}"]
    command += [f"{algorithm}.num_mini_batches={point['mini_batches']}"]
    command += ["rl.budget.max_env_steps=null", "evaluation.episodes=16", "evaluation.video=false"]
    subprocess.run([*command, *words], check=True)


def read_times(folder: Path, point: dict[str, int]) -> dict[str, Any]:
    """Return seconds and control steps to each level, `None` where it was not reached."""
    with (folder / PROGRESS).open(newline="") as file:
        rows = list(csv.DictReader(file))
    row: dict[str, Any] = dict(point)
    for level in LEVELS:
        passed = find_passing(rows, level, point["num_envs"] * EPISODE_STEPS)
        row[f"seconds_to_{level:.2f}"] = float(passed["seconds"]) if passed else None
        row[f"env_steps_to_{level:.2f}"] = int(float(passed["env_steps"])) if passed else None
    row["seconds"], row["env_steps"] = float(rows[-1]["seconds"]), float(rows[-1]["env_steps"])
    row["first_iteration_s"] = float(rows[0]["seconds"])  # mostly compilation and capture
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--num-envs", type=int, nargs="+", default=[256, 1024])
    parser.add_argument("--epochs", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--mini-batches", type=int, nargs="+", default=[4])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--max-seconds", type=float, default=200.0)
    given, words = parser.parse_known_args()
    rows = []
    points = itertools.product(given.num_envs, given.epochs, given.mini_batches, given.seeds)
    for sizes in points:
        point = dict(zip([*SIZES, "seed"], sizes, strict=True))
        folder = given.folder / "_".join(f"{name}{value}" for name, value in point.items())
        train(folder, point, given.max_seconds, words)
        rows.append(read_times(folder, point))
        (given.folder / "sweep.json").write_text(json.dumps({"rows": rows}, indent=1))


if __name__ == "__main__":
    main()
