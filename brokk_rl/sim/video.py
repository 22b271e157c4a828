"""Videos and stills of a recorded episode, drawn by MuJoCo in a process of its own.

GL drivers can end a process, and MuJoCo chooses its GL library at import.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from brokk_rl.kinematics import Kinematics, compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from brokk_rl.session import write_bytes
from brokk_rl.sim.posed_scene import SHOWN_GROUPS, PosedScene
from brokk_rl.sim.probe import find_renderer
from brokk_rl.sim.scene import FAR_M

log = logging.getLogger(__name__)

MAX_FRAMES = 200
"""Longer episodes are thinned out to this many frames: a CPU renders about five pictures a
second."""
SIZE = (1200, 540)
"""Width and height of a picture, pixels."""
CLOSE_WIDTH = 380
"""Width of the close-up at the right, pixels."""
NUM_STILLS = 3
"""Pictures of a video. Chosen by hand; not searched."""
FONT_SIZE = 18
"""Size of the text, px. Chosen by hand; not searched."""
MARK_RADIUS_M, MARK_RGBA = 0.06, (0.1, 0.75, 0.35, 0.8)
"""Ball that marks a target without a block: seen beside the arm, smaller than the breaker."""
CLOSE_VIEW = (1.6, 58.0, -30.0)
"""Close-up of rim, target or tool: distance in m, azimuth from the direction of the arm and elevation
in degrees. Chosen by eye: from aside and above, so that the arm does not hide it."""
VIDEO_QUALITY = 7
"""Of ffmpeg's encoder as imageio_ffmpeg scales it, 0 to 10; its default is 5."""


@dataclass(frozen=True)
class RenderJob:
    """An episode and the file to draw it into; travels to the rendering process as a pickle.

    Attributes:
        machine: The machine.
        episode: A recorded episode of `T` control steps, in numpy: positions `q` and commands `u`,
            `(T, J)`, contact force `force_n`, `(T,)`, `scene`, `(S,)`, and the target of the tip,
            `target_m`, `(3,)` or `None`.
        path: The mp4 to write.
        site: MJCF of what stands beside the block.
    """

    machine: Machine
    episode: Any
    path: Path
    site: Path | None = None

    @property
    def stride(self) -> int:
        """Steps from frame to frame."""
        return max(1, math.ceil(len(self.episode.q) / MAX_FRAMES))

    def list_frames(self) -> list[int]:
        """Return the steps that are drawn: the last one always."""
        return sorted({*range(0, len(self.episode.q), self.stride), len(self.episode.q) - 1})

    @property
    def has_block(self) -> bool:
        """True where the block is within the machine's reach; tasks without one put it far away."""
        return float(np.hypot(*self.episode.scene[:2])) < FAR_M

    @property
    def mark_m(self) -> np.ndarray | None:
        """Target to mark: that of a task without a block, whose hole would show it."""
        return None if self.has_block else self.episode.target_m


def render_video(
    machine: Machine, episode: Any, path: Path, site: Path | None = None
) -> Path | None:
    """Write an mp4 to `path` and stills beside it.

    `<stem>_0.png` shows the start, the last still the end. `RenderJob` says what an episode has.

    Returns:
        `path`; `None` where no GL library can draw here.

    Raises:
        StorageError: The files cannot be written.
    """
    library = find_renderer()
    if library is None:
        log.warning(
            "no video: MuJoCo finds no GL library that can draw here; install libegl1 or libosmesa6, or set "
            "MUJOCO_GL to egl, osmesa or glfw (see `brokk mode=doctor`)"
        )
        return None
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "video.mp4"
        job = RenderJob(machine, episode, draft, site)
        if not _run_renderer(job, library):
            return None
        for file in sorted(draft.parent.glob("video*.[mp][pn]*")):
            name = file.name.replace("video", path.stem, 1)
            write_bytes(path.with_name(name), file.read_bytes())
    return path


