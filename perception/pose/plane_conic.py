"""Poses of holes from the plane of the block's face and the conic of the rim on it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from brokk_rl.contracts.vision import (
    Ellipse,
    HolePose,
    Masks,
    PoseEstimator,
    PoseEstimatorSpec,
    Rejection,
)
from brokk_rl.errors import ConfigError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception.ellipse import conic
from perception.pose import alignment, appearance, plane, rim
from perception.pose.appearance import Interior
from perception.pose.plane import FacePlane
from perception.pose.rim import RimCircle

UNTOLD, UNTOLD_SCORE = 0.8, 0.5
"""Part of an inside without depth, hidden from the right camera, from which on nobody can tell it
from a flat disc; the score of what nobody can, for dust or for this."""

FORGIVEN, AT_FIRST = 0.55, 1.4
"""Part of the circle that must show where its ellipse alone was too small or too long for one; and
how many times as far off as the circle an ellipse may be, which follows the shade within a rim
where that is the steeper edge."""
BESIDE = (1.15, 1.45)
"""Radii of an ellipse at which what stands before the rest of a rim is seen."""


@spec
class AppearanceGates:
    """What a hole must look like inside; a flat dark disc of its size passes every test of geometry.

    Attributes:
        darkness: Largest brightness of the darkest quarter inside over that of the face.
        veiled: From which on something lies over both: dust, behind which nobody sees how deep a
            hole is; or it is a stain.
        darker: If something near it is darker by more than this, over the brightness of the face,
            it is no dust.
        contrast: Least contrast, in standard deviations of the face's grain, of what is veiled: a
            stain has less; unless both cameras see that it is deep.
        mouth: Least mean probability of the mouth channel inside; asked where the segmenter gives
            one.
        sure_mouth: From which the mouth channel decides where nobody sees how deep it is; where
            that is seen, it overrules nothing.
        slope: Slope of brightness inside, see `Interior`, that alone would show a hole; less is as
            much less evidence, and adds up.
        deeper: Part of the depth inside that lies behind the face, likewise.
        parallax: Difference of left and right picture inside over that on the face, likewise; 1 is
            none.
        parts: Radii of an ellipse: its inside for the parallax, and the ring of face around it.
    """

    darkness: float
    veiled: float
    darker: float
    contrast: float
    mouth: float
    sure_mouth: float
    slope: float
    deeper: float
    parallax: float
    parts: tuple[float, tuple[float, float]]


@spec
class PlaneConic:
    """The face's plane from the whole mask, the conic solved on it exactly, gates of size, shape and looks, a covariance.

    Attributes:
        radius_m: Radius of the holes that are looked for.
        radius_tolerance: How far the measured radius may be off, as a part of it; in proportion
            more at first, where something hides a part of the rim.
        axis_ratio: Least ratio of the semi-axes on the plane; 1 is a circle; likewise.
        coverage: Least part of the circle on the face whose rim is seen.
        tilt_rad: Largest angle between the face's normal and the line of sight.
        inner: Inner limit of the face's support in radii of the ellipse; keeps the rim's bleeding
            out.
        rings: Outer limits in radii: the ring in which the plane is found, and those across which
            it is grown.
        max_pixels: Pixels of the face that are used.
        cell_px: Side of the squares within which depth noise is taken to be alike.
        noise_floor_per_m: Least standard deviation of inverse depth, 1/m.
        noise_limit_per_m: Largest standard deviation of inverse depth on the face, 1/m.
        matcher_alike: By how much the covariance of the plane from depth alone is larger than its
            residuals say: what a matcher gets wrong is alike over wide stretches.
        matcher_bias_per_m: Standard deviation of inverse depth by which a matcher is off all over a
            face, 1/m; with a right picture the face is aligned anew.
        bias_per_m: Standard deviation of inverse depth that all of the face shares and no residual
            shows, 1/m.
        center_px: Standard deviation of the centre of a whole rim that no residual shows, px.
        shape_px: Standard deviation by which a rim departs from a circle at each of its first
            waves, px: it moves the centre of what is left of one.
        looks: What it must look like.
        without_depth: What is tried where the face has no depth; `null` for nothing.
        blind: Part of the face around a hole with known depth below which it has none.
    """

    radius_m: float
    radius_tolerance: float
    axis_ratio: float
    coverage: float
    tilt_rad: float
    inner: float
    rings: tuple[float, ...]
    max_pixels: int
    cell_px: int
    noise_floor_per_m: float
    noise_limit_per_m: float
    matcher_alike: float
    matcher_bias_per_m: float
    bias_per_m: float
    center_px: float
    shape_px: float
    looks: AppearanceGates
    without_depth: PoseEstimatorSpec | None
    blind: float

    def check(self) -> None:
        if not 0 < self.radius_tolerance < 1 or self.radius_m <= 0:
            raise ConfigError(
                "perception.pose: expected radius_m > 0 and 0 < radius_tolerance < 1, got "
                f"{self.radius_m} and {self.radius_tolerance}"
            )
        if not self.rings or list(self.rings) != sorted(self.rings) or self.rings[0] <= self.inner:
            raise ConfigError(
                f"perception.pose.rings: expected increasing limits above inner={self.inner}, got {list(self.rings)}"
            )

    def build(self) -> PlaneConicEstimator:
        """Return an estimator."""
        return PlaneConicEstimator(self)


class PlaneConicEstimator:
    """See `PlaneConic`."""

    def __init__(self, settings: PlaneConic) -> None:
        self.settings = settings
        self._without_depth: PoseEstimator | None = (
            settings.without_depth.build() if settings.without_depth else None
        )
        self._seen: tuple[Frame, Masks, np.ndarray, np.ndarray] | None = None

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Return the hole in camera coordinates, or why it is none; see `PoseEstimator`."""
        s = self.settings
        row = as_row(ellipse)
        gray, allowed = self._pictures(frame, masks)
        reach = (s.radius_m, s.inner, s.rings[0], s.rings[-1])
        points = plane.collect_support(
            frame.depth_m, allowed, frame.camera_matrix, row, *reach, s.max_pixels, s.cell_px
        )
        face = plane.fit_plane(points, s.rings, s.noise_floor_per_m, np.random.default_rng(0))
        if face is None:
            if (
                self._without_depth is not None
                and frame.base_from_camera is not None
                and points.known < s.blind
            ):
                return self._without_depth.estimate(frame, masks, ellipse)
            return Rejection(
                "pose",
                "pixels of the face with depth",
                float(len(points.inverse)),
                float(plane.LEAST),
                ellipse,
            )
        if face.sigma > s.noise_limit_per_m:
            return Rejection(
                "pose", "depth noise on the face, 1/m", face.sigma, s.noise_limit_per_m, ellipse
            )
        face = replace(face, cov=face.cov * s.matcher_alike)
        shape = self._shape(face, row, frame, ellipse)
        if isinstance(shape, Rejection):
            return shape
        both = alignment.crop_pair(frame, gray, face.m, row, face.extent)
        if both is not None:
            agreed = alignment.align_plane(
                both, face, frame, allowed, row, s.inner, s.cell_px, s.matcher_bias_per_m
            )
            both, face = (None, face) if agreed is None else (both, agreed)
            shape = self._shape(face, row, frame, ellipse)
            if isinstance(shape, Rejection):
                return shape
        circle = rim.fit_rim_circle(
            gray,
            row,
            frame.camera_matrix,
            face.m,
            s.radius_m,
            s.radius_tolerance,
            s.center_px,
            s.shape_px,
        )
        least = s.coverage if shape else max(s.coverage, FORGIVEN)
        if circle is None or circle.coverage < least:
            return Rejection(
                "pose",
                "part of a circle on the face with a rim",
                circle.coverage if circle else 0.0,
                least,
                ellipse,
            )
        if abs(circle.radius_m - s.radius_m) > s.radius_tolerance * s.radius_m:
            limit = s.radius_m * (1.0 + np.sign(circle.radius_m - s.radius_m) * s.radius_tolerance)
            return Rejection("pose", "radius, m", circle.radius_m, float(limit), ellipse)
        row = circle.ellipse
        inside = appearance.measure_interior(gray, frame.depth_m, row, frame.camera_matrix, face)
        parallax, covered = (
            alignment.measure_parallax(both, face, frame.depth_m, row, *s.looks.parts)
            if both
            else (float("nan"), 0.0)
        )
        # behind something that stands before it, or in dust, nobody can tell
        untold = inside.darkness > s.looks.veiled or (covered > UNTOLD and inside.unknown > UNTOLD)
        refused = self._looks(inside, parallax, masks, row, ellipse, untold)
        if refused:
            return refused
        return HolePose(
            center_m=circle.center_m,
            axis=face.normal,
            radius_m=circle.radius_m,
            cov_m2=compute_center_covariance(face, circle, s.bias_per_m),
            axis_cov_rad2=face.normal_cov_rad2(),
            frame="camera",
            score=float(ellipse.score)
            * (UNTOLD_SCORE if untold and masks.hole_mask is None else 1.0),
            t_s=frame.t_s,
        )

    def _pictures(self, frame: Frame, masks: Masks) -> tuple[np.ndarray, np.ndarray]:
        """Return the grey picture and the pixels of the face, which all ellipses of a frame share."""
        if self._seen is None or self._seen[0] is not frame or self._seen[1] is not masks:
            allowed = masks.block > 0.5
            if masks.hole_mask is not None:
                allowed &= masks.hole_mask < 0.5
            self._seen = frame, masks, convert_to_gray(frame), allowed
        return self._seen[2:]

    def _shape(
        self, face: FacePlane, row: np.ndarray, frame: Frame, ellipse: Ellipse
    ) -> bool | Rejection:
        """Return whether an ellipse has size and shape of a rim with nothing forgiven, or which gate it does not pass."""
        s = self.settings
        ray = np.linalg.solve(frame.camera_matrix, np.array([row[0], row[1], 1.0]))
        cosine = -float(face.normal @ ray) / float(np.linalg.norm(ray))
        tilt = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if tilt > s.tilt_rad:
            return Rejection("pose", "tilt of the face, rad", tilt, s.tilt_rad, ellipse)
        _, axes = conic.project_onto_plane(row, frame.camera_matrix, face.m)
        if not np.isfinite(axes).all():
            return Rejection("pose", "axis ratio on the face", 0.0, s.axis_ratio, ellipse)
        radius, ratio = float(np.sqrt(axes[0] * axes[1])), float(axes[1] / axes[0])
        seen = max(
            1.0 - measure_hidden_part(face, row, frame), s.coverage
        )  # the less of a rim there is, the less it tells
        tolerance = AT_FIRST * s.radius_tolerance / seen * s.radius_m
        if abs(radius - s.radius_m) > tolerance:
            limit = s.radius_m + np.sign(radius - s.radius_m) * tolerance
            return Rejection("pose", "radius, m", radius, float(limit), ellipse)
        least = 1.0 - AT_FIRST * (1.0 - s.axis_ratio) / seen
        if ratio < least:
            return Rejection("pose", "axis ratio on the face", ratio, least, ellipse)
        return abs(radius / s.radius_m - 1.0) <= s.radius_tolerance and ratio >= s.axis_ratio

    def _looks(
        self,
        inside: Interior,
        parallax: float,
        masks: Masks,
        row: np.ndarray,
        ellipse: Ellipse,
        untold: bool,
    ) -> Rejection | None:
        looks = self.settings.looks
        if not inside.darkness <= looks.darkness:
            return Rejection(
                "pose", "brightness inside over outside", inside.darkness, looks.darkness, ellipse
            )
        mouth = 0.0 if masks.hole_mask is None else average_inside(masks.hole_mask, row)
        if masks.hole_mask is not None and mouth < looks.mouth:
            return Rejection("pose", "mouth probability inside", mouth, looks.mouth, ellipse)
        sure = mouth >= looks.sure_mouth
        shown = [
            max(one, 0.0)
            for one in (inside.slope / looks.slope, inside.deeper / looks.deeper)
            if np.isfinite(one)
        ]
        # a dark disc is noisier nowhere than the face: below 1 it speaks against
        against = (parallax - 1.0) / (looks.parallax - 1.0)
        evidence = sum(shown) + (against if np.isfinite(against) else 0.0)
        if inside.darkness > looks.veiled:
            if sure:
                return None
            if inside.around < inside.darkness - looks.darker:
                return Rejection(
                    "pose", "brightness inside over outside", inside.darkness, looks.veiled, ellipse
                )
            if inside.contrast >= looks.contrast or (np.isfinite(against) and evidence >= 1.0):
                return None
            return Rejection(
                "pose",
                "contrast to the grain of the face",
                inside.contrast,
                looks.contrast,
                ellipse,
            )
        if untold and not np.isfinite(against) and (sure or masks.hole_mask is None):
            return None
        return (
            None
            if evidence >= 1.0
            else Rejection("pose", "evidence of depth inside", evidence, 1.0, ellipse)
        )


