"""Probes of MuJoCo and Warp on this computer; each returns text or raises an exception."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile

log = logging.getLogger(__name__)

RENDERERS = ("egl", "osmesa", "glfw")
"""Values of MUJOCO_GL, in the order in which they are worth trying without a screen."""
ASKED = "BROKK_MUJOCO_GL"
"""Variable that keeps the MUJOCO_GL of the shell for the processes that draw."""


def keep_renderer_for_drawing() -> None:
    """Take MUJOCO_GL from this process and keep its value for the processes that draw.

    MuJoCo loads the library at import and fails where it is missing or unknown, though only
    processes of their own draw here.
    """
    if name := os.environ.pop("MUJOCO_GL", None):
        os.environ[ASKED] = name


def capture_graph() -> str:
    """Capture a small Warp copy on the first GPU in a CUDA graph and replay it.

    Needs no compiled kernel.

    Raises:
        RuntimeError: The graph cannot be captured or does not do its work.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR  # the doctor reports the GPU itself
    wp.init()
    source, copy = (wp.full(8, value, dtype=float, device="cuda:0") for value in (1.0, 0.0))
    with wp.ScopedCapture(device="cuda:0") as capture:
        wp.copy(copy, source)
    source.fill_(2.0)
    assert capture.graph is not None, "it was captured above"
    wp.capture_launch(capture.graph)
    if float(copy.numpy()[0]) != 2.0:
        raise RuntimeError("a captured graph replays, but the copy in it did not happen")
    return str(wp.get_device("cuda:0").name)


def find_renderer() -> str | None:
    """Return the first value of MUJOCO_GL that can draw a picture here, `None` when there is none.

    A value that the shell asked for is tried first.

    MuJoCo settles on one library at import and a broken driver may end the process, so each try has
    a process of its own.
    """
    chosen = os.environ.get(ASKED) or os.environ.get("MUJOCO_GL")
    program = "from brokk_rl.sim.probe import render_test_picture; render_test_picture()"
    for name in dict.fromkeys((chosen, *RENDERERS) if chosen else RENDERERS):
        environment = os.environ | {
            "MUJOCO_GL": name,
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        try:
            with tempfile.TemporaryDirectory() as folder:  # MuJoCo writes its log where it runs
                done = subprocess.run(
                    [sys.executable, "-c", program],
                    env=environment,
                    cwd=folder,
                    capture_output=True,
                    timeout=60,
                )
        except subprocess.TimeoutExpired:
            continue
        if done.returncode == 0:
            if chosen and name != chosen:
                log.warning("MUJOCO_GL=%s cannot draw here; MuJoCo draws with %s", chosen, name)
            return name
    return None


def render_test_picture() -> None:
    """Draw a ball in a picture of 32 x 32 pixels.

    Raises:
        RuntimeError: The picture is black.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 32, 32) as renderer:
        renderer.update_scene(data)
        if renderer.render().max() == 0:
            raise RuntimeError("the picture is black")
