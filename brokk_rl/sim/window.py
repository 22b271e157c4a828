"""MuJoCo's own window with one world, on a computer with a display."""

from __future__ import annotations

import os
from collections.abc import Callable

import mujoco
import numpy as np

from brokk_rl.errors import DeviceError
from brokk_rl.machine import Machine
from brokk_rl.sim.posed_scene import SHOWN_GROUPS, PosedScene

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
"""Variables of which one is set where a window can be opened on Linux."""


def require_display(variables: tuple[str, ...] = DISPLAYS) -> None:
    """Raise an error where no window can be opened.

    Raises:
        DeviceError: None of `variables` is set.
    """
    if not any(os.environ.get(name) for name in variables):
        raise DeviceError(
            f"play.viewer=window needs a display, but {' and '.join(variables)} are not set. Use "
            "play.viewer=browser; from another computer: ssh -L 8080:localhost:8080 <this computer>"
        )


class SceneWindow:
    """A window that shows what it is given; the mouse turns the view and pulls at bodies.

    Args:
        machine: The machine.
        on_key: Called with the GLFW code of each key, in a thread of the window's own.
    """

    def __init__(self, machine: Machine, on_key: Callable[[int], None]) -> None:
        from mujoco import viewer

        self._posed = PosedScene(machine)
        self._window = viewer.launch_passive(
            self._posed.model,
            self._posed.data,
            key_callback=on_key,
            show_left_ui=False,
            show_right_ui=False,
        )
        self._window.opt.geomgroup[:] = [group in SHOWN_GROUPS for group in range(6)]
        self._window.opt.sitegroup[:] = 0

    @property
    def is_open(self) -> bool:
        """False once the person has closed it."""
        return self._window.is_running()

    def draw(self, q: np.ndarray, scene: np.ndarray | None, text: str) -> None:
        """Show the machine at `q`, `(J,)`, beside the block of `scene`, `(S,)`, and a line of text."""
        with self._window.lock():
            if scene is None:
                self._posed.data.qpos[:] = q
                mujoco.mj_kinematics(self._posed.model, self._posed.data)
            else:
                self._posed.set_pose(q, scene)
            mujoco.mj_comPos(self._posed.model, self._posed.data)
            mujoco.mj_camlight(self._posed.model, self._posed.data)
        place = mujoco.mjtGridPos.mjGRID_TOPLEFT
        self._window.set_texts((mujoco.mjtFontScale.mjFONTSCALE_150, place, text, ""))
        self._window.sync()

    def read_pull(self) -> np.ndarray:
        """Return the load on each joint, `(J,)`, by which the mouse pulls at a body."""
        model, data = self._posed.model, self._posed.data
        with self._window.lock():
            data.xfrc_applied[:] = 0.0
            mujoco.mjv_applyPerturbForce(model, data, self._window.perturb)
            return compute_joint_load(model, data)

    def close(self) -> None:
        """Close it."""
        self._window.close()


def compute_joint_load(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the load on each joint, `(J,)`, of the forces on bodies in `data.xfrc_applied`."""
    load = np.zeros(model.nv)
    for body in np.flatnonzero(data.xfrc_applied.any(1)):
        force = data.xfrc_applied[body]
        mujoco.mj_applyFT(model, data, force[:3], force[3:], data.xipos[body], int(body), load)
    return load
