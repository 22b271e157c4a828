"""Recall of holes that the arm hides, from one view and from the next views as well.

    python benchmarks/perception/hidden_views.py <out.json> --count 100

Scenes of `scene=hidden` at one distance. The fixed camera takes three pictures from its place. The
moving one takes the first there too. Then it may go up to 0.4 m sideways, up or down and turn to the
hole, where `conf/next_view.yaml` sends it, for two more. A hole counts as found when it was found
once. The machine's sensors tell where the arm is; where the hole is, is known to 30 mm.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.extensions import load_option, load_part
from brokk_rl.statistics import compute_wilson_interval
from perception.mount.mounts import MountError
from perception.mount.next_view import HoleBelief
from perception.mount.occlusion import Capsules
from perception.render.frame_renderer import FrameRenderer
from perception.render.photographed_surfaces import NO_PHOTOGRAPHS
from perception.render.scene_ranges import Scene, view_from
from perception.render.scene_sampler import compose_scene
from perception.render.solids import Box, Cylinder
from perception.render.stereo_camera import StereoRig, place_rig
from perception.sources.simulator import make_frame

NUM_PICTURES = 3
REACH_M, STEP_M = 0.4, 0.2
HINT_M = 0.03
WINDOW_PX = (960, 720)
NEAR_M = 0.05
"""Largest distance of a found hole from the true one."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--distance", type=float, default=1.0, help="m")
    arguments = parser.parse_args()
    rows = [look(number, arguments.distance) for number in range(arguments.count)]
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    found: dict[str, Any] = {
        "command": f"python benchmarks/perception/hidden_views.py <out.json> --count {len(rows)}",
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
        "commit": commit,
        "distance_m": arguments.distance,
        "scenes": len(rows),
    }
    for name in ("first", "fixed", "moving"):
        count = sum(row[name] for row in rows)
        found[name] = {
            "recall": count / len(rows),
            "ci95": compute_wilson_interval(count, len(rows)),
        }
    found["moves"] = sum(row["moves"] for row in rows)
    arguments.out.write_text(json.dumps(found, indent=1) + "\n")


def look(number: int, distance_m: float) -> dict[str, Any]:
    """Return whether the hole of a scene is found at first, from one place, and from several."""
    rig: StereoRig = load_option("rig", "zed_2i_1080p")
    kind = load_option("scene", "hidden", **{"sight.distance_m": [distance_m, distance_m]})
    generator = np.random.default_rng((7, number))
    scene = compose_scene(kind, rig, generator)
    assert scene.block is not None
    center = scene.block.pose.point(scene.block.holes[0].center_m)
    base = rig.base_from_camera
    hole_m = base[:3, :3] @ center + base[:3, 3]
    axis = base[:3, :3] @ scene.block.pose.rotation[:, 2]
    hint_m = hole_m + HINT_M * generator.standard_normal(3)
    mount = ReachingMount(base, hint_m)
    machine = load_option("machine", "brokk170")
    chooser = load_part("next_view")
    planner = chooser.build(machine, mount, rig, SceneArm(scene, base))
    camera = Camera(rig, kind, scene, hole_m)
    first = camera.sees(base, hint_m, generator)
    fixed = first or any(camera.sees(base, hint_m, generator) for _ in range(NUM_PICTURES - 1))
    position, moving, missed, moves = mount.start, first, 1, 0
    belief = HoleBelief(hint_m, axis, 0.05, HINT_M**2 * np.eye(3))
    plan_q = np.stack([machine.home] * chooser.num_times)
    for _ in range(NUM_PICTURES - 1):
        if moving:
            break
        choice = planner.choose(belief, position, plan_q, missed)
        moves += choice.view.is_moving
        missed = 0 if choice.view.is_moving else missed
        position, missed = choice.position, missed + 1
        moving = camera.sees(mount.locate(position, plan_q[0]), hint_m, generator)
    return {"first": first, "fixed": fixed, "moving": moving, "moves": moves}


