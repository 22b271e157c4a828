"""The table of perception: rendered scenes of each condition and distance, any options of perception side by side.

    python benchmarks/perception/table.py <out> --count 200 --processes 64 plane_conic
    'plane_conic perception/segmenter=onnx'

Each scene is rendered, looked at and forgotten; what came of it is a line of `<out>/frames.jsonl`.
Called again, it goes on where it stopped, with more scenes or more options too. Writes
`table.json`, the error model for `task.noise` into `noise.json`, and pictures of what went wrong,
with the reasons, into `failures/`. A fixed seed: the same scenes everywhere.

Rims as drills leave them, before and after:

    python benchmarks/perception/table.py <out> plane_conic
    'plane_conic perception.pose.broken=1'
    --conditions chips_25_mm chips_45_mm percussion spalled struck --distances 1 2 3 --count 20
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import signal
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import hydra
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scoring import FinderScore, score_frame

from brokk_rl.contracts.vision import FrameDetections
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from perception.finder import StagedFinder
from perception.overlay import OverlayDrawing
from perception.render.frame_renderer import FrameRenderer
from perception.render.scene_ranges import SceneRanges
from perception.render.scene_sampler import SceneSampler

CONDITIONS = ("clean", "haze", "dark", "hidden", "decoy", "empty")
VARIATIONS = {
    "chips_25_mm": ("clean", "scene.block.chips=[10,10]", "scene.block.chip_m=[0.025,0.025]"),
    "chips_45_mm": ("clean", "scene.block.chips=[10,10]", "scene.block.chip_m=[0.045,0.045]"),
    "discs_in_haze": ("haze", "scene.block.holes=[0,0]", "scene.block.decoys=[2,3]"),
}
"""Conditions that are a scene with overrides."""
SHOWN = (
    "recall", "precision", "decoys_accepted", "position_mm_median", "position_mm_p95", "normal_deg_p95",
    "along_inside_1_sigma", "across_inside_1_sigma", "normal_inside_1_sigma", "false", "ms_median",
)  # fmt: skip
ALL = "all"
"""Condition of the rows over all conditions."""


@dataclass(frozen=True)
class Task:
    """One scene to render and to look at with some options of perception."""

    condition: str
    distance_m: float
    number: int
    options: tuple[str, ...]
    seed: int
    failures: Path
    pictures: int
    shown: str
    render: tuple[str, ...]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "options",
        nargs="+",
        help="an option of perception, with overrides after it: 'plane_conic perception.apart=2'",
    )
    parser.add_argument(
        "--count", type=int, default=200, help="scenes of each condition and distance"
    )
    parser.add_argument("--conditions", nargs="+", default=CONDITIONS)
    parser.add_argument("--distances", nargs="+", type=float, default=(1.0, 2.0, 3.0, 4.0))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--seed", type=int, default=1, help="of the scenes; networks are trained on those of others"
    )
    parser.add_argument(
        "--pictures",
        type=int,
        default=12,
        help="at most so many pictures of failures of each row of the first option",
    )
    parser.add_argument(
        "--render",
        nargs="+",
        default=(),
        help="overrides of mode=render, such as rig/sensor=mosaic; another <out> for each",
    )
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "frames.jsonl"
    done = {
        (line["condition"], line["distance_m"], line["number"], line["option"])
        for line in read(path)
    }
    others = given.out / "failures", given.pictures, given.options[0], tuple(given.render)
    tasks = []
    for number in range(given.count):  # stopped early, all rows have as many scenes
        for condition in given.conditions:
            for distance_m in given.distances:
                left = tuple(
                    option
                    for option in given.options
                    if (condition, distance_m, number, option) not in done
                )
                if left:
                    tasks.append(Task(condition, distance_m, number, left, given.seed, *others))
    if tasks:
        work(tasks, path, given.processes)
    write(given.out, rows(path, given.options))


def work(tasks: list[Task], path: Path, processes: int) -> None:
    """Renders and looks, in as many processes; each line is written as it comes, so an interruption loses nothing."""
    context = multiprocessing.get_context("spawn")
    with (
        context.Pool(min(processes, len(tasks)), ready) as pool,
        path.open("a") as file,
        Progress() as progress,
    ):
        try:
            for lines in progress.track(
                pool.imap_unordered(look, tasks), total=len(tasks), description="scenes"
            ):
                file.writelines(json.dumps(line) + "\n" for line in lines)
                file.flush()
        except KeyboardInterrupt:
            Console().print("interrupted; the same command goes on from here")


def ready() -> None:
    """Prepares a process: one thread each, and it is the first one that is interrupted."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def look(task: Task) -> list[dict[str, Any]]:
    """Returns what each option makes of one scene."""
    studio = renderer(task.condition, task.distance_m, task.render)
    generator = scenes(task.seed).generator(f"scene/{task.number}")
    assert isinstance(studio.scene, SceneRanges), "every condition is one of random scenes"
    shot = studio.shot(SceneSampler(studio.scene, studio.rig, generator).compose(), generator)
    frame = studio.rig.model.build_frame(shot.color, shot.depth_m, 0.0, shot.right)
    lines = []
    for option in task.options:
        finder = build_finder(option)
        tally, found = score_frame(finder, frame, shot.truth)
        place = {
            "condition": task.condition,
            "distance_m": task.distance_m,
            "number": task.number,
            "option": option,
        }
        lines.append({**place, "tally": asdict(tally)})
        if not tally.is_perfect and option == task.shown:
            name = f"{option.replace(' ', '_').replace('/', '-')}_{task.condition}_{task.distance_m:g}m"
            show_failure(task, name, frame, found, finder)
    return lines