def _run_renderer(job: RenderJob, library: str) -> bool:
    """Draw a job in a process of its own; return whether it drew everything."""
    file, told = job.path.with_suffix(".job"), job.path.with_suffix(".log")
    file.write_bytes(pickle.dumps(job))
    environment = os.environ | {
        "MUJOCO_GL": library,
        "PYTHONPATH": os.pathsep.join(part for part in sys.path if part),
    }
    program = "import sys; from brokk_rl.sim.video import render_job; render_job(sys.argv[1])"
    with (
        told.open("w") as errors,
        ItemProgress("drawing the video", len(job.list_frames())) as progress,
        subprocess.Popen(
            [sys.executable, "-c", program, str(file)],
            env=environment,
            cwd=file.parent,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process,
    ):
        assert process.stdout is not None, "piped"
        for _ in process.stdout:  # a line a frame
            progress.advance()
    if process.returncode:
        log.warning(
            "no video: MuJoCo's renderer failed with MUJOCO_GL=%s: %s",
            library,
            told.read_text().strip()[-500:],
        )
    return process.returncode == 0


def render_job(file: str) -> None:
    """Draw the `RenderJob` that `render_video` has left in `file`; runs in its own process."""
    import imageio.v2 as imageio
    import imageio_ffmpeg

    job: RenderJob = pickle.loads(Path(file).read_bytes())
    frames = job.list_frames()
    # stills at equal distances from the first frame to the last
    stills = {round(i * (len(frames) - 1) / (NUM_STILLS - 1)): i for i in range(NUM_STILLS)}
    rate_hz = 1.0 / (job.machine.period_s * job.stride)
    writer = imageio_ffmpeg.write_frames(
        str(job.path),
        SIZE,
        fps=rate_hz,  # pyright: ignore[reportArgumentType]
        quality=VIDEO_QUALITY,
        macro_block_size=4,
    )
    writer.send(None)
    try:
        for count, picture in enumerate(draw_frames(job, frames)):
            writer.send(np.ascontiguousarray(picture))
            if count in stills:
                still = job.path.with_name(f"{job.path.stem}_{stills[count]}.png")
                imageio.imwrite(still, picture)
            sys.stdout.write("\n")
            sys.stdout.flush()
    finally:
        writer.close()


def write_captions(job: RenderJob) -> list[str]:
    """Return a line for each step: time, tip relative to the rim or the target, contact force."""
    q = torch.as_tensor(job.episode.q, dtype=torch.float32)
    tip_m = Kinematics(job.machine).pose(q).tip_in_base_m.numpy()
    lines = []
    for step, (at_m, force) in enumerate(zip(tip_m, job.episode.force_n, strict=True)):
        where = ""
        if job.has_block:
            x, y, z = at_m - job.episode.scene[:3]
            side, off_axis_cm = "above" if z > 0 else "below", 100 * math.hypot(x, y)
            where = f"{100 * abs(z):4.0f} cm {side} the rim, {off_axis_cm:5.1f} cm off axis    "
        elif job.episode.target_m is not None:
            where = f"{100 * np.linalg.norm(at_m - job.episode.target_m):5.1f} cm to the target    "
        lines.append(f"{step * job.machine.period_s:5.1f} s    {where}{force:6.0f} N")
    return lines


def draw_frames(job: RenderJob, steps: Iterable[int]) -> Iterator[np.ndarray]:
    """Yield a picture, `(height, width, 3)` uint8, a step: overview, close-up, commands."""
    from PIL import Image, ImageDraw, ImageFont

    lines, font, (width, height) = write_captions(job), ImageFont.load_default(FONT_SIZE), SIZE
    split = width - CLOSE_WIDTH
    outline = {"stroke_width": 2, "stroke_fill": (40, 40, 40)}
    fixed_m = job.episode.scene[:3] if job.has_block else job.episode.target_m
    posed = PosedScene(job.machine, job.site)
    with (
        mujoco.Renderer(posed.model, height, split) as wide,
        mujoco.Renderer(posed.model, height, CLOSE_WIDTH) as near,
    ):
        for step in steps:
            posed.set_pose(job.episode.q[step], job.episode.scene)
            mujoco.mj_comPos(posed.model, posed.data)
            mujoco.mj_camlight(posed.model, posed.data)
            point_m = fixed_m
            if point_m is None:  # neither a block nor a target: the tool
                point_m = compute_tool_kinematics(job.machine, job.episode.q[step]).tip_in_base_m
            views = (
                _draw_view(wide, posed, "overview", job.mark_m),
                _draw_view(near, posed, _look_at(point_m), job.mark_m),
            )
            picture = Image.fromarray(np.concatenate(views, axis=1))
            pen = ImageDraw.Draw(picture)
            pen.rectangle((split - 1, 0, split + 1, height), fill="white")
            pen.text((16, 12), lines[step], fill="white", font=font, **outline)
            _draw_command_bars(pen, job.machine.joint_names, job.episode.u[step], font, height)
            yield np.asarray(picture)


def _draw_view(
    renderer: mujoco.Renderer,
    posed: PosedScene,
    camera: str | mujoco.MjvCamera,
    mark_m: np.ndarray | None,
) -> np.ndarray:
    """Return what a camera sees, with a ball at `mark_m`, `(3,)`, `(height, width, 3)` uint8."""
    option = mujoco.MjvOption()
    option.geomgroup[:] = [group in SHOWN_GROUPS for group in range(6)]
    option.sitegroup[:] = 0
    renderer.update_scene(posed.data, camera, option)
    if mark_m is not None:
        scene = renderer.scene
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            mujoco.mjtGeom.mjGEOM_SPHERE,
            np.full(3, MARK_RADIUS_M),
            np.asarray(mark_m, float),
            np.eye(3).ravel(),
            np.array(MARK_RGBA, np.float32),
        )
        scene.ngeom += 1
    return renderer.render()


def _look_at(point_m: np.ndarray) -> mujoco.MjvCamera:
    """Return a camera that sees a point by `CLOSE_VIEW`."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = point_m
    camera.distance, azimuth, camera.elevation = CLOSE_VIEW
    camera.azimuth = azimuth + math.degrees(math.atan2(point_m[1], point_m[0]))
    return camera


def _draw_command_bars(
    pen: Any, names: tuple[str, ...], u: np.ndarray, font: Any, height: int
) -> None:
    """Draw one bar per joint in the lower left corner, from the middle to the command."""
    outline = {"stroke_width": 2, "stroke_fill": (40, 40, 40)}
    left = 28 + max(32, *(int(pen.textlength(name, font=font)) for name in names))
    for row, (name, value) in enumerate(zip(names, u, strict=True)):
        y = height - 20 - 24 * (len(names) - row)
        pen.text((16, y - 4), name, fill="white", font=font, **outline)
        pen.rectangle((left, y, left + 140, y + 14), fill=(60, 60, 60))
        middle = left + 70.0
        ends = sorted((middle, middle + 70.0 * float(np.clip(value, -1.0, 1.0))))
        pen.rectangle((ends[0], y + 1, ends[1], y + 13), fill=(250, 170, 10))
