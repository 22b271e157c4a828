"""Noise of disparities: rendered pairs by each sensor, beside a real pair with dense truth.

    uv run --with scikit-image python benchmarks/perception/camera_noise.py <out.json> --count 3

Every pair is matched with `conf/stereo.yaml`, refined and not. The error of a disparity is its difference
from the truth; counted are errors within 1 px of their median, away from steps of the depth. Rendered:
the block's face around a hole at 1, 2 and 3 m. Real: the motorcycle of Middlebury 2014 (Scharstein et al.), in the
size that scikit-image ships, two photographs by single-lens reflex cameras.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import hydra
import numpy as np
from hydra.utils import instantiate

from perception.render.frame_renderer import FrameRenderer
from perception.render.scene_ranges import SceneRanges
from perception.render.scene_sampler import compose_scene
from perception.render.stereo_camera import place_rig
from perception.stereo import Stereo

SENSORS = ("linear", "mosaic")
DISTANCES_M = (1.0, 2.0, 3.0)
WINDOW_PX = (640, 480)
"""Part of the picture that is rendered, columns and rows."""
AWAY_PX = 10
"""Pixels as near to a step of the depth are left out: a window would mix two surfaces."""
LARGEST_PX = 1.0
"""Larger errors are wrong matches; their share is told apart."""
REAL_DISPARITY_PX = 80.0
"""Largest disparity of the real pair, rounded up."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=3, help="scenes of each distance")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    rows = []
    for sensor in SENSORS:
        for distance_m in DISTANCES_M:
            studio = compose_renderer(sensor, distance_m)
            errors: dict[str, list[np.ndarray]] = defaultdict(list)
            for number in range(given.count):
                generator = np.random.default_rng((given.seed, number))
                for name, error in measure_rendered(studio, generator):
                    errors[name].append(error)
            for name, parts in errors.items():
                place = {"pictures": sensor, "distance_m": distance_m, "pairs": len(parts)}
                rows.append(place | {"matching": name} | summarize(np.concatenate(parts)))
    stereo = compose_renderer("linear", 1.0).stereo
    for name, error in measure_real(stereo):
        row = {"pictures": "real", "distance_m": None, "pairs": 1, "matching": name}
        rows.append(row | summarize(error))
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    content = {
        "command": f"python benchmarks/perception/camera_noise.py <out.json> --count {given.count}",
        "machine": "one core of an AMD EPYC",
        "commit": commit,
        "rows": rows,
    }
    given.out.write_text(json.dumps(content, indent=1) + "\n")


def compose_renderer(sensor: str, distance_m: float) -> FrameRenderer:
    """Return the renderer of clean scenes with a sensor at one distance."""
    choices = [f"rig/sensor={sensor}", f"scene.sight.distance_m=[{distance_m},{distance_m}]"]
    with hydra.initialize_config_module("conf", version_base="1.3"):
        config = hydra.compose("config", ["mode=render", "scene=clean", *choices])
        return instantiate(config["studio"], _convert_="all")


def measure_rendered(
    studio: FrameRenderer, generator: np.random.Generator
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the matching and its errors on the block of a random scene, px, NaN where unknown."""
    assert isinstance(studio.scene, SceneRanges), "clean scenes are random ones"
    scene = compose_scene(studio.scene, studio.rig, generator)
    assert scene.block is not None, "clean scenes have a block"
    middle = scene.block.pose.point(scene.block.holes[0].center_m)
    place = np.round(studio.rig.left.project(middle) - np.array(WINDOW_PX) / 2)
    corner = np.clip(place, 0, np.array([studio.rig.width, studio.rig.height]) - WINDOW_PX)
    pose = studio.rig.base_from_camera
    window = place_rig(studio.rig, pose, (int(corner[0]), int(corner[1])), WINDOW_PX)
    shot = replace(studio, rig=window, depth="exact").shot(scene, generator)
    assert shot.right is not None, "a pair is rendered"
    shift_px = studio.rig.focal_px * studio.rig.baseline_m
    truth = shift_px / shot.exact_depth_m
    counted = shot.label.block & ~shot.label.arm & ~find_steps(truth)
    # What the right picture does not show.
    counted[:, : int(np.nanmax(truth)) + AWAY_PX] = False
    for name, stereo in list_matchings(studio.stereo):
        depth_m = stereo.depth_m(shot.color, shot.right, studio.rig.focal_px, studio.rig.baseline_m)
        yield name, (shift_px / depth_m - truth)[counted]


def measure_real(stereo: Stereo) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the matching and its errors on the real pair, px, NaN where unknown."""
    # Not a dependency: this script alone wants it.
    from skimage.data import stereo_motorcycle  # pyright: ignore[reportMissingImports]

    left, right, truth = stereo_motorcycle()
    truth = np.where(np.isfinite(truth), truth, np.nan).astype(np.float32)
    counted = np.isfinite(truth) & ~find_steps(truth)
    # Only products of focal length and baseline count: 1 px is 1 m away.
    for name, matching in list_matchings(
        replace(stereo, nearest_m=1 / REAL_DISPARITY_PX, farthest_m=1.0)
    ):
        depth_m = matching.depth_m(left, right, 1.0, 1.0)
        yield name, (1.0 / depth_m - truth)[counted]


def list_matchings(stereo: Stereo) -> tuple[tuple[str, Stereo], ...]:
    """Return the matcher as it ships and without its refinement."""
    return ("refined", stereo), ("plain", replace(stereo, refinements=0))


def find_steps(disparity: np.ndarray) -> np.ndarray:
    """Return the pixels near a step of the disparity or an unknown one, `(h, w)` bool."""
    bend = np.abs(cv2.Laplacian(np.nan_to_num(disparity).astype(np.float32), cv2.CV_32F))
    step = ((bend > 1.0) | ~np.isfinite(disparity)).astype(np.uint8)
    side = 2 * AWAY_PX + 1
    return cv2.dilate(step, np.ones((side, side), np.uint8)).astype(bool)


def summarize(error: np.ndarray) -> dict[str, Any]:
    """Return the figures of errors, px: their median, deviation, and shares."""
    known = error[np.isfinite(error)]
    middle = float(np.median(known))
    near = np.abs(known - middle) < LARGEST_PX
    return {
        "known": len(known) / len(error),
        "near": float(near.mean()),
        "median_px": middle,
        "std_px": float(known[near].std()),
    }


if __name__ == "__main__":
    main()
