"""Pairs that are not perfect: errors of position over their stated covariance, and refusals.

    python benchmarks/perception/rigs.py benchmarks/perception/rigs.json --count 3 --drawn 20

The scenes are clean ones at 1080p. Fixed rigs carry one error each; drawn rigs are
`rig/error=drifted`, another rig for each scene. `before` looks at the same frames without the check
of the rectification, with the covariance of a perfect pair.
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

import hydra
import numpy as np
from hydra.utils import instantiate

from brokk_rl.session import Session
from brokk_rl.signals import Frame
from perception.benchmark.scoring import FinderScore, score_frame
from perception.finder import StagedFinder
from perception.render.frame_renderer import FrameRenderer
from perception.render.scene_sampler import compose_scene

DISTANCES_M = (1.0, 2.0, 3.0, 4.0)
FIXED: dict[str, dict[str, Any]] = {
    "0.1 px across": {"offset_px": (0.1, 0.0)},
    "0.25 px across": {"offset_px": (0.25, 0.0)},
    "0.3 px down": {"offset_px": (0.0, 0.3)},
    "0.03 degrees of roll": {"turn_rad": (0.0, 0.0, math.radians(0.03))},
}
LARGEST_SIGMAS = 3.0


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
    studio: FrameRenderer = compose("studio", "mode=render")
    drifted: FrameRenderer = compose("studio", "mode=render", "rig/error=drifted")
    session: Session = compose("session", "mode=render", "session.seed=1", "session.out=.")
    after: StagedFinder = compose("perception", "mode=perceive").build()
    before = replace(after.settings, rectification=None).build()
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
                for when, finder, view in (("before", before, plain), ("after", after, frame)):
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
    sight = replace(studio.scene.sight, distance_m=(distance_m, distance_m))
    rig = replace(studio.rig, error=error)
    studio = replace(studio, rig=rig, scene=replace(studio.scene, sight=sight))
    shot = studio.shot(compose_scene(studio.scene, rig, generator), generator)
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
                "refused_by_check": noticed[name, distance_m] if when == "after" else 0,
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
