"""Poses of holes from the plane of the block's face and the conic of the rim on it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.sight import Ellipse, HolePose, Masks, PoseEstimator, PoseSpec, Rejection
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception import appearance, conic, plane
from perception.appearance import Interior
from perception.plane import Plane


@spec
class Looks:
    """What a hole must look like inside; a flat dark disc of its size passes every test of geometry.

    Attributes:
        darkness: Largest brightness of the darkest quarter inside over that of the face.
        mouth: Least mean probability of the mouth channel inside; asked where the segmenter gives one.
        sure_mouth: From which the mouth channel needs no other witness.
        slope: Largest slope of brightness inside, see `Interior`; asked where depth inside says nothing.
        deeper: Part of the depth inside that lies behind the face from which depth says that it is a hole.
    """

    darkness: float
    mouth: float
    sure_mouth: float
    slope: float
    deeper: float


@spec
class PlaneConic:
    """The face's plane from the whole mask, the conic solved on it exactly, gates of size, shape and looks, a covariance.

    Attributes:
        radius_m: Radius of the holes that are looked for.
        radius_tolerance: How far the measured radius may be off, as a part of it.
        axis_ratio: Least ratio of the semi-axes on the plane; 1 is a circle.
        tilt_rad: Largest angle between the face's normal and the line of sight.
        inner: Inner limit of the face's support in radii of the ellipse; keeps the rim's bleeding out.
        rings: Outer limits in radii: the ring in which the plane is found, and those across which it is grown.
        max_pixels: Pixels of the face that are used.
        cell_px: Side of the squares within which depth noise is taken to be alike.
        noise_floor_per_m: Least standard deviation of inverse depth, 1/m.
        noise_limit_per_m: Largest standard deviation of inverse depth on the face, 1/m.
        alike: By how much the covariance of the plane is larger than its residuals say: a matcher errs alike over wide stretches.
        bias_per_m: Standard deviation of inverse depth that all of the face shares and no residual shows, 1/m.
        center_px: Standard deviation of an ellipse's centre that no residual shows, px.
        looks: What it must look like.
        without_depth: What is tried where the face has no depth; `null` for nothing.
    """

    radius_m: float
    radius_tolerance: float
    axis_ratio: float
    tilt_rad: float
    inner: float
    rings: tuple[float, ...]
    max_pixels: int
    cell_px: int
    noise_floor_per_m: float
    noise_limit_per_m: float
    alike: float
    bias_per_m: float
    center_px: float
    looks: Looks
    without_depth: PoseSpec | None

    def check(self) -> None:
        if not 0 < self.radius_tolerance < 1 or self.radius_m <= 0:
            raise ConfigError(
                "perception.pose: expected radius_m > 0 and 0 < radius_tolerance < 1, got "
                f"{self.radius_m} and {self.radius_tolerance}"
            )
        if not self.rings or list(self.rings) != sorted(self.rings) or self.rings[0] <= self.inner:
            raise ConfigError(f"perception.pose.rings: expected increasing limits above inner={self.inner}, got {list(self.rings)}")

    def build(self) -> PlaneConicEstimator:
        """Returns an estimator."""
        return PlaneConicEstimator(self)


class PlaneConicEstimator:
    """See `PlaneConic`."""

    def __init__(self, settings: PlaneConic) -> None:
        self.settings = settings
        self._without_depth: PoseEstimator | None = settings.without_depth.build() if settings.without_depth else None

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Returns the hole in camera coordinates, or why it is none; see `PoseEstimator`."""
        s = self.settings
        row = vector(ellipse)
        allowed = masks.block > 0.5
        if masks.mouth is not None:
            allowed &= masks.mouth < 0.5
        points = plane.support(frame.depth_m, allowed, frame.camera_matrix, row, s.inner, s.rings[-1], s.max_pixels, s.cell_px)
        face = plane.fit(points, s.rings, s.noise_floor_per_m, np.random.default_rng(0))
        if face is None:
            if self._without_depth is not None and frame.base_from_camera is not None:
                return self._without_depth.estimate(frame, masks, ellipse)
            return Rejection("pose", "pixels of the face with depth", float(len(points.inverse)), float(plane.LEAST), ellipse)
        if face.sigma > s.noise_limit_per_m:
            return Rejection("pose", "depth noise on the face, 1/m", face.sigma, s.noise_limit_per_m, ellipse)
        shape = self._shape(face, row, frame, ellipse)
        if isinstance(shape, Rejection):
            return shape
        center, radius = shape
        face = replace(face, cov=face.cov * s.alike)
        gray = gray_of(frame)
        inside = appearance.interior(gray, frame.depth_m, row, frame.camera_matrix, face)
        refused = self._looks(inside, masks, row, ellipse)
        if refused:
            return refused
        return HolePose(
            center_m=center,
            axis=face.normal,
            radius_m=radius,
            cov_m2=covariance(face, center, ellipse, frame.camera_matrix, s.center_px, s.bias_per_m),
            axis_cov_rad2=face.normal_cov_rad2(),
            frame="camera",
            score=float(ellipse.score),
            t_s=frame.t_s,
        )

    def _shape(self, face: Plane, row: np.ndarray, frame: Frame, ellipse: Ellipse) -> tuple[np.ndarray, float] | Rejection:
        """Returns centre and radius on the face, or which gate of geometry is not passed."""
        s = self.settings
        ray = np.linalg.solve(frame.camera_matrix, np.array([row[0], row[1], 1.0]))
        cosine = -float(face.normal @ ray) / float(np.linalg.norm(ray))
        tilt = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if tilt > s.tilt_rad:
            return Rejection("pose", "tilt of the face, rad", tilt, s.tilt_rad, ellipse)
        center, axes = conic.on_plane(row, frame.camera_matrix, face.m)
        if not np.isfinite(axes).all():
            return Rejection("pose", "axis ratio on the face", 0.0, s.axis_ratio, ellipse)
        radius, ratio = float(np.sqrt(axes[0] * axes[1])), float(axes[1] / axes[0])
        tolerance = s.radius_tolerance * s.radius_m
        if abs(radius - s.radius_m) > tolerance:
            limit = s.radius_m + np.sign(radius - s.radius_m) * tolerance
            return Rejection("pose", "radius, m", radius, float(limit), ellipse)
        if ratio < s.axis_ratio:
            return Rejection("pose", "axis ratio on the face", ratio, s.axis_ratio, ellipse)
        return center, radius

    def _looks(self, inside: Interior, masks: Masks, row: np.ndarray, ellipse: Ellipse) -> Rejection | None:
        looks = self.settings.looks
        if not inside.darkness <= looks.darkness:
            return Rejection("pose", "brightness inside over outside", inside.darkness, looks.darkness, ellipse)
        if masks.mouth is not None:
            mouth = inner_mean(masks.mouth, row)
            if mouth < looks.mouth:
                return Rejection("pose", "mouth probability inside", mouth, looks.mouth, ellipse)
            if mouth >= looks.sure_mouth:
                return None
        if not inside.deeper >= looks.deeper and not inside.slope <= looks.slope:
            return Rejection("pose", "slope of brightness inside", inside.slope, looks.slope, ellipse)
        return None


