"""The simulated machines in the browser's scene: arms, blocks, targets, and the handle to drag."""

from __future__ import annotations

import math

import numpy as np
import viser
from mjviser import ViserMujocoScene
from mjviser.conversions import merge_geoms

from brokk_rl.machine import Machine
from brokk_rl.play.session import PlayState
from brokk_rl.sim.posed_scene import PosedScene
from brokk_rl.sim.scene import FAR_M

SPACING_M = (9.0, 6.5)
"""Distance of neighbouring worlds along x and y. Chosen by hand: arms of two do not meet."""
TRUE, SEEN = (230, 90, 40), (40, 120, 220)
"""Colours of the true target and of the policy's estimate."""
CAMERA_M, LOOK_AT_M = (4.9, -5.4, 3.3), (1.3, 0.0, 0.8)
"""Place of the camera and what it looks at, for one world. Chosen by hand for the eye."""
MARK_M = 0.05
"""Diameter of the mark at a target, m. Chosen by hand for the eye."""


class SceneView:
    """Everything in the scene; mjviser draws a link of all worlds at once.

    Args:
        server: Browser's server.
        machine: The machine.
        num_worlds: Worlds that are drawn.
        can_move: Whether the target has a handle.
    """

    def __init__(
        self, server: viser.ViserServer, machine: Machine, num_worlds: int, can_move: bool
    ) -> None:
        self._server, self._num_worlds = server, num_worlds
        self._posed = PosedScene(machine)
        self._offsets = place_worlds(num_worlds)
        self._blocks: dict[int, tuple[np.ndarray, viser.GlbHandle]] = {}
        self.is_dragged = False
        model = self._posed.model
        # mjviser draws once what is welded to the ground; a base stands in every world.
        model.body_weldid[1:] = np.arange(1, model.nbody)
        # Blocks differ between worlds and are drawn one by one: the shared one is transparent.
        model.geom_rgba[self._posed.block_geoms, 3] = 0.0
        self._machines = ViserMujocoScene(server, model, num_worlds)
        self._machines.camera_tracking_enabled = False
        model.geom_rgba[self._posed.block_geoms, 3] = 1.0
        self._set_up_stage()
        self._marks = {}
        for name, color in (("target", TRUE), ("estimate", SEEN)):
            self._marks[name] = server.scene.add_point_cloud(
                f"/{name}",
                self._offsets.astype(np.float32),
                color,
                point_size=MARK_M,
                point_shape="circle",
                precision="float32",
                visible=False,
            )
        self.handle: viser.TransformControlsHandle | None = None
        if can_move:
            self.handle = server.scene.add_transform_controls(
                "/hole", scale=0.55, disable_rotations=True, depth_test=False, opacity=0.85
            )

    def draw(self, state: PlayState, selected: int) -> None:
        """Show a state; the handle is at the target of the `selected` world."""
        places, turns = self._posed.locate_bodies(state.q[: self._num_worlds])
        self._machines.update_from_arrays(places + self._offsets[:, None], turns)
        for name, points in (("target", state.target_m), ("estimate", state.estimate_m)):
            mark = self._marks[name]
            mark.visible = points is not None
            if points is not None:
                mark.points = (points[: self._num_worlds] + self._offsets).astype(np.float32)
        if state.scene is not None:
            for world, scene in enumerate(state.scene[: self._num_worlds]):
                self._draw_block(world, scene)
        if self.handle is not None and state.target_m is not None and not self.is_dragged:
            offset = self._offsets[min(selected, self._num_worlds - 1)]
            self.handle.position = tuple(state.target_m[selected] + offset)

    def read_handle(self, world: int) -> np.ndarray:
        """Return the place of the handle in the base frame of a world, `(3,)`."""
        assert self.handle is not None
        return np.asarray(self.handle.position, float) - self._offsets[world]

    def _set_up_stage(self) -> None:
        """Set light, ground and camera."""
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.configure_environment_map("park", environment_intensity=0.9)
        scene.add_grid("/ground", width=60.0, height=60.0, plane_opacity=1.0, shadow_opacity=0.35)
        camera = self._server.initial_camera
        middle, extent = self._offsets.mean(0), np.ptp(self._offsets, axis=0)
        away = 1.0 + float(np.hypot(*extent[:2])) / 9.0
        camera.position = tuple(np.array(CAMERA_M) * away + middle)
        camera.look_at = tuple(np.array(LOOK_AT_M) + middle)
        camera.fov = math.radians(50.0)

    def _draw_block(self, world: int, scene: np.ndarray) -> None:
        """Put the block of a world in its place; its shape is sent anew only where it differs."""
        before, handle = self._blocks.get(world, (None, None))
        if before is not None and np.array_equal(before, scene):
            return
        if handle is None or before is None or not np.array_equal(before[4:], scene[4:]):
            self._posed.set_scene(scene)
            mesh = merge_geoms(self._posed.model, self._posed.block_geoms)
            handle = self._server.scene.add_mesh_trimesh(f"/block/{world}", mesh)
        x, y, rim_z, yaw = scene[:4]
        handle.position = tuple(np.array([x, y, rim_z]) + self._offsets[world])
        handle.wxyz = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        handle.visible = math.hypot(x, y) < FAR_M
        self._blocks[world] = scene.copy(), handle


def place_worlds(num_worlds: int) -> np.ndarray:
    """Return the place of each world in the scene, `(N, 3)`: rows along x, the first at the origin."""
    columns = math.ceil(math.sqrt(num_worlds))
    index = np.arange(num_worlds)
    x_m, y_m = index // columns * -SPACING_M[0], index % columns * SPACING_M[1]
    return np.stack((x_m, y_m, np.zeros(num_worlds)), 1)
