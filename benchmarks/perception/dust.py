"""Holes and flat dark discs in dust: log-likelihood ratios by the light on the wall, and the trade.

    python benchmarks/perception/dust.py <out.json> --count 20 --minutes 4

Scenes are `scene=haze` with one hole, and the same with discs in its place; light bounces. The gate
is set so high that each candidate in dust is refused with its ratio. Seed 1001 served to choose the
numbers of `perception.pose.wall_light`. The JSON holds what was done when the minutes are over, and
the same command goes on from there.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import subprocess
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from table import build_finder, renderer, scenes

from brokk_rl.contracts.vision import Rejection
from brokk_rl.session import Session
from perception.dataset import TrueCircle
from perception.pose.wall_light import IN_DUST
from perception.render.scene_ranges import SceneRanges
from perception.render.scene_sampler import compose_scene
from perception.sources.simulator import make_frame

CONDITIONS = {"haze": "hole", "discs_in_haze": "disc"}
LIMITS = (0.0, 1.0, 1.5, 2.0, 3.0)
SENSORS = ("linear", "mosaic")
REFUSE_ALL = "plane_conic perception.pose.looks.hole_log_ratio=1000"
NEAR = 0.5
"""Largest distance of an ellipse from the true centre, in its semi-axes."""
NEAR_M = 0.05
"""Largest distance of a found hole from the line of sight to the true centre."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=10, help="scenes of a condition and distance")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--distances", nargs="+", type=float, default=[1.0, 2.0, 3.0, 4.0])
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so long")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    until = time.monotonic() + 60 * given.minutes
    rows: list[dict[str, Any]] = []
    if given.out.exists():
        known = json.loads(given.out.read_text())["rows"]
        rows = [row for row in known if row["scene"] < given.count]
    done = {tuple(row[name] for name in ("sensor", "kind", "distance_m", "scene")) for row in rows}
    for number in range(given.count):
        for sensor, distance_m, condition in itertools.product(
            SENSORS, given.distances, CONDITIONS
        ):
            place = (sensor, CONDITIONS[condition], distance_m, number)
            if place not in done and time.monotonic() < until:
                rows += judge_scene(scenes(given.seed), condition, sensor, distance_m, number)
    write(given, rows)


def judge_scene(
    session: Session, condition: str, sensor: str, distance_m: float, number: int
) -> list[dict[str, Any]]:
    """Return a row for each hole or disc in view.

    `log_ratio` is `None` where no gate of dust decided, `found` tells that it was taken for a hole
    by other signs. A scene without any has a row whose `found` is `None`.
    """
    render = (f"rig/sensor={sensor}", "scene.light.bounces=true")
    studio, generator = (
        renderer(condition, distance_m, render),
        session.generator(f"scene/{number}"),
    )
    assert isinstance(studio.scene, SceneRanges), "every condition is one of random scenes"
    shot = studio.shot(compose_scene(studio.scene, studio.rig, generator), generator)
    frame = make_frame(shot, studio.rig, 0.0)
    found = build_finder(REFUSE_ALL).find(replace(frame, base_from_camera=None))
    kind = CONDITIONS[condition]
    place = {"sensor": sensor, "kind": kind, "distance_m": distance_m, "scene": number}
    rows = []
    for circle in shot.truth.holes if kind == "hole" else shot.truth.decoys:
        if circle.in_view and circle.hidden < 0.3:
            ratio = find_ratio(circle, frame.camera_matrix, found.rejected)
            is_found = any(is_same_place(hole.center_m, circle) for hole in found.holes)
            rows.append({**place, "log_ratio": ratio, "found": is_found})
    return rows or [{**place, "log_ratio": None, "found": None}]


def is_same_place(center_m: np.ndarray, circle: TrueCircle) -> bool:
    """Return whether a found hole lies near the line of sight to a true circle."""
    sight = np.array(circle.center_m) / np.linalg.norm(circle.center_m)
    return float(np.linalg.norm(center_m - (center_m @ sight) * sight)) < NEAR_M


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
    """Write how many holes and discs pass each limit, by sensor and distance, and in all."""
    counted = [row for row in rows if row["found"] is not None]
    table = []
    for sensor, distance_m, kind in itertools.product(
        (*SENSORS, None), (*given.distances, None), CONDITIONS.values()
    ):
        values = []
        for row in counted:
            is_here = sensor in (None, row["sensor"]) and distance_m in (None, row["distance_m"])
            if is_here and row["kind"] == kind:
                refused = -math.inf if row["log_ratio"] is None else row["log_ratio"]
                values.append(math.inf if row["found"] else refused)
        passed = {f"{limit:g}": int(sum(one >= limit for one in values)) for limit in LIMITS}
        place = {"sensor": sensor, "kind": kind, "distance_m": distance_m}
        table.append({**place, "count": len(values), "passed": passed})
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    distances = " ".join(f"{distance_m:g}" for distance_m in given.distances)
    content = {
        "command": f"python benchmarks/perception/dust.py <out.json> --count {given.count} "
        f"--distances {distances} --seed {given.seed}",
        "machine": "two shared cores",
        "commit": commit,
        "table": table,
        "rows": rows,
    }
    given.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