class Camera:
    """Takes pictures of one scene from anywhere, and searches them."""

    def __init__(self, rig: StereoRig, kind: Any, scene: Scene, hole_m: np.ndarray) -> None:
        self._rig, self._kind, self._scene, self._hole_m = rig, kind, scene, hole_m
        self._stereo = load_part("stereo")
        self._finder = load_option("perception", "plane_conic").build()

    def sees(self, pose: np.ndarray, hint_m: np.ndarray, generator: np.random.Generator) -> bool:
        """Return whether the hole is found in a picture from `pose`."""
        away_m = np.linalg.inv(pose) @ np.append(hint_m, 1.0)
        pixel = self._rig.left.project(away_m[:3])
        size = np.array([self._rig.width, self._rig.height])
        corner = np.clip(np.round(pixel - np.array(WINDOW_PX) / 2), 0, size - WINDOW_PX)
        rig = place_rig(self._rig, pose, (int(corner[0]), int(corner[1])), WINDOW_PX)
        scene = view_from(self._scene, np.linalg.inv(pose) @ self._rig.base_from_camera)
        studio = FrameRenderer(
            rig=rig,
            scene=self._kind,
            stereo=self._stereo,
            surfaces=NO_PHOTOGRAPHS,
            depth="matched",
            pair=True,
        )
        frame = make_frame(studio.shot(scene, generator), rig, 0.0)
        try:
            holes = self._finder.find(frame).in_base_frame(frame).holes
        except FrameError:  # the arm fills the picture: no depth
            return False
        return any(np.linalg.norm(hole.center_m - self._hole_m) < NEAR_M for hole in holes)


class ReachingMount:
    """A mount that shifts the camera across its first view and turns it to the hole."""

    error = MountError(shared_m=0.0, shared_rad=0.0, view_m=0.0, view_rad=0.0)

    def __init__(self, base_from_camera: np.ndarray, hole_m: np.ndarray) -> None:
        self._first, self._hole_m = base_from_camera, hole_m
        steps = np.arange(-REACH_M, REACH_M + STEP_M / 2, STEP_M)
        self.start = np.zeros(2)
        self.views = np.array(list(itertools.product(steps, steps)))

    def locate(self, position: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the camera's poses; the first view is not turned."""
        flat = np.asarray(position, float).reshape(-1, 2)
        poses = np.stack([self._place(shift_m) for shift_m in flat])
        return poses.reshape(*np.shape(position)[:-1], 4, 4)

    def _place(self, shift_m: np.ndarray) -> np.ndarray:
        if not shift_m.any():
            return self._first
        pose = self._first.copy()
        pose[:3, 3] += self._first[:3, :2] @ shift_m
        ahead = self._hole_m - pose[:3, 3]
        ahead /= np.linalg.norm(ahead)
        right = np.cross(self._first[:3, 1], ahead)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], 1)
        return pose

    def compute_travel_s(self, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the time to each goal, at 0.4 m/s."""
        return np.abs(goals - start).max(-1) / 0.4

    def describe(self, position: np.ndarray) -> str:
        """Return the shift in words."""
        return f"{position[0]:.1f} m right, {position[1]:.1f} m down"


class SceneArm:
    """The arm of a scene as capsules: joint sensors tell where it is."""

    def __init__(self, scene: Scene, base_from_camera: np.ndarray) -> None:
        starts, ends, radii = [], [], []
        for solid in scene.solids:
            if solid.role != "arm":
                continue
            if isinstance(solid, Cylinder):
                along, half_m, radius_m = 2, solid.half_length_m, solid.radius_m
            else:
                assert isinstance(solid, Box)
                along = int(np.argmax(solid.half_m))
                half_m = float(solid.half_m[along])
                radius_m = float(np.sort(solid.half_m)[1])
            way_m = solid.pose.rotation[:, along] * half_m
            for place_m, into in ((-way_m, starts), (way_m, ends)):
                point = solid.pose.center_m + place_m
                into.append(base_from_camera[:3, :3] @ point + base_from_camera[:3, 3])
            radii.append(radius_m)
        self._capsules = Capsules(np.array(starts), np.array(ends), np.array(radii))

    def cover(self, machine: Any, q: np.ndarray) -> Capsules:
        """Return the capsules, the same at each time."""
        return self._capsules


if __name__ == "__main__":
    main()
