"""The simulator as a source of frames: the present scene of the task, seen by a rendered camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.kinematics import rotate_about_axis
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, Positive, spec
from perception.mount.mounts import ArmShape
from perception.render.drilled_block import FRONT, DrilledBlock, DrilledHole
from perception.render.frame_renderer import FrameRenderer, RenderedFrame
from perception.render.scene_ranges import BlockSampler, Scene, SceneRanges, view_from
from perception.render.scene_sampler import SceneSampler
from perception.render.solids import SolidPose, build_rods
from perception.render.stereo_camera import StereoRig
from perception.segment.window import Window
from perception.stereo import Stereo


@spec
class SimulatedCamera:
    """Render the scene of the borehole task.

    Attributes:
        rig: Camera pair.
        surroundings: Concrete, light, dust and ground; the block itself is that of the task.
        stereo: Computes the depth.
        task_scene: The scene: `hole_x_m hole_y_m rim_z_m yaw_rad block_scale
            hole_radius_m`, as in the task.
        block_m: Length, width and height of a block of scale 1.
        hole_depth_m: Depth of the hole.
        arm: Thickness of the arm.
        num_frames: Number of frames.
        rate_hz: Frame rate; gives frame `k` the time k / rate_hz.
        seed: Seed of stains and light, which stay the same, and of noise, which does not.
    """

    rig: StereoRig
    surroundings: SceneRanges
    stereo: Stereo
    task_scene: tuple[float, float, float, float, float, float]
    block_m: tuple[Positive, Positive, Positive]
    hole_depth_m: Positive
    arm: ArmShape
    num_frames: Count
    rate_hz: Positive
    seed: int

    def check(self) -> None:
        if self.hole_depth_m >= self.block_m[2]:
            raise ConfigError(
                f"hole_depth_m: a hole of {self.hole_depth_m} m does not fit into a block "
                f"{self.block_m[2]} m high"
            )

    def build(self) -> SimulatedSource:
        """Return the source, not yet opened."""
        return SimulatedSource(self)

    def shoot(
        self,
        task_scene: Sequence[float],
        chain_in_base_m: np.ndarray,
        noise: np.random.Generator,
        pose: np.ndarray | None = None,
        part: Window | None = None,
    ) -> RenderedFrame:
        """Return a frame of a scene, with its truth.

        Args:
            task_scene: See `task_scene` above; after it may stand how far the block leans, rad, as in
                the task.
            chain_in_base_m: The arm as points in the base frame, `(P, 3)`: its joints in order,
                then the tip of the tool (`brokk_rl.kinematics`); empty for none.
            noise: Noise of the pictures.
            pose: Another pose of the left camera in the base frame, `(4, 4)`; `None`: the rig's own.
            part: The part of the picture that is read out; `None` for all of it.
        """
        scene = self.compose(task_scene, chain_in_base_m)
        if pose is not None:
            scene = view_from(scene, np.linalg.inv(pose) @ self.rig.base_from_camera)
        studio = FrameRenderer(
            rig=self.rig, scene=self.surroundings, stereo=self.stereo, depth="matched", pair=True
        )
        return studio.shot(scene, noise, part)

    def compose(self, task_scene: Sequence[float], chain_in_base_m: np.ndarray) -> Scene:
        """Return a scene in the coordinates of the rig's own camera; see `shoot`."""
        kind = self.surroundings
        chance = np.random.default_rng(self.seed)  # the same stains and light for every frame
        x, y, z, yaw, scale, radius_m = task_scene[:6]
        lean_rad = task_scene[6] if len(task_scene) > 6 else 0.0
        from_base = np.linalg.inv(self.rig.base_from_camera)
        target = from_base[:3, :3] @ [x, y, z] + from_base[:3, 3]
        if target[2] < 0.2:
            raise FrameError(
                f"simulated camera: the hole at {tuple(task_scene[:3])} m in the base frame is behind the "
                "camera"
            )
        half = np.array(self.block_m) / 2 * [scale, scale, 1.0]
        # The block turns about its own axis, then leans away from the slew axis.
        across = np.array([-y, x, 0.0]) / max(float(np.hypot(x, y)), 1e-6)
        turn = rotate_about_axis(across, np.array(lean_rad))
        turn = turn @ rotate_about_axis(np.array([0.0, 0.0, 1.0]), np.array(yaw))
        rotation = from_base[:3, :3] @ turn
        hole = DrilledHole(np.array([0.0, 0.0, half[2]]), radius_m, self.hole_depth_m, FRONT)
        pose = SolidPose(rotation, target - rotation @ hole.center_m)
        materials = BlockSampler(kind.block, chance).draw_materials(half, (hole,), ())
        block = DrilledBlock("block", pose, half, materials, (hole,))
        points_m = chain_in_base_m @ from_base[:3, :3].T + from_base[:3, 3]
        down_m = float((from_base[:3, 3]) @ self.rig.down_in_camera)
        rods = build_rods(points_m, self.arm.link_m, self.arm.tool_m)
        sampler = SceneSampler(kind, self.rig, chance)
        return sampler.surround(block, rods, target, rotation[:, 2], max(down_m, 0.3))


class SimulatedSource:
    """An open simulated camera; see `brokk_rl.contracts.vision.FrameSource`."""

    def __init__(self, settings: SimulatedCamera) -> None:
        self._settings, self._count = settings, -1
        self.num_frames = settings.num_frames

    def __enter__(self) -> SimulatedSource:
        self._count = 0
        return self

    def __exit__(self, *exc: Any) -> None:
        self._count = -1

    def read_latest(self) -> Frame | None:
        """Return a frame of the configured scene, `None` after `num_frames`.

        Raises:
            FrameError: the source is not open, or the hole is behind the camera.
        """
        s, number = self._settings, self._count
        if number < 0:
            raise FrameError("simulated camera: not open; use it in a `with` block")
        if number >= self.num_frames:
            return None
        self._count += 1
        noise = np.random.default_rng((s.seed, number))
        shot = s.shoot(s.task_scene, np.zeros((0, 3)), noise)
        pictures = (shot.color, shot.depth_m, number / s.rate_hz, shot.right)
        return s.rig.model.build_frame(*pictures, depth_shrink=s.stereo.shrink)
