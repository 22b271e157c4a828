"""Rendered frames: a random scene, both its pictures, matched depth, masks and truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.session import Session
from brokk_rl.spec import spec
from perception import dataset
from perception.camera import write_camera
from perception.dataset import FrameLabel, SceneTruth, TrueCircle
from perception.render.board_on_arm import BoardOnArm, BoardScenes
from perception.render.camera_sensor import draw_dust, take_picture
from perception.render.drilled_block import Disc, DrilledBlock, DrilledHole
from perception.render.ray_tracer import Tracer
from perception.render.scene_ranges import Scene, SceneRanges
from perception.render.scene_sampler import RandomScenes, sample_rim
from perception.render.stereo_camera import StereoRig
from perception.stereo import Stereo


@dataclass(frozen=True)
class RenderedFrame:
    """A rendered frame.

    Attributes:
        color: Left picture, RGB, `(h, w, 3)` uint8.
        right: Right picture, `None` where there is none.
        depth_m: As a camera would tell it, `(h, w)` float32, NaN where unknown.
        exact_depth_m: As it is.
        label: Masks.
        truth: Holes, decoys, block.
    """

    color: np.ndarray
    right: np.ndarray | None
    depth_m: np.ndarray
    exact_depth_m: np.ndarray
    label: FrameLabel
    truth: SceneTruth


@spec
class FrameRenderer:
    """Renders frames of a kind of scene for a stereo camera, with their truth.

    Attributes:
        rig: The camera pair.
        scene: Ranges of random scenes, or a sequence of related ones.
        stereo: Makes the depth.
        depth: `matched` makes depth of the two pictures; `exact` writes the mathematical one;
            `none` leaves it to the reader.
        pair: Whether the right picture is taken; left alone, in half the time, is enough to train a
            segmenter on.
    """

    rig: StereoRig
    scene: SceneRanges | BoardOnArm
    stereo: Stereo
    depth: Literal["matched", "exact", "none"]
    pair: bool

    def check(self) -> None:
        if self.depth == "matched" and not self.pair:
            raise ConfigError(
                "studio.pair=false: there is no pair to match; choose studio.depth=exact or none"
            )

    def prepare(self, folder: Path, session: Session, count: int) -> RandomScenes | BoardScenes:
        """Return the scenes, and write what their frames share.

        Args:
            folder: Of the frames; what was recorded along goes into the folder above.
            session: Its seed decides the scenes.
            count: Number of frames there will be.

        Raises:
            ConfigError: the scenes cannot be drawn.
            StorageError: a file could not be written.
        """
        rig = self.rig
        if isinstance(self.scene, SceneRanges):
            scenes = RandomScenes(self.scene, rig, session)
        else:
            scenes = BoardScenes(self.scene, rig, session)
            scenes.write_records(folder.parent, count)
        write_camera(folder, rig.model)
        return scenes

    def shoot(self, stem: Path, scene: Scene, generator: np.random.Generator) -> None:
        """Render and write one frame; the same scene and noise make the same files.

        Raises:
            StorageError: a file could not be written.
        """
        shot = self.shot(scene, generator)
        depth = {"matched": shot.depth_m, "exact": shot.exact_depth_m, "none": None}[self.depth]
        dataset.write_frame(stem, shot.color, depth, shot.right, shot.label, shot.truth)

    def shot(self, scene: Scene, generator: np.random.Generator) -> RenderedFrame:
        """Return the frame of a scene in the left camera's coordinates, with noise of `generator`."""
        tracer = Tracer(scene.solids, scene.light, scene.sky)
        left = tracer.view(self.rig.left)
        exposure = scene.exposure
        cameras = self.rig.sensor.draw_pair(generator)
        density = draw_dust(exposure.patchiness, generator)
        color = take_picture(left.radiance, left.depth_m, exposure, density, cameras[0], generator)
        partner = None
        if self.pair:
            right = tracer.view(self.rig.right)
            partner = take_picture(
                right.radiance, right.depth_m, exposure, density, cameras[1], generator
            )
        depth = left.depth_m
        if partner is not None and self.depth == "matched":
            depth = self.stereo.depth_m(color, partner, self.rig.focal_px, self.rig.baseline_m)
        roles = np.array([solid.role for solid in scene.solids] + ["nothing"])[left.solid]
        label = FrameLabel(roles == "block", left.mouth, roles == "arm")
        truth = self._truth(scene)
        return RenderedFrame(color, partner, depth, left.depth_m, label, truth)

    def _truth(self, scene: Scene) -> SceneTruth:
        block, base = scene.block, self.rig.base_from_camera
        if block is None:
            return SceneTruth(self.scene.name, scene.conditions, (), (), {})
        holes, decoys = [], []
        for hole, hidden in zip(block.holes, scene.hidden, strict=True):
            holes.append(self._describe_circle(block, hole, hidden, base))
        for disc, hidden in zip(block.discs, scene.hidden_discs, strict=True):
            decoys.append(self._describe_circle(block, disc, hidden, base))
        place = {
            "center_m": np.asarray(block.pose.center_m).tolist(),
            "rotation": np.asarray(block.pose.rotation).tolist(),
            "half_m": np.asarray(block.half_m).tolist(),
        }
        return SceneTruth(self.scene.name, scene.conditions, tuple(holes), tuple(decoys), place)

    def _describe_circle(
        self, block: DrilledBlock, circle: DrilledHole | Disc, hidden: float, base: np.ndarray
    ) -> TrueCircle:
        center = block.pose.point(circle.center_m)
        axis = block.pose.rotation @ circle.outward
        return TrueCircle.place(
            center,
            axis,
            base,
            circle.radius_m,
            depth_m=float(circle.depth_m),
            hidden=float(hidden),
            in_view=self.rig.left.is_inside(sample_rim(block, circle), 0.0),
        )
