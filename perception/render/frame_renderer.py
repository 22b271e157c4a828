"""Rendered frames: a random scene, both its pictures, matched depth, masks and truth."""

from __future__ import annotations

from collections.abc import Callable
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
from perception.render.drilled_block import DrilledHole
from perception.render.ray_tracer import Tracer
from perception.render.scene_ranges import Scene, SceneRanges
from perception.render.scene_sampler import SceneSampler, compute_hidden_share, sample_rim
from perception.render.stereo_camera import StereoRig, draw_dust, take_picture
from perception.segment.window import Window
from perception.stereo import Stereo

ComposeScene = Callable[[int], tuple[Scene, np.random.Generator]]
"""From the number of a frame to its scene, and the source of its noise."""


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
            raise ConfigError("studio.pair=false: no pair to match; studio.depth=exact or none")

    def prepare(self, folder: Path, session: Session, count: int) -> ComposeScene:
        """Return what composes scene `number`, and write what the frames share.

        Args:
            folder: Of the frames; what was recorded along goes into the folder above.
            session: Its seed decides the scenes.
            count: Number of frames there will be.

        Raises:
            ConfigError: the scenes cannot be drawn.
            StorageError: a file could not be written.
        """
        kind, rig = self.scene, self.rig
        if isinstance(kind, SceneRanges):

            def compose(number: int) -> tuple[Scene, np.random.Generator]:
                generator = session.generator(f"scene/{number}")
                return SceneSampler(kind, rig, generator).compose(), generator

        else:
            scenes = BoardScenes(kind, rig, session)
            scenes.write_records(folder.parent, count)
            compose = scenes.compose
        write_camera(folder, rig.model)
        return compose

    def shoot(self, stem: Path, scene: Scene, generator: np.random.Generator) -> None:
        """Render and write one frame; the same scene and noise make the same files.

        Raises:
            StorageError: a file could not be written.
        """
        shot = self.shot(scene, generator)
        depth = {"matched": shot.depth_m, "exact": shot.exact_depth_m, "none": None}[self.depth]
        dataset.write_frame(stem, shot.color, depth, shot.right, shot.label, shot.truth)

    def shot(
        self, scene: Scene, generator: np.random.Generator, part: Window | None = None
    ) -> RenderedFrame:
        """Return the frame of a scene in the left camera's coordinates, with noise of `generator`.

        Args:
            scene: The scene.
            generator: Source of the noise.
            part: The part of the picture that is read out; `None` for all of it.

        Raises:
            ConfigError: a part is wanted of a pair that is not perfect: its radial shift is that of a
                whole picture.
        """
        if part is not None and not self.rig.error.is_none:
            raise ConfigError("error: a part of the picture is rendered for rig/error=none only")
        cameras = [
            one if part is None else one.crop(part) for one in (self.rig.left, self.rig.right)
        ]
        tracer = Tracer(scene.solids, scene.light, scene.sky)
        left = tracer.view(cameras[0])
        exposure = scene.exposure
        sensors = self.rig.sensor.draw_pair(generator)
        density = draw_dust(exposure.patchiness, generator)
        color = take_picture(left.radiance, left.depth_m, exposure, density, sensors[0], generator)
        partner = None
        if self.pair:
            right = tracer.view(cameras[1])
            partner = take_picture(
                right.radiance, right.depth_m, exposure, density, sensors[1], generator
            )
        depth = left.depth_m
        if partner is not None and self.depth == "matched":
            depth = self.stereo.depth_m(color, partner, self.rig.focal_px, self.rig.baseline_m)
        roles = np.array([solid.role for solid in scene.solids] + ["nothing"])[left.solid]
        label = FrameLabel(roles == "block", left.mouth, roles == "arm")
        truth = self._truth(scene)
        return RenderedFrame(color, partner, depth, left.depth_m, label, truth)

    def _truth(self, scene: Scene) -> SceneTruth:
        block = scene.block
        if block is None:
            return SceneTruth(self.scene.name, scene.conditions, (), (), {})
        parts = vars(block.pose) | {"half_m": block.half_m}
        place = {name: np.asarray(part).tolist() for name, part in sorted(parts.items())}

        def describe(circle: DrilledHole) -> TrueCircle:
            return TrueCircle.place(
                block.pose.point(circle.center_m),
                block.pose.rotation @ circle.outward,
                self.rig.base_from_camera,
                circle.radius_m,
                depth_m=float(circle.depth_m),
                hidden=float(compute_hidden_share(scene.solids, block, circle)),
                in_view=self.rig.left.is_inside(sample_rim(block, circle), 0.0),
            )

        holes, decoys = (tuple(map(describe, some)) for some in (block.holes, block.discs))
        return SceneTruth(self.scene.name, scene.conditions, holes, decoys, place)
