"""The table of perception: rendered scenes of each condition and distance, any options of perception side by side.

    python benchmarks/perception/table.py <scenes> <out> --count 200 plane_conic paper 'plane_conic perception/segmenter=onnx'

Scenes are rendered into <scenes>/<condition>_<distance>m where they are missing (`brokk mode=render`, fixed seed). Writes
`table.json`, `table.csv` and `table.png` into <out>, and the error model for `task.noise` into `noise.json`.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path

import cv2
import hydra
import matplotlib.pyplot as plt
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from perception.bench import Tally, judge

CONDITIONS = ("clean", "haze", "dark", "hidden", "decoy", "empty")
SHOWN = (
    "recall", "precision", "decoys_accepted", "position_mm_median", "position_mm_p95", "normal_deg_p95",
    "along_inside_1_sigma", "across_inside_1_sigma", "normal_inside_1_sigma", "false", "ms_median",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "options", nargs="+", help="an option of perception, with overrides after it: 'plane_conic perception.apart=2'"
    )
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--conditions", nargs="+", default=CONDITIONS)
    parser.add_argument("--distances", nargs="+", type=float, default=(1.0, 2.0, 3.0, 4.0))
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    cv2.setNumThreads(given.threads)
    given.out.mkdir(parents=True, exist_ok=True)
    rows, noise = [], {}
    for condition in given.conditions:
        for distance_m in given.distances:
            folder = render(given.scenes, condition, distance_m, given.count)
            for option in given.options:
                tally = look(option, folder, given.count)
                rows.append({"perception": option, "condition": condition, "distance_m": distance_m, **tally.row()})
                noise[f"{option}, {condition}, {distance_m:g} m"] = tally.noise()
                write(given.out, rows, noise)
    show(rows)


def render(scenes: Path, condition: str, distance_m: float, count: int) -> Path:
    """Returns the folder of frames of a row; renders those that are missing."""
    out = scenes / f"{condition}_{distance_m:g}m"
    if len(list((out / "frames").glob("*.truth.json"))) < count:
        resume = [f"resume={out}"] if out.exists() else []
        subprocess.run(
            [Path(sys.executable).with_name("brokk"), "mode=render", f"scene={condition}",
             f"scene.sight.distance_m=[{distance_m},{distance_m}]", f"render.count={count}", f"session.out={out}", *resume],
            check=True,
        )  # fmt: skip
    return out / "frames"


def look(option: str, folder: Path, count: int) -> Tally:
    """Returns what an option of perception makes of a folder of frames."""
    name, *overrides = option.split()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", ["mode=perceive", f"perception={name}", f"perceive.input={folder}", *overrides])
    observer, source = (instantiate(cfg[key], _convert_="all").build() for key in ("perception", "source"))
    tally = Tally()
    with source, Progress(transient=True) as progress:
        task = progress.add_task(f"{option}, {folder.parent.name}", total=count)
        for number in range(count):
            judge(observer, source, tally, number + 1)
            progress.update(task, completed=number + 1)
    return tally


def write(out: Path, rows: list[dict], noise: dict) -> None:
    (out / "table.json").write_text(json.dumps(rows, indent=1) + "\n")
    (out / "noise.json").write_text(json.dumps(noise, indent=1) + "\n")
    with (out / "table.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for axis, key in zip(axes, ("position_mm_p95", "normal_deg_p95", "recall"), strict=True):
        for option, condition in dict.fromkeys((row["perception"], row["condition"]) for row in rows):
            line = [row for row in rows if (row["perception"], row["condition"]) == (option, condition) and row[key] is not None]
            if line:
                axis.plot(
                    [row["distance_m"] for row in line], [row[key] for row in line], marker="o", label=f"{option}, {condition}"
                )
        axis.set(xlabel="distance, m", title=key, yscale="linear" if key == "recall" else "log")
    axes[0].legend(fontsize=6)
    figure.savefig(out / "table.png", dpi=150)
    plt.close(figure)


def show(rows: list[dict]) -> None:
    table = Table("perception", "condition", "m", "frames", *SHOWN)
    for row in rows:
        cells = ["–" if row[key] is None else f"{row[key]:.3g}" for key in SHOWN]
        table.add_row(row["perception"], row["condition"], f"{row['distance_m']:g}", str(row["frames"]), *cells)
    Console(width=200).print(table)


if __name__ == "__main__":
    main()
