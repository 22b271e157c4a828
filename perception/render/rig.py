"""The camera pair that pictures are rendered for: its lens, its baseline, and where it stands on the machine."""

from __future__ import annotations

import math

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from perception.render.tracer import Pinhole


@spec
class Rig:
    """A rectified stereo camera, fixed to the machine.

    Attributes:
        width: Pixels.
        height: Pixels.
        focal_px: Focal length.
        baseline_m: From the left camera to the right one.
        position_in_base_m: Left camera's centre of projection in the base frame.
        yaw_rad: Turn of the view about the vertical, from base x towards y.
        pitch_rad: How far it looks down.
    """

    width: int
    height: int
    focal_px: float
    baseline_m: float
    position_in_base_m: tuple[float, float, float]
    yaw_rad: float
    pitch_rad: float

    def check(self) -> None:
        if min(self.width, self.height) < 16 or self.focal_px <= 0 or self.baseline_m <= 0:
            raise ConfigError(
                f"rig: expected width and height of 16 or more, focal_px and baseline_m above 0, got {self.width} x {self.height}, "
                f"{self.focal_px}, {self.baseline_m}"
            )

    @property
    def left(self) -> Pinhole:
        """The camera in whose coordinates everything is told."""
        return Pinhole(self.width, self.height, self.focal_px, np.zeros(3))

    @property
    def right(self) -> Pinhole:
        """Its partner."""
        return Pinhole(
            self.width, self.height, self.focal_px, np.array([self.baseline_m, 0.0, 0.0])
        )

    @property
    def base_from_camera(self) -> np.ndarray:
        """Pose of the left camera in the base frame, `(4, 4)`: x right, y down, z forward."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        down, ahead = math.sin(self.pitch_rad), math.cos(self.pitch_rad)
        forward = np.array([cos * ahead, sin * ahead, -down])
        right = np.array([sin, -cos, 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        pose[:3, 3] = self.position_in_base_m
        return pose

    @property
    def down_in_camera(self) -> np.ndarray:
        """Direction of gravity, `(3,)`, camera coordinates."""
        return -self.base_from_camera[2, :3]
