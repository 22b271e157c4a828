"""The machine beside its block in any pose and scene, for pictures and viewers."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import torch

from brokk_rl.machine import Machine
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.scene import COLUMNS, ScenePlacement, build_visual_wall

SHOWN_GROUPS = (0, 1, 2)
"""Geom groups that pictures show; group 3 holds geoms that only collide."""


class PosedScene:
    """One world with all that pictures need, put where it is wanted; nothing is simulated.

    Args:
        machine: The machine.
        site: MJCF of what stands beside the block.

    Attributes:
        model: MuJoCo's model with the geoms, cameras and lights that only pictures need.
        data: Its state after the last `set_pose`.
    """

    def __init__(self, machine: Machine, site: Path | None = None) -> None:
        self.model = compile_model(machine, machine.period_s, visual=True, site=site)
        self.data = mujoco.MjData(self.model)
        self._placement = ScenePlacement(self.model, "cpu", torch.float64)

    def set_pose(self, q: np.ndarray, scene: np.ndarray) -> None:
        """Put the machine at `q`, shape `(J,)`, beside the block of `scene`, shape `(S,)`."""
        self.set_scene(scene)
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)

    def set_scene(self, scene: np.ndarray) -> None:
        """Give the block the shape and the place of `scene`, shape `(S,)`."""
        row = torch.as_tensor(scene, dtype=torch.float64)[None]
        size, pos = self._placement.geoms(row)
        ids = self._placement.geom_ids.numpy()
        self.model.geom_size[ids], self.model.geom_pos[ids] = size[0].numpy(), pos[0].numpy()
        wall = build_visual_wall(float(scene[COLUMNS.index("hole_radius_m")]))
        ids = [self.model.geom(name).id for name in wall.names]
        self.model.geom_size[ids], self.model.geom_pos[ids] = wall.size, wall.pos
        position, turn = self._placement.pose(row)
        self.data.mocap_pos[0], self.data.mocap_quat[0] = position[0].numpy(), turn[0].numpy()

    @property
    def block_geoms(self) -> list[int]:
        """Shown geoms of the block."""
        is_block = self.model.geom_bodyid == self.model.body("block").id
        is_shown = np.isin(self.model.geom_group, SHOWN_GROUPS)
        return np.flatnonzero(is_block & is_shown).tolist()

    def locate_bodies(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places `(N, bodies, 3)` and turns `(N, bodies, 3, 3)` at positions `(N, J)`."""
        places, turns = [], []
        for row in q:
            self.data.qpos[:] = row
            mujoco.mj_kinematics(self.model, self.data)
            places.append(self.data.xpos.copy())
            turns.append(self.data.xmat.reshape(-1, 3, 3).copy())
        return np.array(places), np.array(turns)
