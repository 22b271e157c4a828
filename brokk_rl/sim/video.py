"""A video and stills of a recorded episode: MuJoCo's renderer where there is a GL library, else a drawn side and top view."""

from __future__ import annotations

import logging
import math
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from brokk_rl.errors import StorageError
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.sim.probe import working_renderer

log = logging.getLogger(__name__)

MAX_FRAMES = 200
"""More frames than this are thinned out: a CPU draws some five pictures a second."""
SIZE = (1200, 540)
CLOSE_WIDTH = 380
"""Width of the close-up at the right, pixels."""
FAR_M = 10.0
"""A block farther away than this is not part of the task."""
NUM_STILLS = 3
_TIMEOUT_S = 600


class Motion(Protocol):
    """What is shown: an episode of `T` control steps."""

    @property
    def q(self) -> np.ndarray:
        """Joint positions, `(T, J)`, rad or m."""
        ...

    @property
    def u(self) -> np.ndarray:
        """Commands, `(T, J)`, in [-1, 1]."""
        ...

    @property
    def force_n(self) -> np.ndarray:
        """Peak contact force of each step, `(T,)`."""
        ...

    @property
    def scene(self) -> np.ndarray:
        """The scene, `(S,)`; see `sim.scene`."""
        ...


def render_video(machine: Machine, motion: Motion, path: Path) -> Path:
    """Writes an mp4 to `path` and stills beside it (`<stem>_0.png` is the start, the last one the end).

    The renderer runs in a process of its own: GL drivers can end the process, and MuJoCo settles on
    one when it is imported.

    Returns:
        `path`.

    Raises:
        StorageError: The files cannot be written.
    """
    arrays = {name: np.asarray(getattr(motion, name)) for name in ("q", "u", "force_n", "scene")}
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "video.mp4"
        if not _painted(machine, arrays, draft):
            from brokk_rl.sim.schematic_video import frames

            write(draft, frames(machine, arrays, SIZE), len(arrays["q"]), machine.period_s)
        try:
            for file in sorted(draft.parent.glob("video*.[mp][pn]*")):
                shutil.copyfile(file, path.with_name(file.name.replace("video", path.stem, 1)))
        except OSError as error:
            raise StorageError(f"the video could not be written to {path}: {error}") from error
    return path


