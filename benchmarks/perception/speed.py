"""Time of a 1080p frame from both pictures to holes, stage by stage, without the network.

    taskset -c 0,1 python benchmarks/perception/speed.py <out.json> --count 6 --threads 2 --shrink 2

Renders scenes of several conditions at 1 to 4 m, looks at each several times and takes the
shortest: what else runs on the machine makes the others longer. Writes the milliseconds of each
stage, how much processor time the whole took (which a busy machine changes less), the load that
there was meanwhile, and the processor's name.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import hydra
import numpy as np
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import track

from brokk_rl.signals import Frame
from perception.render.scene_sampler import compose_scene
from perception.stereo import Stereo

CONDITIONS, DISTANCES_M, TIMES = ("clean", "haze", "hidden"), (1.0, 2.0, 3.0, 4.0), 7
STAGES = ("stereo", "pair", "segment", "regions", "ellipse", "pose", "total", "processor_time")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--option", default="plane_conic")
    parser.add_argument(
        "--count", type=int, default=6, help="scenes of each condition and distance"
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--shrink", type=int, default=1, help="of the pictures that are matched")
    given = parser.parse_args()
    cv2.setNumThreads(given.threads)
    finder = configured(
        "perception", "mode=perceive", "perceive.input=.", f"perception={given.option}"
    ).build()
    stereo = replace(configured("stereo", "mode=render"), shrink=given.shrink)
    shortest = []
    kinds = [(condition, distance_m) for condition in CONDITIONS for distance_m in DISTANCES_M]
    for number, (condition, distance_m) in enumerate(track(kinds * given.count, transient=True)):
        frame = rendered(condition, distance_m, number)
        looks = []
        for _ in range(TIMES):
            start, busy = time.perf_counter(), time.process_time()
            depth_m = match(stereo, frame)
            ms = {"stereo": 1000.0 * (time.perf_counter() - start)}
            seen = replace(frame, depth_m=depth_m, depth_shrink=stereo.shrink)
            ms |= finder.find(seen).ms
            total, spent = time.perf_counter() - start, time.process_time() - busy
            looks.append(
                [ms.get(stage, 0.0) for stage in STAGES[:-2]] + [1000.0 * total, 1000.0 * spent]
            )
        shortest.append(min(looks, key=lambda look: look[-2]))
    table = {stage: {"median": float(np.median(ms)), "p95": float(np.percentile(ms, 95))}
             for stage, ms in zip(STAGES, np.array(shortest).T, strict=True)}  # fmt: skip
    told = {"option": given.option, "frames": len(shortest), "threads": given.threads, "shrink": given.shrink,
            "processor": processor(), "opencv": cv2.__version__, "load": round(os.getloadavg()[0], 1), "ms": table}  # fmt: skip
    given.out.write_text(json.dumps(told, indent=1) + "\n")
    Console().print(told)


def match(stereo: Stereo, frame: Frame) -> np.ndarray:
    """Returns the depth of a frame by its two pictures."""
    assert frame.right is not None and frame.baseline_m is not None
    focal_px = float(frame.camera_matrix[0, 0])
    return stereo.depth_m(frame.color, frame.right, focal_px, frame.baseline_m)


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
    shot = studio.shot(compose_scene(studio.scene, studio.rig, generator), generator)
    return Frame(
        color=shot.color, depth_m=shot.depth_m, camera_matrix=studio.rig.left.matrix, base_from_camera=studio.rig.base_from_camera,
        t_s=0.0, right=shot.right, baseline_m=studio.rig.baseline_m,
    )  # fmt: skip


def configured(key: str, *overrides: str) -> Any:
    """Returns one part of a mode's configuration, instantiated."""
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return instantiate(hydra.compose("config", list(overrides))[key], _convert_="all")


def processor() -> str:
    """Returns what the processor calls itself."""
    told = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    names = [
        line.split(":")[1].strip() for line in told.splitlines() if line.startswith("model name")
    ]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
