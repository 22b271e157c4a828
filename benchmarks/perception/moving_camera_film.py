"""Film of a camera on a mast that follows a hole, for the documentation.

    python benchmarks/perception/moving_camera_film.py docs/moving_camera.webp

The arm follows the guidance's plan into a hole to its left. Every half second the camera chooses its
view, takes a picture with the arm in it, and the finder searches it.
"""

from __future__ import annotations

import argparse
import io
import textwrap
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from brokk_rl.contracts.vision import CameraView, TrackedHole
from brokk_rl.errors import FrameError
from brokk_rl.extensions import load_option, load_part
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from perception.mount.approach import plan_approach_motion
from perception.sources.moving import MovingCamera

HOLE_M = (2.2, 1.9, 0.75)
START = (-0.6, -0.75, 0.9, 0.9, 0.5)
STEP_S, NUM_STEPS = 0.5, 24
WIDTH_PX = 760


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    machine = load_option("machine", "brokk170")
    yaw = float(np.arctan2(HOLE_M[1], HOLE_M[0]))
    scene = [*HOLE_M, yaw, 1.0, 0.05]
    pictures = film(machine, scene)
    pictures[0].save(
        out, save_all=True, append_images=pictures[1:], duration=600, loop=0, quality=55, method=6
    )


def film(machine: Machine, scene: list[float]) -> list[Image.Image]:
    """Return the frames of the film."""
    settings = MovingCamera(
        camera=load_option(
            "perception/source",
            "simulator",
            task_scene=scene,
            **{"rig.width": 1280, "rig.height": 720, "rig.focal_px": 528.0},
        ),
        mount=load_option("perception/mount", "mast"),
        next_view=load_part("next_view"),
        arm=load_option("target", "perceived").arm,
        machine=machine,
        hint_m=0.1,
    )
    finder = load_option("perception", "plane_conic").build()
    tracker = load_part("tracker").build()
    hole_m = np.array(scene[:3])
    plan = plan_approach_motion(machine, np.array(START), hole_m, NUM_STEPS, STEP_S)
    pictures, hole, frame = [], None, None
    with settings.build() as source:
        for number, q in enumerate(plan):
            t_s = number * STEP_S
            view = source.aim(q, hole, t_s)
            is_fresh = True
            try:
                frame = source.read_latest()
            except FrameError:  # on its way
                is_fresh = False
            if frame is not None and is_fresh:
                found = finder.find(frame).in_base_frame(frame).holes
                hole = next(iter(tracker.update(found, t_s)), None)
            if frame is None or view is None:  # on its way to the first view
                continue
            pictures.append(draw(machine, q, hole_m, frame, is_fresh, hole, view, t_s))
    return pictures


def draw(
    machine: Machine,
    q: np.ndarray,
    hole_m: np.ndarray,
    frame: Frame,
    is_fresh: bool,
    hole: TrackedHole | None,
    view: CameraView,
    t_s: float,
) -> Image.Image:
    """Return the camera's picture beside arm and camera from above, with the reason below."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(7.6, 3.4), width_ratios=(1.35, 1), layout="constrained"
    )
    left.axis("off")
    left.imshow(frame.color, alpha=1.0 if is_fresh else 0.35)
    draw_rim(left, frame, hole)
    std = "not seen yet" if hole is None else f"± {1000 * hole.std_m:.1f} mm"
    left.set_title(f"{t_s:.1f} s   hole {std}" + ("" if is_fresh else "   (moving)"), fontsize=9)
    arm = load_option("target", "perceived").arm.trace(machine, q)
    right.plot(arm[:, 0], arm[:, 1], "-o", color="#d98200", lw=4, ms=4, label="arm")
    right.plot(*hole_m[:2], "o", color="#007a33", ms=9, mfc="none", mew=2, label="hole")
    if frame.base_from_camera is not None:
        pose = frame.base_from_camera
        half = np.arctan(frame.color.shape[1] / 2 / frame.camera_matrix[0, 0])
        heading = np.arctan2(pose[1, 2], pose[0, 2])
        for side in (-half, half):
            end = pose[:2, 3] + 3.2 * np.array([np.cos(heading + side), np.sin(heading + side)])
            right.plot([pose[0, 3], end[0]], [pose[1, 3], end[1]], color="#1a7fa0", lw=1)
        right.plot(*pose[:2, 3], "s", color="#1a7fa0", label=f"camera, {pose[2, 3]:.1f} m high")
    right.set(xlim=(-0.6, 4.2), ylim=(-1.8, 3.0), aspect="equal", xlabel="x, m", ylabel="y, m")
    right.legend(fontsize=7, loc="lower right")
    figure.supxlabel("\n".join(textwrap.wrap(view.explain(), 115)), fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=100)
    plt.close(figure)
    picture = Image.open(buffer).convert("RGB")
    return picture.resize((WIDTH_PX, round(picture.height * WIDTH_PX / picture.width)))


def draw_rim(axes: Any, frame: Frame, hole: TrackedHole | None) -> None:
    """Draw the tracked rim into the camera's picture."""
    if hole is None or frame.base_from_camera is None:
        return
    angle = np.linspace(0.0, 2.0 * np.pi, 48)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(48)], 1)
    rim_m = hole.pose.center_m + hole.pose.radius_m * circle
    from_base = np.linalg.inv(frame.base_from_camera)
    point = (rim_m @ from_base[:3, :3].T + from_base[:3, 3]) @ frame.camera_matrix.T
    axes.plot(point[:, 0] / point[:, 2], point[:, 1] / point[:, 2], color="#00e060", lw=1.5)
    axes.set(xlim=(0, frame.color.shape[1]), ylim=(frame.color.shape[0], 0))


if __name__ == "__main__":
    main()
