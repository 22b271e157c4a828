"""Pose from one picture alone, by the known radius of the holes."""

from __future__ import annotations

import numpy as np

from brokk_rl.contracts.vision import Ellipse, HolePose, Masks, Rejection
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception.ellipse import conic
from perception.pose import appearance
from perception.pose.plane_conic import as_row, convert_to_gray, linearize


@spec
class MonoCircle:
    """Pose by the known radius, without depth: one of two circles that look like the ellipse.

    Attributes:
        radius_m: Radius of the holes.
        normal_in_base: Expected normal of the face in the base frame; selects one of two solutions.
        normal_rad: Largest angle to it.
        ellipse_px: Least standard deviation of the ellipse's axes, px; sets the covariance.
        darkness: Largest brightness of the darkest quarter inside over that of the face, the only
            test of the appearance.
    """

    radius_m: float
    normal_in_base: tuple[float, float, float]
    normal_rad: float
    ellipse_px: float
    darkness: float

    def build(self) -> MonoCircleEstimator:
        """Return an estimator."""
        return MonoCircleEstimator(self)


class MonoCircleEstimator:
    """Estimator that uses the known diameter alone, with the settings `MonoCircle`."""

    def __init__(self, settings: MonoCircle) -> None:
        self.settings = settings

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Return the circle nearer to the expected normal; see `PoseEstimator`."""
        s = self.settings
        if frame.base_from_camera is None:
            return Rejection("pose", "known pose of the camera", 0.0, 1.0, ellipse)
        expected = frame.base_from_camera[:3, :3].T @ np.array(s.normal_in_base)
        row = as_row(ellipse)
        center, normal = max(
            conic.solve_circle_poses(row, frame.camera_matrix, s.radius_m),
            key=lambda one: float(one[1] @ expected),
        )
        angle = float(np.arccos(np.clip(normal @ expected, -1, 1)))
        if angle > s.normal_rad:
            return Rejection(
                "pose", "angle to the expected normal, rad", angle, s.normal_rad, ellipse
            )
        light = linearize(convert_to_gray(frame), frame.gamma)
        dark = appearance.measure_interior(
            light, frame.depth_m, row, frame.camera_matrix, None
        ).darkness
        if not dark <= s.darkness:
            return Rejection("pose", "brightness inside over outside", dark, s.darkness, ellipse)
        std = (
            np.array([1, 1, 1, 1, 0])
            * max(ellipse.rms_px, s.ellipse_px)
            / np.sqrt(max(ellipse.coverage, 0.1))
        )
        std[4] = std[2] / max(ellipse.a - ellipse.b, std[2])
        moves, turns = [], []
        for k in range(5):
            changed = row + np.eye(5)[k] * std[k]
            if changed[3] > changed[2]:
                changed = row - np.eye(5)[k] * std[k]
            other = min(
                conic.solve_circle_poses(changed, frame.camera_matrix, s.radius_m),
                key=lambda one: -float(one[1] @ normal),
            )
            moves.append(other[0] - center)
            turns.append(other[1] - normal)
        return HolePose(
            center_m=center,
            axis=normal,
            radius_m=s.radius_m,
            cov_m2=np.einsum("ki,kj->ij", moves, moves),
            axis_cov_rad2=np.einsum("ki,kj->ij", turns, turns),
            frame="camera",
            score=ellipse.score * 0.5,
            t_s=frame.t_s,
        )
