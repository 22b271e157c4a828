"""The simulator as a source of frames: the present scene of the task, seen by a rendered camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, Positive, spec
from perception.render.block_sampler import draw_block_materials
from perception.render.drilled_block import FRONT, DrilledBlock, DrilledHole
from perception.render.frame_renderer import FrameRenderer, RenderedFrame
from perception.render.scene_ranges import Scene, SceneRanges, view_from
from perception.render.scene_sampler import add_surroundings
from perception.render.solids import SolidPose, build_rods
from perception.render.stereo_camera import StereoRig
from perception.stereo import Stereo


def make_frame(shot: RenderedFrame, rig: StereoRig, t_s: float) -> Frame:
    """Return the frame of a camera for a rendered one: pictures, depth and the camera's pose."""
    return Frame(
        color=shot.color, depth_m=shot.depth_m, camera_matrix=rig.left.matrix, base_from_camera=rig.base_from_camera,
        t_s=t_s, right=shot.right, baseline_m=rig.baseline_m, disparity_std_px=rig.disparity_std_px,
        gamma=rig.sensor.usual_gamma,
    )  # fmt: skip


@spec
class SimulatedCamera:
    """Render the scene of the borehole task.

    Attributes:
        rig: Camera pair.
        surroundings: Concrete, light, dust and ground; the block itself is that of the task.
        stereo: Computes the depth.
        task_scene: Scene before the first `show`: `hole_x_m hole_y_m rim_z_m yaw_rad block_scale
            hole_radius_m`, as in the task.
        block_m: Length, width and height of a block of scale 1.
        hole_depth_m: Depth of the hole.
        arm_m: Radius of the arm's links and of the tool.
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
    arm_m: tuple[Positive, Positive]
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


class SimulatedSource:
    """An open simulated camera; see `brokk_rl.contracts.vision.FrameSource`.

    The simulation calls `show` before each `read_latest`.
    """

    def __init__(self, settings: SimulatedCamera) -> None:
        self._settings = settings
        self._scene: tuple[float, ...] = settings.task_scene
        self._chain = np.zeros((0, 3))
        self._count = -1

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self._settings.num_frames

    def __enter__(self) -> SimulatedSource:
        self._count = 0
        return self

    def __exit__(self, *exc: Any) -> None:
        self._count = -1

    def show(self, task_scene: Sequence[float], chain_in_base_m: np.ndarray) -> None:
        """Set the scene.

        Args:
            task_scene: See `Simulated.task_scene`.
            chain_in_base_m: The arm as points in the base frame, `(P, 3)`: its joints in order,
                then the tip of the tool (`brokk_rl.kinematics`); empty for none.
        """
        self._scene = tuple(float(value) for value in task_scene)
        self._chain = np.asarray(chain_in_base_m, float).reshape(-1, 3)

    def read_latest(self) -> Frame | None:
        """Return a frame of the present scene, `None` after `num_frames`.

        Raises:
            FrameError: the source is not open, or the hole is behind the camera.
        """
        if self._count < 0:
            raise FrameError("simulated camera: not open; use it in a `with` block")
        if self._count >= self.num_frames:
            return None
        number, rig = self._count, self._settings.rig
        self._count += 1
        shot = self.shot(np.random.default_rng((self._settings.seed, number)))
        frame = make_frame(shot, rig, number / self._settings.rate_hz)
        return replace(frame, depth_shrink=self._settings.stereo.shrink)

    def shot(self, noise: np.random.Generator, rig: StereoRig | None = None) -> RenderedFrame:
        """Return the current frame, with its truth.

        Args:
            noise: Noise of the pictures.
            rig: A rig elsewhere that takes it; `None`: the source's own.
        """
        scene, settings = self.compose(), self._settings
        if rig is not None:
            own = settings.rig.base_from_camera
            scene = view_from(scene, np.linalg.inv(rig.base_from_camera) @ own)
        studio = FrameRenderer(
            rig=rig or settings.rig,
            scene=settings.surroundings,
            stereo=settings.stereo,
            depth="matched",
            pair=True,
        )
        return studio.shot(scene, noise)

    def compose(self) -> Scene:
        """Return the present scene in the coordinates of the source's own camera."""
        settings, kind = self._settings, self._settings.surroundings
        chance = np.random.default_rng(settings.seed)  # the same stains and light for every frame
        x, y, z, yaw, scale, radius_m = self._scene
        from_base = np.linalg.inv(settings.rig.base_from_camera)
        target = from_base[:3, :3] @ [x, y, z] + from_base[:3, 3]
        if target[2] < 0.2:
            raise FrameError(
                f"simulated camera: the hole at {self._scene[:3]} m in the base frame is behind the "
                "camera"
            )
        half = np.array(settings.block_m) / 2 * [scale, scale, 1.0]
        turn = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
        )
        rotation = from_base[:3, :3] @ turn
        hole = DrilledHole(np.array([0.0, 0.0, half[2]]), radius_m, settings.hole_depth_m, FRONT)
        pose = SolidPose(rotation, target - rotation @ hole.center_m)
        block = DrilledBlock(
            pose, half, draw_block_materials(kind.block, half, (hole,), (), chance), (hole,)
        )
        points_m = self._chain @ from_base[:3, :3].T + from_base[:3, 3]
        down_m = float((from_base[:3, 3]) @ settings.rig.down_in_camera)
        return add_surroundings(
            kind,
            settings.rig,
            block,
            build_rods(points_m, *settings.arm_m),
            target,
            rotation[:, 2],
            chance,
            max(down_m, 0.3),
        )
