"""Seconds of training until a policy succeeds, over worlds, epochs, mini-batches and seeds.

    python benchmarks/success_sweep.py runs/sweep --num-envs 2048 4096 --epochs 2 4 --mini-batches 4 8 \
      --seeds 1 2 3 4 5 --max-seconds 60 preset=gpu

Each point is a `brokk mode=train` of its own; further words go to it. A point whose folder holds a
finished training is read again. Writes `sweep.json` and prints medians over seeds.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import subprocess
from pathlib import Path
from typing import Any

import pandas as pd

from brokk_rl.console_table import print_table
from brokk_rl.rl.logger import LEVELS, PROGRESS, WINDOW, find_passing
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


def print_medians(rows: list[dict[str, Any]]) -> None:
    """Print medians over seeds; a level counts where most seeds reach it."""
    lines = []
    for sizes, members in pd.DataFrame(rows).groupby(SIZES):
        cells = [f"{size:,}" for size in sizes]
        for level in LEVELS:
            times = members[f"seconds_to_{level:.2f}"].astype(float).fillna(float("inf"))
            median = times.median()
            cells.append(f"{median:,.1f}" if median < float("inf") else None)
        rate = (members["env_steps"] / members["seconds"]).median()
        lines.append([*cells, f"{rate:,.0f}", str(len(members))])
    headings = [*SIZES, *(f"seconds to {level:.2f}" for level in LEVELS), "training /s", "seeds"]
    caption = f"Success over the newest {WINDOW:,} episodes of training."
    print_table(headings, lines, caption=caption)


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
    print_medians(rows)


if __name__ == "__main__":
    main()