def _painted(machine: Machine, arrays: dict[str, np.ndarray], draft: Path) -> bool:
    """Tries MuJoCo's renderer in a process of its own; returns whether it drew everything."""
    library = working_renderer()
    if library is None:
        log.warning(
            "no GL library works here, so the video is a drawing; for pictures install libegl1 (see `brokk mode=doctor`)"
        )
        return False
    job = draft.with_suffix(".job")
    job.write_bytes(pickle.dumps((machine, arrays, draft)))
    environment = os.environ | {
        "MUJOCO_GL": library,
        "PYTHONPATH": os.pathsep.join(part for part in sys.path if part),
    }
    program = "import sys; from brokk_rl.sim.video import paint; paint(sys.argv[1])"
    try:
        done = subprocess.run(
            [sys.executable, "-c", program, str(job)],
            env=environment,
            cwd=draft.parent,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        log.warning("MuJoCo's renderer took more than %d s, so the video is a drawing", _TIMEOUT_S)
        return False
    if done.returncode:
        log.warning(
            "MuJoCo's renderer failed with MUJOCO_GL=%s, so the video is a drawing: %s",
            library,
            done.stderr.strip()[-500:],
        )
    return done.returncode == 0


def paint(job: str) -> None:
    """Draws the job that `render_video` has left in the file `job`; runs in a process of its own."""
    machine, arrays, draft = pickle.loads(Path(job).read_bytes())
    write(draft, _pictures(machine, arrays), len(arrays["q"]), machine.period_s)


def _pictures(
    machine: Machine, arrays: dict[str, np.ndarray]
) -> Callable[[Iterable[int]], Iterator[np.ndarray]]:
    """Returns what draws the given steps: the overview, the borehole close up, and the commands."""
    from PIL import Image, ImageDraw, ImageFont

    from brokk_rl.sim.renderer import Painter

    lines, font, (width, height) = captions(machine, arrays), ImageFont.load_default(18), SIZE
    split = width - CLOSE_WIDTH

    def draw(steps: Iterable[int]) -> Iterator[np.ndarray]:
        with Painter(machine, width, height) as painter:
            for step in steps:
                painter.pose(arrays["q"][step], arrays["scene"])
                views = (
                    painter.picture("overview", split, height),
                    painter.picture("close", CLOSE_WIDTH, height),
                )
                picture = Image.fromarray(np.concatenate(views, axis=1))
                pen = ImageDraw.Draw(picture)
                pen.rectangle((split - 1, 0, split + 1, height), fill="white")
                pen.text(
                    (16, 12),
                    lines[step],
                    fill="white",
                    font=font,
                    stroke_width=2,
                    stroke_fill=(40, 40, 40),
                )
                _bars(pen, machine.joint_names, arrays["u"][step], font, height)
                yield np.asarray(picture)

    return draw


def _bars(pen, names: tuple[str, ...], u: np.ndarray, font, height: int) -> None:
    """Draws one bar per joint in the lower left corner, from the middle to the command."""
    for row, (name, value) in enumerate(zip(names, u, strict=True)):
        y = height - 20 - 24 * (len(names) - row)
        pen.text(
            (16, y - 4), name, fill="white", font=font, stroke_width=2, stroke_fill=(40, 40, 40)
        )
        pen.rectangle((60, y, 200, y + 14), fill=(60, 60, 60))
        ends = sorted((130.0, 130.0 + 70.0 * float(np.clip(value, -1.0, 1.0))))
        pen.rectangle((ends[0], y + 1, ends[1], y + 13), fill=(250, 170, 10))


def captions(machine: Machine, arrays: dict[str, np.ndarray]) -> list[str]:
    """Returns a line for each step: time, where the tip is relative to the rim (unless the block is far away), and force."""
    tip = (
        Kinematics(machine)
        .pose(torch.as_tensor(arrays["q"], dtype=torch.float32))
        .tip_in_base_m.numpy()
        - arrays["scene"][:3]
    )
    concerned = float(np.hypot(*arrays["scene"][:2])) < FAR_M
    lines = []
    for step, ((x, y, z), force) in enumerate(zip(tip, arrays["force_n"], strict=True)):
        side = "above" if z > 0 else "below"
        where = (
            f"{100 * abs(z):4.0f} cm {side} the rim, {100 * math.hypot(x, y):5.1f} cm off axis    "
            if concerned
            else ""
        )
        lines.append(f"{step * machine.period_s:5.1f} s    {where}{force:6.0f} N")
    return lines


def write(
    path: Path,
    draw: Callable[[Iterable[int]], Iterator[np.ndarray]],
    num_steps: int,
    period_s: float,
) -> None:
    """Writes an mp4 and stills.

    Args:
        path: The mp4; stills lie beside it as `<stem>_<i>.png`.
        draw: Yields a picture `(height, width, 3)` uint8 for each of the given steps.
        num_steps: `T`.
        period_s: Time from step to step.
    """
    import imageio.v2 as imageio
    import imageio_ffmpeg

    stride = max(1, math.ceil(num_steps / MAX_FRAMES))
    steps = sorted({*range(0, num_steps, stride), num_steps - 1})
    chosen = {round(i * (len(steps) - 1) / (NUM_STILLS - 1)): i for i in range(NUM_STILLS)}
    rate_hz = 1.0 / (period_s * stride)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        SIZE,
        fps=rate_hz,  # pyright: ignore[reportArgumentType]
        quality=7,
        macro_block_size=4,
    )
    writer.send(None)
    try:
        for count, picture in enumerate(draw(steps)):
            writer.send(np.ascontiguousarray(picture))
            if count in chosen:
                imageio.imwrite(path.with_name(f"{path.stem}_{chosen[count]}.png"), picture)
    finally:
        writer.close()