def covariance(
    face: Plane, center: np.ndarray, ellipse: Ellipse, camera_matrix: np.ndarray, center_px: float, bias_per_m: float
) -> np.ndarray:
    """Returns the covariance of a centre on a plane, `(3, 3)` m²: along the ray by the plane's, across it by the ellipse's.

    The points of an ellipse are alike over about two pixels, and one that is seen in part has its centre less surely.
    """
    ray = center / center[2]
    depth_var = center[2] ** 4 * (float(ray @ face.cov @ ray) + bias_per_m**2)
    number = max(float(conic.perimeter(np.array(ellipse.a), np.array(ellipse.b))) * ellipse.coverage / 2, 4.0)
    std_px = np.hypot(center_px, 2 * ellipse.rms_px / np.sqrt(number) / ellipse.coverage**2)
    across = np.linalg.inv(camera_matrix)[:, :2] * (std_px * center[2])
    slip = np.eye(3) - np.outer(ray, face.m) / float(face.m @ ray)  # across the ray, the centre stays on the plane
    return np.outer(ray, ray) * depth_var + slip @ across @ across.T @ slip.T


def vector(ellipse: Ellipse) -> np.ndarray:
    """Returns centre, semi-axes and direction, `(5,)`."""
    return np.array([ellipse.x, ellipse.y, ellipse.a, ellipse.b, ellipse.theta_rad])


def gray_of(frame: Frame) -> np.ndarray:
    """Returns the frame's picture in grey, `(h, w)` uint8."""
    return cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)


def inner_mean(picture: np.ndarray, row: np.ndarray) -> float:
    """Returns the mean of a picture within 0.8 of an ellipse."""
    x, y, a = row[:3]
    top, left = max(0, int(y - a)), max(0, int(x - a))
    part = picture[top : int(y + a) + 2, left : int(x + a) + 2]
    rows, columns = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
    place = np.stack([columns, rows, np.ones_like(rows)], -1).astype(float)
    inside = np.einsum("...i,ij,...j->...", place, conic.form(row), place) < 0.64 - 1.0
    return float(part[inside].mean()) if inside.any() else 0.0
