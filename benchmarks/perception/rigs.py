"""Pairs that are not perfect: errors of position over their stated covariance, and refusals.

    python benchmarks/perception/rigs.py benchmarks/perception/rigs.json --count 3 --drawn 20

The scenes are clean ones at 1080p. Fixed rigs carry one error each; drawn rigs are
`rig/error=drifted`, another rig for each scene. `before` looks at the same frames without the check
of the rectification, with the covariance of a perfect pair. `calibrated` looks at those of drawn
rigs after a calibration: the disparity's error is estimated from 24 views of the board at 1 to 3.5 m
by corners with noise of 0.05 px, as `mode=calibrate` does.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import hydra
import numpy as np
from hydra.utils import instantiate
from scoring import FinderScore, score_frame

from brokk_rl.session import Session
from brokk_rl.signals import Frame
from perception.calibrate.disparity_error import (
    correct_depth,
    estimate_disparity_error,
    measure_board_disparity,
)
from perception.finder import StagedFinder
from perception.render.frame_renderer import FrameRenderer
from perception.render.scene_ranges import SceneRanges
from perception.render.scene_sampler import compose_scene
from perception.render.stereo_camera import StereoRig

DISTANCES_M = (1.0, 2.0, 3.0, 4.0)
FIXED: dict[str, dict[str, Any]] = {
    "0.1 px across": {"offset_px": (0.1, 0.0)},
    "0.25 px across": {"offset_px": (0.25, 0.0)},
    "0.3 px down": {"offset_px": (0.0, 0.3)},
    "0.03 degrees of roll": {"turn_rad": (0.0, 0.0, math.radians(0.03))},
}
LARGEST_SIGMAS = 3.0
CORNER_PX = 0.05
"""Noise of a board's corner."""
CORNERS_M = np.stack([*np.meshgrid(np.arange(7) * 0.1, np.arange(5) * 0.1), np.zeros((5, 7))], -1)
CORNERS_M = CORNERS_M.reshape(-1, 3)
"""Inner corners of the board that `mode=board` prints."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=3, help="scenes of a fixed rig and distance")
    parser.add_argument("--drawn", type=int, default=20, help="drawn rigs of a distance")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so long")
    given = parser.parse_args()
    until = time.monotonic() + 60 * given.minutes
    # Ideal pictures: the errors shown are those of the rig alone.
    plain_pictures = ("mode=render", "rig/sensor=linear")
    studio: FrameRenderer = compose("studio", *plain_pictures)
    drifted: FrameRenderer = compose("studio", *plain_pictures, "rig/error=drifted")
    session: Session = compose("session", "mode=render", "session.seed=1", "session.out=.")
    after: StagedFinder = compose("perception", "mode=perceive").build()
    before = replace(after.settings, pair=None).build()
    scores: dict[tuple[str, float, str], FinderScore] = defaultdict(FinderScore)
    noticed: dict[tuple[str, float], int] = defaultdict(int)
    for number in range(max(given.count, given.drawn)):
        rigs = {}
        if number < given.count:
            for name, values in FIXED.items():
                rigs[name] = replace(studio.rig.error, **values)
        for place, distance_m in enumerate(DISTANCES_M):
            if number < given.drawn:
                seed = number * len(DISTANCES_M) + place
                rigs["drawn"] = replace(drifted.rig.error, seed=seed)
            for name, error in rigs.items():
                if time.monotonic() > until:
                    break
                frame, truth = shoot(studio, session, distance_m, number, error)
                plain = replace(frame, disparity_std_px=0.0)
                views = [("before", before, plain), ("after", after, frame)]
                if name == "drawn":
                    rig = replace(studio.rig, error=error)
                    views.append(("calibrated", after, calibrate(frame, rig, error.seed)))
                for when, finder, view in views:
                    score, found = score_frame(finder, view, truth)
                    scores[name, distance_m, when] += score
                    if when == "after":
                        noticed[name, distance_m] += any(
                            one.stage == "frame" for one in found.rejected
                        )
        write(given.out, given, scores, noticed)


def compose(key: str, *overrides: str) -> Any:
    """Return one part of a mode's configuration, instantiated."""
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return instantiate(hydra.compose("config", list(overrides))[key], _convert_="all")


