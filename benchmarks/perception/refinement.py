"""Steps of the disparity refinement: what each does to noise and to the error of a face, by the truth.

    pip download scikit-image==0.26.0 --no-deps && unzip scikit_image*.whl 'skimage/data/motorcycle*'
    python benchmarks/perception/refinement.py <out.json> --real skimage/data/motorcycle

The real pair is the motorcycle of Middlebury (Scharstein et al. 2014) with its measured disparity.
The others are rendered. `pixel_px` is the standard deviation of the error of a pixel, `face_px` that
of its mean over a square of 24 px, in px of the matched pictures. `predicted_px` is told from the
pair alone. `chosen` is the number of steps that the matcher takes by itself.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from speed import configured

from perception.render.scene_sampler import compose_scene
from perception.sources.folder import read_picture
from perception.stereo import Stereo, predict_face_error

CONDITIONS = ("clean", "haze", "dark")
SQUARE_PX, LARGEST_PX, KNOWN = 24, 1.0, 0.9
"""Side of a square, errors beyond which a match is wrong, and least known part of a square."""
STEPS = 3
NEAREST_PX = 64.0
"""Largest disparity of the real pair."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--real", type=Path, help="beginning of the names of the real pair's files")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    stereo: Stereo = configured("stereo", "mode=render")
    rows = []
    if given.real is not None:
        left, right = (read_picture(Path(f"{given.real}_{side}.png")) for side in ("left", "right"))
        truth_px = np.load(f"{given.real}_disp.npz")["arr_0"]
        rows.append({"pair": "motorcycle", **judge(stereo, left, right, truth_px, NEAREST_PX)})
    for condition in CONDITIONS:
        studio = replace(configured("studio", "mode=render", f"scene={condition}"), depth="exact")
        generator = np.random.default_rng(7)
        shot = studio.shot(compose_scene(studio.scene, studio.rig, generator), generator)
        pull_px = studio.rig.focal_px * studio.rig.baseline_m
        truth_px = pull_px / shot.exact_depth_m
        found = judge(stereo, shot.color, shot.right, truth_px, pull_px / stereo.nearest_m)
        rows.append({"pair": condition, **found})
    given.out.write_text(json.dumps(rows, indent=1) + "\n")
    print(json.dumps(rows, indent=1))


def judge(
    stereo: Stereo, left: np.ndarray, right: np.ndarray, truth_px: np.ndarray, largest_px: float
) -> dict[str, Any]:
    """Returns errors after 0 to `STEPS` steps, and the number of steps that are chosen."""
    rows = []
    for steps in range(STEPS + 1):
        forced = replace(stereo, refinements=steps, least_gain=-np.inf)
        rows.append(measure(match(forced, left, right, largest_px), truth_px))
    chosen_px = match(replace(stereo, refinements=STEPS), left, right, largest_px)
    errors = [abs(measure(chosen_px, truth_px)["pixel_px"] - row["pixel_px"]) for row in rows]
    return {"chosen": int(np.argmin(errors)), "steps": rows}


def match(stereo: Stereo, left: np.ndarray, right: np.ndarray, largest_px: float) -> np.ndarray:
    """Returns the disparities of a pair."""
    nearest = replace(stereo, nearest_m=0.5, farthest_m=1e6)
    return 0.5 * largest_px / nearest.depth_m(left, right, 1.0, 0.5 * largest_px)


def measure(found_px: np.ndarray, truth_px: np.ndarray) -> dict[str, float | None]:
    """Returns the errors of disparities."""
    error = found_px - truth_px
    known = np.isfinite(error) & (np.abs(error) < LARGEST_PX)
    rows, columns = (size // SQUARE_PX for size in error.shape)
    cut = np.s_[: rows * SQUARE_PX, : columns * SQUARE_PX]
    shape = rows, SQUARE_PX, columns, SQUARE_PX
    count = known[cut].reshape(shape).sum((1, 3))
    total = np.where(known, error, 0.0)[cut].reshape(shape).sum((1, 3))
    squares = (total / np.maximum(count, 1))[count > KNOWN * SQUARE_PX**2]
    return {
        "pixel_px": float(error[known].std()),
        "face_px": float(squares.std()),
        "predicted_px": predict_face_error(found_px),
    }


if __name__ == "__main__":
    main()