def show_failure(
    task: Task, name: str, frame: Frame, found: FrameDetections, finder: StagedFinder
) -> None:
    """Writes the picture of what went wrong and why, unless there are enough of its kind."""
    task.failures.mkdir(parents=True, exist_ok=True)
    if len(list(task.failures.glob(f"{name}_*.png"))) < task.pictures:
        make_drawing().write(task.failures / f"{name}_{task.number:04d}.png", frame, found)
        told = [
            f"score {hole.score:.2f}, radius {hole.radius_m:.4f} m at {hole.center_m.round(4).tolist()}"
            for hole in found.holes
        ]
        told += [finder.explain(one) for one in found.rejected]
        (task.failures / f"{name}_{task.number:04d}.txt").write_text("\n".join(told) + "\n")


@functools.cache
def renderer(condition: str, distance_m: float, render: tuple[str, ...]) -> FrameRenderer:
    scene, *overrides = VARIATIONS.get(condition, (condition,))
    return composed(
        "studio",
        "mode=render",
        f"scene={scene}",
        *overrides,
        *render,
        f"scene.sight.distance_m=[{distance_m},{distance_m}]",
    )


@functools.cache
def build_finder(option: str) -> StagedFinder:
    name, *overrides = option.split()
    return composed(
        "perception", "mode=perceive", f"perception={name}", "perceive.input=.", *overrides
    ).build()


@functools.cache
def make_drawing() -> OverlayDrawing:
    return composed("overlay", "mode=perceive", "perceive.input=.")


@functools.cache
def scenes(seed: int) -> Session:
    return composed("session", "mode=render", f"session.seed={seed}", "session.out=.")


def composed(key: str, *overrides: str) -> Any:
    """Returns one part of a mode's configuration, instantiated."""
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return instantiate(hydra.compose("config", list(overrides))[key], _convert_="all")


def read(path: Path) -> Iterator[dict[str, Any]]:
    """Yields the lines of a file that are whole; one that was cut off is done again."""
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


def rows(path: Path, options: list[str]) -> list[dict[str, Any]]:
    """Return the rows of each condition and of all."""
    tallies: dict[tuple, FinderScore] = defaultdict(FinderScore)
    for line in read(path):
        if line["option"] in options:
            for condition in (line["condition"], ALL):
                key = line["option"], condition, line["distance_m"]
                tallies[key] += FinderScore(**line["tally"])
    found_conditions = dict.fromkeys(key[1] for key in tallies)
    order = {name: number for number, name in enumerate((*options, *CONDITIONS, *found_conditions))}
    found = []
    for option, condition, distance_m in sorted(
        tallies, key=lambda key: (order[key[0]], order[key[1]], key[2])
    ):
        tally = tallies[option, condition, distance_m]
        place = {"perception": option, "condition": condition, "distance_m": distance_m}
        found.append({**place, **tally.row(), **tally.noise()})
    return found


def write(out: Path, found: list[dict[str, Any]]) -> None:
    """Write the table and the error model as JSON, and show the table."""
    (out / "table.json").write_text(json.dumps(found, indent=1) + "\n")
    noise = {f"{row['perception']}, {row['condition']}, {row['distance_m']:g} m":
             {name: row[name] for name in ("target_bias_m", "along_std_m", "across_std_m")} for row in found}  # fmt: skip
    (out / "noise.json").write_text(json.dumps(noise, indent=1) + "\n")
    table = Table("perception", "condition", "m", "frames", *SHOWN)
    for row in found:
        cells = ["–" if row[key] is None else f"{row[key]:.3g}" for key in SHOWN]
        table.add_row(
            row["perception"],
            row["condition"],
            f"{row['distance_m']:g}",
            str(row["frames"]),
            *cells,
        )
    Console(width=220).print(table)


if __name__ == "__main__":
    main()