def shoot(
    studio: FrameRenderer, session: Session, distance_m: float, number: int, error: Any
) -> tuple[Frame, Any]:
    """Return a frame of a scene by a rig with this error, and its truth."""
    generator = session.generator(f"clean/{distance_m:g}/{number}")
    assert isinstance(studio.scene, SceneRanges), "the default is one of random scenes"
    sight = replace(studio.scene.sight, distance_m=(distance_m, distance_m))
    rig = replace(studio.rig, error=error)
    scene = replace(studio.scene, sight=sight)
    studio = replace(studio, rig=rig, scene=scene)
    shot = studio.shot(compose_scene(scene, rig, generator), generator)
    frame = Frame(
        color=shot.color,
        depth_m=shot.depth_m,
        camera_matrix=rig.left.matrix,
        base_from_camera=rig.base_from_camera,
        t_s=0.0,
        right=shot.right,
        baseline_m=rig.baseline_m,
        disparity_std_px=rig.disparity_std_px,
    )
    return frame, shot.truth


def calibrate(frame: Frame, rig: StereoRig, seed: int) -> Frame:
    """Return a frame without the error of its disparity, as 24 views of the board tell it."""
    chance = np.random.default_rng(1000 + seed)
    views = [view_board(rig, distance_m, chance) for distance_m in np.linspace(1.0, 3.5, 24)]
    error = estimate_disparity_error([view for view in views if view is not None])
    assert error is not None and frame.baseline_m is not None
    return replace(
        frame,
        depth_m=correct_depth(frame.depth_m, frame.camera_matrix, frame.baseline_m, error.px),
        disparity_error_px=error.px,
        disparity_std_px=error.std_px,
    )


class KnownCorners:
    """Stands in for a tracker of boards: it knows where the right picture shows the corners."""

    def __init__(self, corners_px: np.ndarray) -> None:
        self._corners_px = corners_px

    def find_corners(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        return CORNERS_M, self._corners_px


def view_board(rig: StereoRig, distance_m: float, chance: np.random.Generator) -> Any:
    """Return the disparity of a board at a random place, its pose found as OpenCV does."""
    turn = np.asarray(cv2.Rodrigues(chance.uniform(-0.4, 0.4, 3))[0])
    middle = np.array([*(chance.uniform(-0.3, 0.3, 2) * distance_m), distance_m])
    point = (CORNERS_M - CORNERS_M.mean(0)) @ turn.T + middle
    left = rig.left.project(point)
    target = ideal = rig.left.project(point - [rig.baseline_m, 0.0, 0.0])
    for _ in range(4):
        # The pixel whose ray goes where the ideal pixel's does.
        seen = rig.left.project(rig.right.rays(target).astype(float))
        target = target + ideal - seen
    left, right = (one + chance.normal(0, CORNER_PX, one.shape) for one in (left, target))
    _, found, shift = cv2.solvePnP(CORNERS_M, left, rig.left.matrix, None)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.asarray(cv2.Rodrigues(found)[0]), shift[:, 0]
    black = np.zeros((2, 2, 3), np.uint8)
    frame = Frame(
        color=black,
        depth_m=black[..., 0].astype(np.float32),
        camera_matrix=rig.left.matrix,
        base_from_camera=None,
        t_s=0.0,
        right=black,
        baseline_m=rig.baseline_m,
    )
    tracker: Any = KnownCorners(right)
    return measure_board_disparity(tracker, frame, CORNERS_M, left, pose)


def write(path: Path, given: Any, scores: dict, noticed: dict) -> None:
    """Write the rows so far."""
    rows = []
    for (name, distance_m, when), score in sorted(scores.items()):
        row = score.row()
        sigmas = np.maximum(score.along_sigmas, 0.0)
        rows.append(
            {
                "rig": name,
                "distance_m": distance_m,
                "when": when,
                "frames": score.frames,
                "refused_by_check": noticed[name, distance_m] if when != "before" else 0,
                "found": score.found,
                "position_mm_max": 1000 * max(score.position_m) if score.position_m else None,
                "along_sigmas_max": float(sigmas.max()) if len(sigmas) else None,
                "beyond_3_sigma": int((sigmas > LARGEST_SIGMAS).sum()),
            }
            | {key: row[key] for key in row if key.startswith("position") or "inside" in key}
        )
    command = (
        f"python benchmarks/perception/rigs.py {path} --count {given.count} --drawn {given.drawn}"
    )
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    content = {"command": command, "machine": "two shared cores", "commit": commit, "rows": rows}
    path.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
