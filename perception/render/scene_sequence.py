"""Scenes by number: random ones, each for itself, and what sequences of related scenes share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brokk_rl.session import Session
from perception.render.scene_ranges import Scene, SceneRanges
from perception.render.scene_sampler import compose_scene
from perception.render.stereo_camera import StereoRig


@dataclass(frozen=True)
class StagedScene:
    """Scene of one frame, in its camera coordinates.

    Attributes:
        scene: In the left camera's coordinates.
        base_from_camera: Pose of the left camera, `(4, 4)`.
        generator: Source of the frame's noise.
    """

    scene: Scene
    base_from_camera: np.ndarray
    generator: np.random.Generator


class RandomScenes:
    """Scenes that have nothing in common but their kind.

    Args:
        kind: Ranges to draw from.
        rig: The camera pair, fixed to the machine.
        session: Seed of the scenes.
    """

    def __init__(self, kind: SceneRanges, rig: StereoRig, session: Session) -> None:
        self._kind, self._rig, self._session = kind, rig, session
        self.base_from_camera = rig.base_from_camera

    def view(self, number: int) -> StagedScene:
        """Return scene `number`."""
        generator = self._session.generator(f"scene/{number}")
        scene = compose_scene(self._kind, self._rig, generator)
        return StagedScene(scene, self.base_from_camera, generator)

    def write_records(self, folder: Path, count: int) -> None:
        """Write nothing."""
