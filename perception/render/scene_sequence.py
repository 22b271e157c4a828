"""Scenes by number: random ones, each for itself, and what sequences of related scenes share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

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


class SceneSequence(Protocol):
    """Scenes by number, and the records that belong to them."""

    @property
    def base_from_camera(self) -> np.ndarray | None:
        """Pose of a camera that stands still, `(4, 4)`; `None` for one that is carried."""
        ...

    def view(self, number: int) -> StagedScene:
        """Return scene `number`; the same session gives the same."""
        ...

    def write_records(self, folder: Path, count: int) -> None:
        """Write what was recorded beside the first `count` frames.

        Raises:
            StorageError: a file could not be written.
        """
        ...


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


def build_pose(rotation: np.ndarray, shift_m: np.ndarray) -> np.ndarray:
    """Return a transform, `(4, 4)`."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift_m
    return pose
