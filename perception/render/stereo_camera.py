"""The stereo camera: geometry of the pair."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.spec import Positive, spec
from perception.camera import CameraModel
from perception.render.camera_sensor import LinearSensor, MosaicSensor
from perception.render.ray_tracer import Pinhole


@spec
class PairMisalignment:
    """Departure of the right camera from its place beside the left one, after rectification.

    Attributes:
        turn_rad: Pitch, yaw and roll: turns about its x, y and z axes.
        focal: Relative difference of its focal length.
        offset_px: Shift of its picture to the right and down.
        distortion_px: Radial shift at the middle of the picture's left and right border, growing
            with the cube of the distance from the centre.
        seed: `null`: a rig with exactly these errors. A number draws one rig, with these as the
            standard deviations of normal errors.
    """

    turn_rad: tuple[float, float, float]
    focal: float
    offset_px: tuple[float, float]
    distortion_px: float
    seed: int | None

    @property
    def is_none(self) -> bool:
        """The pair is perfect."""
        return not any((*self.turn_rad, self.focal, *self.offset_px, self.distortion_px))

    def draw(self) -> PairMisalignment:
        """Return the errors of one rig: these, or those drawn by the seed."""
        if self.seed is None:
            return self
        std = np.array([*self.turn_rad, self.focal, *self.offset_px, self.distortion_px])
        chance = (std * np.random.default_rng(self.seed).standard_normal(7)).tolist()
        return PairMisalignment(
            turn_rad=tuple(chance[:3]),
            focal=chance[3],
            offset_px=tuple(chance[4:6]),
            distortion_px=chance[6],
            seed=None,
        )


@dataclass(frozen=True)
class MisalignedPinhole(Pinhole):
    """The right camera of a pair that is not perfect.

    Attributes:
        error: Its errors, drawn.
    """

    error: PairMisalignment

    def rays(self, pixel: np.ndarray) -> np.ndarray:
        """Return directions with z = 1, `(M, 3)` float32, through pixels, `(M, 2)`."""
        error, half_px = self.error, self.width / 2
        away = pixel - self.matrix[:2, 2] - error.offset_px
        # The shift is a fraction of a pixel: to undo it, first order is exact to 1e-4 px.
        square = (away**2).sum(1, keepdims=True) / half_px**2
        away = away * (1.0 - error.distortion_px / half_px * square)
        flat = away / (self.focal_px * (1.0 + error.focal))
        turn = np.asarray(cv2.Rodrigues(np.asarray(error.turn_rad))[0])
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ turn.T
        return (rays / rays[:, 2:]).astype(np.float32)


@spec
class StereoRig:
    """A stereo camera, fixed to the machine.

    Attributes:
        width: Pixels.
        height: Pixels.
        focal_px: Focal length.
        baseline_m: From the left camera to the right one.
        position_in_base_m: Left camera's centre of projection in the base frame.
        yaw_rad: Turn of the view about the vertical, from base x towards y.
        pitch_rad: How far it looks down.
        error: Departure of the pair from perfect rectification.
        sensor: Makes the pictures of both cameras from light.
    """

    width: Annotated[int, Ge(16)]
    height: Annotated[int, Ge(16)]
    focal_px: Positive
    baseline_m: Positive
    position_in_base_m: tuple[float, float, float]
    yaw_rad: float
    pitch_rad: float
    error: PairMisalignment
    sensor: LinearSensor | MosaicSensor

    @property
    def left(self) -> Pinhole:
        """The camera in whose coordinates everything is told."""
        return Pinhole(self.width, self.height, self.focal_px, np.zeros(3))

    @property
    def right(self) -> Pinhole:
        """Its partner."""
        place = self.width, self.height, self.focal_px, np.array([self.baseline_m, 0.0, 0.0])
        return (
            Pinhole(*place) if self.error.is_none else MisalignedPinhole(*place, self.error.draw())
        )

    @property
    def base_from_camera(self) -> np.ndarray:
        """Pose of the left camera in the base frame, `(4, 4)`: x right, y down, z forward."""
        return build_camera_pose(self.position_in_base_m, self.yaw_rad, self.pitch_rad)

    @property
    def model(self) -> CameraModel:
        """The pair as its user knows it: nobody has told him an error that it has."""
        return CameraModel(
            self.left.matrix,
            baseline_m=self.baseline_m,
            size_px=(self.width, self.height),
            base_from_camera=self.base_from_camera,
            disparity_std_px=0.0 if self.error.is_none else None,
            gamma=self.sensor.usual_gamma,
        )

    @property
    def down_in_camera(self) -> np.ndarray:
        """Direction of gravity, `(3,)`, camera coordinates."""
        return -self.base_from_camera[2, :3]


def build_camera_pose(position_m: Sequence[float], yaw_rad: float, pitch_rad: float) -> np.ndarray:
    """Return the pose of a level camera, `(4, 4)`: x right, y down, z forward.

    Args:
        position_m: Centre of projection in a frame with x forward, y left and z up.
        yaw_rad: Turn of the view about the vertical, from x towards y.
        pitch_rad: How far it looks down.
    """
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    down, ahead = math.sin(pitch_rad), math.cos(pitch_rad)
    forward = np.array([cos * ahead, sin * ahead, -down])
    right = np.array([sin, -cos, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = position_m
    return pose


def measure_disparity_error(rig: StereoRig) -> tuple[float, float, float]:
    """Return the error of a pair's disparity: constant, and slopes over x/z and y/z, px.

    It is fitted to rays over the middle half of the right picture: near the border distortion bends
    it. Measured disparity less this error is the true one.
    """
    ideal = rig.left
    columns, rows = np.meshgrid(
        np.linspace(0.25, 0.75, 32) * (rig.width - 1),
        np.linspace(0.25, 0.75, 18) * (rig.height - 1),
    )
    pixel = np.stack([columns.ravel(), rows.ravel()], 1)
    wrong_px = ideal.project(rig.right.rays(pixel).astype(float))[:, 0] - pixel[:, 0]
    flat = (pixel - ideal.matrix[:2, 2]) / rig.focal_px
    design = np.column_stack([np.ones(len(flat)), flat])
    constant, across, down = np.linalg.lstsq(design, wrong_px, rcond=None)[0]
    return float(constant), float(across), float(down)
