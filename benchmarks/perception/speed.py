"""Time of a 1080p frame from both pictures to holes, stage by stage, without the network.

    taskset -c 0 python benchmarks/perception/speed.py <out.json> --count 3

Renders scenes of several conditions at 1 to 4 m. Each look is repeated and the shortest taken: what
else runs on the machine makes the others longer. Writes the milliseconds of each stage, the processor
time, the number of holes, and the load that there was meanwhile.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import hydra
import numpy as np
from hydra.utils import instantiate
from rich.progress import track

from brokk_rl.contracts.vision import FrameDetections
from brokk_rl.signals import Frame
from perception.render.scene_sampler import SceneSampler

CONDITIONS, DISTANCES_M, TIMES = ("clean", "haze", "hidden"), (1.0, 2.0, 3.0, 4.0), 5


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--count", type=int, default=3, help="scenes of each condition and distance"
    )
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    cv2.setNumThreads(given.threads)
    finder = configured("perception", "mode=perceive", "perceive.input=.").build()
    looks, num_holes = [], 0
    kinds = [(condition, distance_m) for condition in CONDITIONS for distance_m in DISTANCES_M]
    for number, (condition, distance_m) in enumerate(track(kinds * given.count, transient=True)):
        frame = rendered(condition, distance_m, number)
        found, ms = look(lambda frame=frame: finder.find(frame))
        looks.append(ms)
        num_holes += len(found.holes)
    told = {
        "frames": len(looks),
        "holes": num_holes,
        "threads": given.threads,
        "opencv": cv2.__version__,
        "load": round(os.getloadavg()[0], 1),
        "ms": summarize(looks),
    }
    given.out.write_text(json.dumps(told, indent=1) + "\n")


def look(find: Callable[[], FrameDetections]) -> tuple[FrameDetections, dict[str, float]]:
    """Returns what a look finds, and the ms of its stages and of the processor, of the shortest."""
    shortest: dict[str, float] = {}
    found = find()
    for _ in range(TIMES):
        busy = time.process_time()
        found = find()
        spent_ms = 1000.0 * (time.process_time() - busy)
        if not shortest or spent_ms < shortest["processor_time"]:
            shortest = found.ms | {"processor_time": spent_ms}
    return found, shortest


def summarize(looks: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Returns median and 95th percentile of each stage."""
    table = {}
    for stage in dict.fromkeys(stage for one in looks for stage in one):
        ms = [one.get(stage, 0.0) for one in looks]
        table[stage] = {"median": float(np.median(ms)), "p95": float(np.percentile(ms, 95))}
    return table


def rendered(condition: str, distance_m: float, number: int) -> Frame:
    """Returns a frame of a scene that is drawn for it."""
    studio = configured(
        "studio",
        "mode=render",
        "rig/sensor=linear",  # as for earlier figures
        f"scene={condition}",
        f"scene.sight.distance_m=[{distance_m},{distance_m}]",
    )
    generator = np.random.default_rng((7, number))
    shot = studio.shot(SceneSampler(studio.scene, studio.rig, generator).compose(), generator)
    return Frame(
        color=shot.color, depth_m=np.full_like(shot.depth_m, np.nan), camera_matrix=studio.rig.left.matrix,
        base_from_camera=None, t_s=0.0, right=shot.right, baseline_m=studio.rig.baseline_m,
    )  # fmt: skip


def configured(key: str, *overrides: str) -> Any:
    """Returns one part of a mode's configuration, instantiated."""
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return instantiate(hydra.compose("config", list(overrides))[key], _convert_="all")


if __name__ == "__main__":
    main()