def compute_center_covariance(face: FacePlane, circle: RimCircle, bias_per_m: float) -> np.ndarray:
    """Return the covariance of a centre, `(3, 3)` m²: along the ray by the plane's, on the plane by the circle's."""
    center = circle.center_m
    ray = center / center[2]
    depth_var = center[2] ** 4 * (float(ray @ face.cov @ ray) + bias_per_m**2)
    return np.outer(ray, ray) * depth_var + circle.cov_m2


def measure_hidden_part(face: FacePlane, row: np.ndarray, frame: Frame) -> float:
    """Return the part of a rim on a face, about where an ellipse `(5,)` is, before which something nearer stands.

    It may be smaller than the rim; and where the nearer thing begins, its depth is often unknown.
    """
    height, width = frame.depth_m.shape
    nearer = np.zeros(72, bool)
    for scale in BESIDE:
        points = conic.sample_ellipses(
            (row * [1.0, 1.0, scale, scale, 1.0])[None],
            np.linspace(0.0, 2 * np.pi, 72, endpoint=False),
        )[0][0]
        column, line = np.rint(points).astype(int).T
        on = (column >= 0) & (column < width) & (line >= 0) & (line < height)
        depth = frame.depth_m[line.clip(0, height - 1), column.clip(0, width - 1)]
        rays = (
            np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(frame.camera_matrix).T
        )
        nearer |= on & (
            1.0 / depth - rays @ face.m > 4 * face.sigma
        )  # false where depth is unknown
    return float(nearer.mean())


def as_row(ellipse: Ellipse) -> np.ndarray:
    """Return centre, semi-axes and direction, `(5,)`."""
    return np.array([ellipse.x, ellipse.y, ellipse.a, ellipse.b, ellipse.theta_rad])


def convert_to_gray(frame: Frame) -> np.ndarray:
    """Return the frame's picture in grey, `(h, w)` uint8."""
    return cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)


def average_inside(picture: np.ndarray, row: np.ndarray) -> float:
    """Return the mean of a picture within 0.8 of an ellipse."""
    x, y, a = row[:3]
    top, left = max(0, int(y - a)), max(0, int(x - a))
    part = picture[top : int(y + a) + 2, left : int(x + a) + 2]
    rows, columns = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
    inside = conic.measure_radii(row, columns, rows) < 0.8
    return float(part[inside].mean()) if inside.any() else 0.0
