"""Pictures of a world with MuJoCo's renderer, for videos, stills and synthetic camera frames."""

from __future__ import annotations

from types import TracebackType

import mujoco
import numpy as np
import torch

from brokk_rl.machine import Machine
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.scene import Placement, drilled_wall

_SHOWN_GROUPS = (0, 1, 2)


class Painter:
    """Draws one world in any pose and scene; a context manager.

    Needs a GL library: set `MUJOCO_GL` before MuJoCo is imported for the first time
    (`sim.probe.working_renderer` says to what).

    Args:
        machine: The machine.
        width: Width of the largest picture, pixels.
        height: Height of the largest picture, pixels.
    """

    def __init__(self, machine: Machine, width: int, height: int) -> None:
        self.model = compile_model(machine, machine.period_s, visual=True)
        self.data = mujoco.MjData(self.model)
        self._placement = Placement(self.model, "cpu", torch.float64)
        self._size = (height, width)
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [group in _SHOWN_GROUPS for group in range(6)]
        self._option.sitegroup[:] = 0

    def __enter__(self) -> Painter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for renderer in self._renderers.values():
            renderer.close()

    def pose(self, q: np.ndarray, scene: np.ndarray) -> None:
        """Puts the machine at `q`, shape `(J,)`, beside the block of `scene`, shape `(S,)`."""
        row = torch.as_tensor(scene, dtype=torch.float64)[None]
        size, pos = self._placement.geoms(row)
        ids = self._placement.geom_ids.numpy()
        self.model.geom_size[ids], self.model.geom_pos[ids] = size[0].numpy(), pos[0].numpy()
        wall = drilled_wall(float(scene[5]))
        ids = [self.model.geom(name).id for name in wall.names]
        self.model.geom_size[ids], self.model.geom_pos[ids] = wall.size, wall.pos
        position, turn = self._placement.pose(row)
        self.data.qpos[:] = q
        self.data.mocap_pos[0], self.data.mocap_quat[0] = position[0].numpy(), turn[0].numpy()
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def picture(self, camera: str, width: int, height: int) -> np.ndarray:
        """Returns what `camera` sees, shape `(height, width, 3)` uint8."""
        return self._renderer(camera, width, height).render()

    def depth_m(self, camera: str, width: int, height: int) -> np.ndarray:
        """Returns the distance of each pixel along the optical axis, shape `(height, width)` float32, m."""
        renderer = self._renderer(camera, width, height)
        renderer.enable_depth_rendering()
        try:
            return renderer.render()
        finally:
            renderer.disable_depth_rendering()

    def _renderer(self, camera: str, width: int, height: int) -> mujoco.Renderer:
        key = (height, width)
        if key not in self._renderers:
            self._renderers[key] = mujoco.Renderer(self.model, height, width)
        self._renderers[key].update_scene(self.data, camera, self._option)
        return self._renderers[key]
