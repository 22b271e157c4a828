"""Holes and flat dark discs in dust: log-likelihood ratios by the light on the wall, and the trade.

    python benchmarks/perception/dust.py <out.json> --count 40 --distances 2 3 --minutes 4

Scenes are `scene=haze` with one hole, and the same with discs in its place. The gate is set so
high that each candidate in dust is refused with its ratio. Seed 1001 served to choose the numbers
of `perception.pose.appearance`; `--seed 1001` shows them. Stopped early, the JSON holds what was
done.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from table import build_finder, renderer, scenes

from brokk_rl.contracts.vision import Rejection
from brokk_rl.session import Session
from perception.dataset import TrueCircle
from perception.pose.appearance import IN_DUST
from perception.render.scene_ranges import SceneRanges
from perception.render.scene_sampler import compose_scene
from perception.sources.simulator import make_frame

CONDITIONS = {"haze": "hole", "discs_in_haze": "disc"}
LIMITS = (0.0, 1.0, 1.5, 2.0, 3.0)
REFUSE_ALL = "plane_conic perception.pose.looks.hole_log_ratio=1000"
NEAR = 0.5
"""Largest distance of an ellipse from the true centre, in its semi-axes."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=10, help="scenes of a condition and distance")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--distances", nargs="+", type=float, default=[1.0, 2.0, 3.0, 4.0])
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so long")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    until = time.monotonic() + 60 * given.minutes
    rows: list[dict[str, Any]] = []
    for number in range(given.count):
        for distance_m in given.distances:
            for condition in CONDITIONS:
                if time.monotonic() < until:
                    rows += judge_scene(scenes(given.seed), condition, distance_m, number)
        write(given, rows)


def judge_scene(
    session: Session, condition: str, distance_m: float, number: int
) -> list[dict[str, Any]]:
    """Return a row for each hole or disc in view: its log ratio, `None` where no gate of dust decided."""
    studio, generator = renderer(condition, distance_m, ()), session.generator(f"scene/{number}")
    assert isinstance(studio.scene, SceneRanges), "every condition is one of random scenes"
    shot = studio.shot(compose_scene(studio.scene, studio.rig, generator), generator)
    frame = make_frame(shot, studio.rig, 0.0)
    found = build_finder(REFUSE_ALL).find(frame)
    kind = CONDITIONS[condition]
    rows = []
    for circle in shot.truth.holes if kind == "hole" else shot.truth.decoys:
        if circle.in_view and circle.hidden < 0.3:
            ratio = find_ratio(circle, frame.camera_matrix, found.rejected)
            rows.append({"kind": kind, "distance_m": distance_m, "log_ratio": ratio})
    return rows


def find_ratio(
    circle: TrueCircle, camera_matrix: np.ndarray, rejected: Sequence[Rejection]
) -> float | None:
    """Return the largest log ratio among the candidates refused in dust at a true circle."""
    pixel = camera_matrix @ np.array(circle.center_m)
    pixel = pixel[:2] / pixel[2]
    ratios = []
    for one in rejected:
        if one.reason == IN_DUST and one.ellipse is not None:
            away = np.hypot(one.ellipse.x - pixel[0], one.ellipse.y - pixel[1])
            if away < NEAR * one.ellipse.a:
                ratios.append(float(one.value))
    return max(ratios, default=None)


def write(given: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    """Write the share of holes and discs that pass each limit, by distance and in all."""
    table = []
    for distance_m in [*sorted({row["distance_m"] for row in rows}), None]:
        for kind in CONDITIONS.values():
            ratios = []
            for row in rows:
                if row["kind"] == kind and distance_m in (None, row["distance_m"]):
                    ratios.append(-math.inf if row["log_ratio"] is None else row["log_ratio"])
            passed = {f"{limit:g}": int(sum(one >= limit for one in ratios)) for limit in LIMITS}
            table.append(
                {"kind": kind, "distance_m": distance_m, "count": len(ratios), "passed": passed}
            )
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    distances = " ".join(f"{distance_m:g}" for distance_m in given.distances)
    content = {
        "command": f"python benchmarks/perception/dust.py <out.json> --count {given.count} "
        f"--distances {distances} --seed {given.seed} --minutes {given.minutes:g}",
        "machine": "two shared cores",
        "commit": commit,
        "table": table,
        "rows": rows,
    }
    given.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
