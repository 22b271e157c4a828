"""The simulated machines in the browser's scene: arms, blocks, targets, and the handle to drag."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import trimesh
import viser

from brokk_rl.machine import Machine
from brokk_rl.play.session import PlayState
from brokk_rl.sim.scene import FAR_M
from brokk_rl.sim.shapes import MachineMesh, build_drilled_block

SPACING_M = (9.0, 6.5)
"""Distance of neighbouring worlds along x and y. Chosen by hand: arms of two do not meet."""
CONCRETE, HOLE, TRUE, SEEN = ((186, 184, 178), (52, 50, 48), (230, 90, 40), (40, 120, 220))
"""Colours of the block, its hole's bottom, the true target, and the policy's estimate."""
CAMERA_M, LOOK_AT_M = (4.9, -5.4, 3.3), (1.3, 0.0, 0.8)
"""Place of the camera and what it looks at, for one world. Chosen by hand for the eye."""
MARK_M = 0.025
"""Radius of the ball at a target, m. Chosen by hand for the eye."""


class SceneView:
    """Everything in the scene; one batch of triangles draws a link of all worlds.

    Args:
        server: Browser's server.
        machine: The machine.
        num_worlds: Worlds that are drawn.
        can_move: Whether the target has a handle.
    """

    def __init__(
        self, server: viser.ViserServer, machine: Machine, num_worlds: int, can_move: bool
    ) -> None:
        self._server, self._num = server, num_worlds
        self._machine_mesh = MachineMesh(machine)
        self._offsets = place_worlds(num_worlds)
        self._links: list[tuple[int, Any]] = []
        self._blocks: dict[int, tuple[tuple[float, float], Any]] = {}
        self._dragging = False
        self._set_up_stage()
        still = np.tile((1.0, 0.0, 0.0, 0.0), (num_worlds, 1))
        for number, shape in enumerate(self._machine_mesh.shapes):
            handle = server.scene.add_batched_meshes_simple(
                f"/machine/{number}",
                shape.vertices,
                shape.faces,
                still,
                self._offsets,
                batched_colors=np.array(shape.color),
                lod="off",
            )
            self._links.append((shape.body, handle))
        self._marks = {
            name: server.scene.add_batched_meshes_trimesh(
                f"/{name}", _make_ball(color), still, self._offsets, lod="off", visible=False
            )
            for name, color in (("target", TRUE), ("estimate", SEEN))
        }
        self.handle = (
            server.scene.add_transform_controls(
                "/hole",
                scale=0.55,
                disable_rotations=True,
                depth_test=False,
                opacity=0.85,
                position=tuple(self._offsets[0]),
            )
            if can_move
            else None
        )

    def draw(self, state: PlayState) -> None:
        """Show a state."""
        offsets = self._offsets
        positions, turns = self._machine_mesh.compute_poses(state.q[: self._num])
        for body, link in self._links:
            if self._machine_mesh.is_moving(body):
                link.batched_positions = (positions[:, body] + offsets).astype(np.float32)
                link.batched_wxyzs = turns[:, body].astype(np.float32)
        for name, points in (("target", state.target_m), ("estimate", state.estimate_m)):
            mark = self._marks[name]
            mark.visible = points is not None
            if points is not None:
                mark.batched_positions = (points[: self._num] + offsets).astype(np.float32)
        if state.scene is not None:
            for index, row in enumerate(state.scene[: self._num]):
                self._draw_block(index, row)
        if self.handle is not None and state.target_m is not None and not self._dragging:
            place = tuple(
                state.target_m[state.selected] + offsets[min(state.selected, self._num - 1)]
            )
            if not np.allclose(place, self.handle.position, atol=1e-4):
                self.handle.position = place

    def hold_handle(self, held: bool) -> None:
        """Set whether a person drags the handle; the program does not move it meanwhile."""
        self._dragging = held

    def read_handle(self, world: int) -> np.ndarray:
        """Return the place of the handle in the base frame of a world, `(3,)`."""
        assert self.handle is not None
        return np.asarray(self.handle.position, float) - self._offsets[world]

    def _set_up_stage(self) -> None:
        """Set light, ground and camera."""
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.configure_environment_map("park", environment_intensity=0.9)
        extent = np.ptp(self._offsets, axis=0)
        scene.add_grid(
            "/ground",
            width=60.0,
            height=60.0,
            cell_size=0.5,
            section_size=1.0,
            cell_color=(196, 192, 186),
            section_color=(178, 173, 166),
            plane_color=(214, 210, 203),
            plane_opacity=1.0,
            shadow_opacity=0.35,
            fade_distance=45.0,
            position=(0.0, 0.0, -0.002),
        )
        camera = self._server.initial_camera
        middle = self._offsets.mean(0)
        away = 1.0 + float(np.hypot(*extent[:2])) / 9.0
        camera.position = tuple(np.array(CAMERA_M) * away + middle)
        camera.look_at = tuple(np.array(LOOK_AT_M) + middle)
        camera.fov = math.radians(50.0)

    def _draw_block(self, world: int, scene: np.ndarray) -> None:
        """Put the block of a world in its place; its shape is sent anew only where it differs."""
        x, y, rim_z, yaw, scale, radius = scene
        near = float(np.hypot(x, y)) < FAR_M
        key = (round(float(scale), 4), round(float(radius), 4))
        if not near:
            if world in self._blocks:
                self._blocks[world][1].visible = False
            return
        place = tuple(np.array([x, y, rim_z]) + self._offsets[world])
        turn = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        if world not in self._blocks or self._blocks[world][0] != key:
            vertices, faces = build_drilled_block(float(scale), float(radius))
            handle = self._server.scene.add_mesh_simple(
                f"/block/{world}",
                vertices.astype(np.float32),
                faces.astype(np.uint32),
                color=CONCRETE,
                side="double",
                position=place,
                wxyz=turn,
            )
            self._blocks[world] = key, handle
        handle = self._blocks[world][1]
        handle.visible = True
        if not np.allclose(handle.position, place, atol=1e-5):
            handle.position, handle.wxyz = place, turn


def place_worlds(num_worlds: int) -> np.ndarray:
    """Return the place of each world in the scene, `(N, 3)`: rows along x, the first at the origin."""
    columns = math.ceil(math.sqrt(num_worlds))
    index = np.arange(num_worlds)
    places = np.zeros((num_worlds, 3))
    places[:, 0] = index // columns * -SPACING_M[0]
    places[:, 1] = index % columns * SPACING_M[1]
    return places


def _make_ball(color: tuple[int, int, int]) -> Any:
    ball: Any = trimesh.creation.icosphere(3, MARK_M)
    ball.visual.vertex_colors = np.tile((*color, 255), (len(ball.vertices), 1))
    return ball
