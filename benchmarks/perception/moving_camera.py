"""Insertion with perception in the loop: fixed and moving cameras beside the true hole.

    python benchmarks/perception/moving_camera.py <out> --seeds 1 2 3 4 5 --episodes 2

Runs `mode=evaluate target=perceived` with a guided person at the levers, for each mount and seed,
from the same starts. Pictures are rendered at 2 Hz with the arm in them. `true` is the same with the
hole known exactly. Called again, it goes on where it stopped. Writes `moving_camera.json`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from brokk_rl.cli import main as run_command
from brokk_rl.statistics import compute_wilson_interval

TRUE_HOLE = ("task.noise.target_sample_m=0", "task.noise.target_bias_m=0")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--mounts", nargs="+", default=["true", "mast", "fixed_high"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        for mount in arguments.mounts:
            folder = arguments.out / f"{mount}_{seed}"
            if not (folder / "evaluation.json").is_file():
                evaluate(folder, mount, seed, arguments.episodes, arguments.processes)
            write_summary(arguments.out)


def evaluate(folder: Path, mount: str, seed: int, episodes: int, processes: int) -> None:
    """Evaluate one mount from the starts of one seed."""
    options = [
        "mode=evaluate", "follower=person", "policy=tasks:policies/behind_a_person",
        "~rivals.classical", "evaluation.video=false", f"evaluation.seed={seed}",
        f"evaluation.episodes={episodes}", "session.device=cpu", f"session.out={folder}",
    ]  # fmt: skip
    if mount == "true":
        options += TRUE_HOLE
    else:
        options += [
            "target=perceived", f"perception/mount@target.mount={mount}",
            f"target.num_processes={processes}",
        ]  # fmt: skip
    sys.argv = ["brokk", *options]
    run_command()


def write_summary(out: Path) -> None:
    """Write the figures of all finished runs."""
    rows: dict[str, dict[str, Any]] = {}
    for path in sorted(out.glob("*_*/evaluation.json")):
        mount, _, seed = path.parent.name.rpartition("_")
        result = json.loads(path.read_text())
        row = rows.setdefault(mount, {"seeds": {}, "episodes": 0, "inserted": 0})
        row["seeds"][seed] = result["success_strict"]["mean"]
        row["episodes"] += result["episodes"]
        row["inserted"] += round(result["success_strict"]["mean"] * result["episodes"])
        if "target" in result:
            row.setdefault("perception", {})[seed] = result["target"]
    for row in rows.values():
        row["success"] = row["inserted"] / row["episodes"]
        row["ci95"] = compute_wilson_interval(row["inserted"], row["episodes"])
        seen = list(row.get("perception", {}).values())
        if seen:
            frames = sum(one["frames"] for one in seen)
            row["frames"] = frames
            row["seen_share"] = sum(one["seen_share"] * one["frames"] for one in seen) / frames
            row["never_seen"] = sum(one["never_seen"] for one in seen)
    for row in rows.values():
        if "true" in rows:
            row["of_true"] = row["success"] / rows["true"]["success"]
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    found = {
        "command": "python benchmarks/perception/moving_camera.py <out>",
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
        "commit": commit,
        "mounts": rows,
    }
    (out / "moving_camera.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
