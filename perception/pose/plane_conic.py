"""Pose of a hole from the plane of the block's face and the circle of the rim on it."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.contracts.vision import Ellipse, HolePose, Masks, Rejection
from brokk_rl.errors import ConfigError
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, Share, spec
from perception.ellipse import conic
from perception.pose import alignment, appearance, broken_rim, consistency, plane, rim
from perception.pose.appearance import Interior
from perception.pose.focal_belief import FocalBelief, FocalDoubt, compute_focal_covariances
from perception.pose.plane import FacePlane, FaceSupport
from perception.pose.rim import PlaneChart, RimCircle
from perception.pose.wall_light import IN_DUST, WallLight, measure_wall_light

# Each of these times 0.8 or 1.25 left every count of holes and discs in 8 rendered frames as it was,
# and changed their median error by 0.4 mm at most. UNDECIDED_SCORE and WHOLE were not varied.
UNDECIDED, UNDECIDED_SCORE = 0.8, 0.5
"""Part of the inside without depth, and hidden from the right camera, from which a hole cannot be
told from a flat disc; factor on the score of such a hole, and of one in dust."""
COVERED = 0.02
"""The same part from which the pictures may differ by an occluder's edge, which dust makes as bright as
the face. Discs that differed, seed 1001 of dust.py (commit 1bfbfc41): 0.04, 0.06; eight of ten
holes at most 0.01."""
FORGIVEN, AT_FIRST = 0.55, 1.4
"""Least visible part of a circle whose ellipse was too small or too long; and factor on the limits
for an ellipse, which may follow the shade within a rim where that is the steeper edge."""
HALF, WHOLE, AS_MUCH = 0.5, 0.85, 0.8
"""Visible part of a circle, and of an ellipse, from which edges tell how round a rim is; part of the
ellipse's edges that the circle must show to be asked: on a wrong face hardly any circle is seen."""
BROKEN_SEEN = 0.6
"""Least part of a broken rim with edges: its pieces may lie at any depth, so texture has some too."""


@spec
class AppearanceGates:
    """Gates on the appearance inside a hole: a flat dark disc passes every test of geometry.

    Attributes:
        darkness: Largest brightness of the darkest quarter inside over that of the face.
        veiled: Such a brightness from which it is a hole behind dust, or a stain.
        darker: Surroundings darker by more than this, over the brightness of the face, exclude
            dust.
        contrast: Least contrast of a veiled hole in standard deviations of the face's grain; a
            stain has less.
        hole_log_ratio: Least log-likelihood ratio of a veiled hole to a flat disc, by the light on
            its wall (`WallLight`). Neither this nor `contrast` is asked where the
            parallax alone is evidence enough.
        mouth: Least mean of the segmenter's hole mask inside, where there is one.
        sure_mouth: Mean of the hole mask from which it decides where depth cannot be seen.
        slope: Slope of brightness inside (`Interior`) that alone is evidence enough; evidence is
            proportional, and adds up.
        deeper: Part of the depth inside behind the face that alone is evidence enough.
        parallax: Difference of left and right picture inside, over that on the face, that alone is
            evidence enough; 1 is none.
        parts: Radii of the inside for the parallax, and of the ring of face around it.
    """

    darkness: float
    veiled: float
    darker: float
    contrast: float
    hole_log_ratio: float
    mouth: float
    sure_mouth: float
    slope: float
    deeper: float
    parallax: float
    parts: tuple[float, tuple[float, float]]


@spec
class PlaneConic:
    """Plane of the face, circle of the rim on it; gates of size, shape and appearance; covariance.

    Attributes:
        radius_m: Radius of the holes.
        radius_tolerance: Allowed relative error of the measured radius; more for the first ellipse
            where something hides a part of the rim.
        axis_ratio: Least ratio of the semi-axes on the plane, 1 for a circle; likewise.
        coverage: Least visible part of the circle.
        broken: Part of a rim that is missing though nothing hides it, from which its pieces count
            as broken off; 1 for never.
        on_face: Least part of the innermost ring with depth that lies on the face.
        size_agrees: The same of a rim that is not broken, once its circle is fitted: depth, pair and
            focal length agree with it.
        stretch: Factor on the focal length, beyond its uncertainty, from which the roundness of a
            rim contradicts it.
        nearer: Largest part of the inside with depth that is nearer than the face.
        tilt_rad: Largest angle between the face's normal and the line of sight.
        inner: Inner limit of the face's support in radii of the ellipse; leaves out the bleeding of
            the rim.
        rings: Outer limits in radii: of the ring in which the plane is fitted first, and of those
            across which it is grown.
        max_pixels: Largest number of pixels of the face.
        cell_px: Side of the squares within which depth noise is correlated.
        noise_floor_per_m: Least standard deviation of inverse depth, 1/m; like the next three that of
            the usual pair, see `plane.compare_pair`.
        noise_limit_per_m: Largest standard deviation of inverse depth on the face, 1/m.
        matcher_alike: Factor on the covariance of the plane from depth alone: errors of a matcher
            are correlated over wide stretches.
        matcher_bias_per_m: Standard deviation of a matcher's bias over a whole face in inverse
            depth, 1/m; with a right picture the face is aligned directly.
        matcher_drift: The same over the noise of depth on the face, on top: in haze a matcher
            follows its neighbours.
        bias_per_m: Standard deviation of the remaining bias that no residual shows, 1/m.
        rig_px: `Frame.disparity_std_px` of a pair that was not calibrated.
        center_px: Least standard deviation of the centre of a whole rim that no residual shows, px;
            what its waves show comes on top.
        focal: Doubt about the focal length of a pair, until rims show that it is right.
        looks: Gates on the appearance.
    """

    radius_m: Positive
    radius_tolerance: Annotated[float, Interval(gt=0, lt=1)]
    axis_ratio: float
    coverage: float
    broken: float
    on_face: Share
    size_agrees: Share
    stretch: Annotated[float, Ge(1)]
    nearer: Share
    tilt_rad: float
    inner: float
    rings: tuple[float, ...]
    max_pixels: int
    cell_px: int
    noise_floor_per_m: float
    noise_limit_per_m: float
    matcher_alike: float
    matcher_bias_per_m: float
    matcher_drift: NonNegative
    bias_per_m: float
    rig_px: float
    center_px: float
    focal: FocalDoubt
    looks: AppearanceGates

    def check(self) -> None:
        if not self.rings or list(self.rings) != sorted(self.rings) or self.rings[0] <= self.inner:
            raise ConfigError(
                f"rings: expected increasing limits above inner={self.inner}, got {list(self.rings)}"
            )

    def build(self) -> PlaneConicEstimator:
        """Return an estimator."""
        return PlaneConicEstimator(self)


class PlaneConicEstimator:
    """Estimator of the face's plane and the rim on it, with the settings `PlaneConic`."""

    def __init__(self, settings: PlaneConic) -> None:
        self.settings = settings
        self._focal = FocalBelief(settings.focal)
        self._seen: tuple[Frame, Masks, np.ndarray, np.ndarray, np.ndarray] | None = None

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Return the hole in camera coordinates, or why it is none; `frame` has no distortion."""
        s, row = self.settings, conic.as_row(ellipse)
        gray, light, allowed = self._prepare(frame, masks)
        self._focal.begin(frame)
        points = self._collect_support(frame, allowed, row)
        face = self._fit_face(frame, points, ellipse)
        if isinstance(face, Rejection):
            return face
        shape = self._check_shape(face, row, frame, ellipse)
        if isinstance(shape, Rejection):
            return shape
        from_depth = face
        # The right picture gives the plane again, without the bias of the matcher.
        both = alignment.crop_pair(frame, gray, face.m, row, face.extent)
        if both is not None:
            agreed = alignment.align_plane(both, face, frame, allowed, row, s.inner, s.cell_px)
            # `None` says that the pictures disagree: then parallax means nothing either.
            both, face = (None, face) if agreed is None else (both, agreed)
            # A refined plane may turn a plausible ellipse into an implausible one.
            shape = self._check_shape(face, row, frame, ellipse)
            if isinstance(shape, Rejection):
                return shape
        aside = consistency.check_ring(
            points, from_depth, (s.rings[0], s.on_face), both is not None, ellipse
        )
        if aside is not None:
            return aside
        circle = self._fit_circle(light, frame, face, both, ellipse, has_good_shape=shape)
        if isinstance(circle, Rejection):
            return circle
        refused, doubt = self._judge_appearance(light, frame, masks, face, circle, both, ellipse)
        if refused is not None:
            return refused
        slip = self._focal.find_slip() if frame.right is not None else None
        if slip is not None:
            return Rejection("pose", consistency.STRETCH, slip, 1.0, ellipse)
        return self._describe_hole(frame, face, circle, float(ellipse.score) * doubt)

    def _collect_support(self, frame: Frame, allowed: np.ndarray, row: np.ndarray) -> FaceSupport:
        """Return the depth around an ellipse `(5,)`: inside the hole it shows no face."""
        s = self.settings
        reach = (s.radius_m, s.inner, s.rings[0], s.rings[-1])
        return plane.collect_support(
            frame.depth_m, allowed, frame.camera_matrix, row, *reach, s.max_pixels, s.cell_px
        )

    def _fit_face(
        self, frame: Frame, points: FaceSupport, ellipse: Ellipse
    ) -> FacePlane | Rejection:
        """Return the plane of the face from depth, or why there is none."""
        s = self.settings
        # A fixed seed for each ellipse: the result must not depend on the order of ellipses.
        pair = plane.compare_pair(frame)
        floor_per_m = s.noise_floor_per_m * pair
        face = plane.fit_plane(points, s.rings, floor_per_m, np.random.default_rng(0))
        if face is None:
            reason, num_points = "pixels of the face with depth", float(len(points.inverse))
            return Rejection("pose", reason, num_points, float(plane.LEAST), ellipse)
        # Noise above that of any matcher: the surroundings are no single plane.
        limit_per_m = s.noise_limit_per_m * max(pair, 1.0)
        if face.sigma > limit_per_m:
            reason = "depth noise on the face, 1/m"
            return Rejection("pose", reason, face.sigma, limit_per_m, ellipse)
        # Errors of neighbouring pixels are alike; those of a coarse match grow with its pixels.
        cov = face.cov * s.matcher_alike * frame.depth_shrink**2
        # A bias of a matcher shifts the whole face, so it enters the constant term alone.
        bias_per_m = s.matcher_bias_per_m * pair * frame.depth_shrink + s.matcher_drift * face.sigma
        return replace(face, cov=cov + np.diag([0.0, 0.0, bias_per_m**2]))

    def _fit_circle(
        self,
        light: np.ndarray,
        frame: Frame,
        face: FacePlane,
        both: alignment.StereoPatch | None,
        ellipse: Ellipse,
        has_good_shape: bool,
    ) -> RimCircle | Rejection:
        """Return the circle of the rim on the final plane, or the gate that it misses."""
        s = self.settings
        # On the plane a circle has only three unknowns.
        circle = rim.fit_rim_circle(
            light,
            conic.as_row(ellipse),
            frame.camera_matrix,
            face.m,
            s.radius_m,
            s.radius_tolerance,
            s.center_px,
        )
        # What is missing of a rim is hidden, or broken off.
        seen = 0.0 if circle is None else circle.coverage
        row = conic.as_row(ellipse) if circle is None else circle.ellipse
        ray = np.linalg.solve(frame.camera_matrix, [ellipse.x, ellipse.y, 1.0])
        chart = rim.build_chart(face.point(ray), face.m, frame.camera_matrix)
        if seen > HALF or ellipse.coverage > WHOLE:
            outline = row if seen > AS_MUCH * ellipse.coverage else conic.as_row(ellipse)
            oval = self._judge_focal_length(light, frame, chart, face, outline)
            if oval is not None:
                return replace(oval, ellipse=ellipse)
        is_broken = 1.0 - seen - consistency.measure_hidden_part(face, row, frame) > s.broken
        if (
            s.broken < 1.0
            and both is not None
            and broken_rim.is_below_face(light, chart, both, row)
        ):
            # The circle lies below the face: a refusal is better than its place.
            is_broken, circle, seen = True, None, 0.0
        if is_broken:
            broken = broken_rim.fit_broken_rim(
                light, chart, both, np.zeros(2), s.radius_m, s.center_px
            )
            # Its coverage counts the broken parts too.
            if broken is not None and broken.coverage >= max(seen, BROKEN_SEEN):
                circle = broken
        # An ellipse of wrong shape, or a region with little border, may still belong to a rim, but
        # then most of the circle must be seen.
        is_sure = has_good_shape and ellipse.coverage >= s.coverage
        least = s.coverage if is_sure else max(s.coverage, FORGIVEN)
        if circle is None or circle.coverage < least:
            reason = "part of a circle on the face with a rim"
            seen = 0.0 if circle is None else circle.coverage
            return Rejection("pose", reason, seen, least, ellipse)
        size = circle.radius_m / s.radius_m
        limit = s.radius_tolerance if is_broken else s.size_agrees
        if abs(size - 1.0) > limit:
            limit = 1.0 + float(np.sign(size - 1.0)) * limit
            return Rejection("pose", consistency.SIZE, size, limit, ellipse)
        return circle

    def _judge_focal_length(
        self, light: np.ndarray, frame: Frame, chart: PlaneChart, face: FacePlane, row: np.ndarray
    ) -> Rejection | None:
        """Return that a rim `(5,)` on a face is round with another focal length of the pair."""
        told = consistency.measure_stretch(light, chart, face, row)
        if told is None:
            return None
        if frame.right is not None:
            std = float(np.hypot(told[1], consistency.measure_tilt_doubt(chart, face)))
            self._focal.learn(row, frame.camera_matrix, float(np.log(told[0])), std)
        if abs(np.log(told[0])) <= np.log(self.settings.stretch) + 3.0 * told[1]:
            return None
        return Rejection("pose", consistency.STRETCH, told[0], 1.0)

    def _judge_appearance(
        self,
        light: np.ndarray,
        frame: Frame,
        masks: Masks,
        face: FacePlane,
        circle: RimCircle,
        both: alignment.StereoPatch | None,
        ellipse: Ellipse,
    ) -> tuple[Rejection | None, float]:
        """Return the gate of the appearance that a rim misses, and the factor on its score."""
        s, row = self.settings, circle.ellipse
        # The first ellipse may follow the shade within: the fitted circle counts.
        inside = appearance.measure_interior(light, frame.depth_m, row, frame.camera_matrix, face)
        parallax, covered = float("nan"), 0.0
        if both is not None:
            parallax, covered = alignment.measure_parallax(
                both, face, frame.depth_m, row, *s.looks.parts
            )
        # Behind an occluder, or in dust, hole and disc look the same.
        undecided = inside.darkness > s.looks.veiled or (
            covered > UNDECIDED and inside.unknown > UNDECIDED
        )
        wall = None
        if inside.darkness > s.looks.veiled:
            place = (frame.camera_matrix, face, circle.center_m, circle.radius_m)
            wall = measure_wall_light(light, frame.depth_m, row, *place)
            if covered > COVERED:
                parallax = float("nan")
        refused = self._check_appearance(inside, parallax, wall, masks, row, ellipse, undecided)
        # A network that marks mouths has decided already; without it the doubt stays.
        doubt = UNDECIDED_SCORE if undecided and masks.hole_mask is None else 1.0
        return refused, doubt

    def _describe_hole(
        self, frame: Frame, face: FacePlane, circle: RimCircle, score: float
    ) -> HolePose:
        """Return the hole of a rim, with all that its place and axis may be off."""
        s = self.settings
        bias_per_m = s.bias_per_m * plane.compare_pair(frame)
        own_m2 = face.point_cov_m2(circle.center_m, bias_per_m) + circle.cov_m2
        own_rad2 = face.normal_cov_rad2()
        shared_m2, shared_rad2 = self._compute_rig_covariances(frame, face, circle.center_m)
        return HolePose(
            center_m=circle.center_m,
            axis=face.normal,
            radius_m=circle.radius_m,
            cov_m2=own_m2 if shared_m2 is None else own_m2 + shared_m2,
            axis_cov_rad2=own_rad2 if shared_rad2 is None else own_rad2 + shared_rad2,
            frame="camera",
            score=score,
            t_s=frame.t_s,
            shared_m2=shared_m2,
            shared_rad2=shared_rad2,
        )

    def _compute_rig_covariances(
        self, frame: Frame, face: FacePlane, center_m: np.ndarray
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return covariances of centre and normal by the errors of a pair, `None` without one.

        A disparity that is wrong by `c0 + c1 x/z + c2 y/z` shifts the plane in inverse depth by
        `(c1, c2, c0)` over focal length and baseline. No residual shows it, in any frame; the same
        holds of a wrong focal length.
        """
        std_px = self.settings.rig_px if frame.disparity_std_px is None else frame.disparity_std_px
        if frame.baseline_m is None or (frame.right is None and not std_px):
            return None, None
        std_per_m = std_px / (float(frame.camera_matrix[0, 0]) * frame.baseline_m)
        shifted = replace(face, cov=np.eye(3) * std_per_m**2)
        shared_m2, shared_rad2 = shifted.point_cov_m2(center_m, 0.0), shifted.normal_cov_rad2()
        if frame.right is not None:
            by_focal = compute_focal_covariances(center_m, face.normal, self._focal.std)
            shared_m2 = shared_m2 + by_focal[0]
            shared_rad2 = shared_rad2 + by_focal[1]
        return shared_m2, shared_rad2

    def _prepare(self, frame: Frame, masks: Masks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return grey picture, linear light and pixels of the face, cached for a frame's ellipses."""
        if self._seen is None or self._seen[0] is not frame or self._seen[1] is not masks:
            allowed = masks.block > 0.5
            # A mouth shows the inside of the hole, whose depth is not that of the face.
            if masks.hole_mask is not None:
                allowed &= masks.hole_mask < 0.5
            gray = convert_to_gray(frame)
            self._seen = frame, masks, gray, linearize(gray, frame.gamma), allowed
        return self._seen[2:]

    def _check_shape(
        self, face: FacePlane, row: np.ndarray, frame: Frame, ellipse: Ellipse
    ) -> bool | Rejection:
        """Return whether an ellipse has size and shape of a whole rim, or the gate that it misses."""
        s = self.settings
        # The angle at the centre of the ellipse: across a close face it varies by some degrees.
        ray = np.linalg.solve(frame.camera_matrix, np.array([row[0], row[1], 1.0]))
        cosine = -float(face.normal @ ray) / float(np.linalg.norm(ray))
        tilt = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if tilt > s.tilt_rad:
            return Rejection("pose", "tilt of the face, rad", tilt, s.tilt_rad, ellipse)
        chart = rim.build_chart(face.point(ray), face.m, frame.camera_matrix)
        axes = chart.flatten(row)[2:4]
        # The face is seen edge-on: the projection of the ellipse onto it is no ellipse.
        if not np.isfinite(axes).all():
            return Rejection("pose", "axis ratio on the face", 0.0, s.axis_ratio, ellipse)
        radius, ratio = float(np.sqrt(axes[0] * axes[1])), float(axes[1] / axes[0])
        # The less of a rim is visible, the less precise is its ellipse.
        seen = max(1.0 - consistency.measure_hidden_part(face, row, frame), s.coverage)
        tolerance = AT_FIRST * s.radius_tolerance / seen * s.radius_m
        if abs(radius - s.radius_m) > tolerance:
            limit = s.radius_m + np.sign(radius - s.radius_m) * tolerance
            return Rejection("pose", "radius, m", radius, float(limit), ellipse)
        least = 1.0 - AT_FIRST * (1.0 - s.axis_ratio) / seen
        if ratio < least:
            return Rejection("pose", "axis ratio on the face", ratio, least, ellipse)
        return abs(radius / s.radius_m - 1.0) <= s.radius_tolerance and ratio >= s.axis_ratio

    def _check_appearance(
        self,
        inside: Interior,
        parallax: float,
        wall: WallLight | None,
        masks: Masks,
        row: np.ndarray,
        ellipse: Ellipse,
        undecided: bool,
    ) -> Rejection | None:
        """Return the gate that a hole misses, `None` for none; `wall` is known for veiled ones."""
        looks = self.settings.looks

        def refuse(reason: str, value: float, limit: float) -> Rejection:
            return Rejection("pose", reason, value, limit, ellipse)

        if inside.nearer > self.settings.nearer:
            return refuse(consistency.NEARER, inside.nearer, self.settings.nearer)
        # Written as a negation so that NaN, an inside without pixels, is refused too.
        if not inside.darkness <= looks.darkness:
            return refuse("brightness inside over outside", inside.darkness, looks.darkness)
        has_mask = masks.hole_mask is not None
        mouth = 0.0 if masks.hole_mask is None else appearance.average_inside(masks.hole_mask, row)
        if has_mask and mouth < looks.mouth:
            # A mouth probability of 0 with no mask means "not asked", not "no mouth".
            return refuse("mouth probability inside", mouth, looks.mouth)
        is_sure = mouth >= looks.sure_mouth
        evidence = 0.0
        for value in (inside.slope / looks.slope, inside.deeper / looks.deeper):
            # NaN: too little is visible for this measure, which is then evidence neither for nor
            # against.
            if np.isfinite(value):
                evidence += max(value, 0.0)
        # A flat disc differs between the pictures as little as the face: below 1 the parallax is
        # evidence against a hole.
        from_parallax = (parallax - 1.0) / (looks.parallax - 1.0)
        has_parallax = bool(np.isfinite(from_parallax))
        evidence += from_parallax if has_parallax else 0.0
        # Dust and haze brighten the inside; there darkness alone does not decide.
        if wall is not None:
            if is_sure:
                return None
            if inside.around < inside.darkness - looks.darker:
                return refuse("brightness inside over outside", inside.darkness, looks.veiled)
            if has_parallax and from_parallax >= 1.0:
                return None
            if inside.contrast < looks.contrast:
                return refuse("contrast to the grain of the face", inside.contrast, looks.contrast)
            if wall.log_ratio < looks.hole_log_ratio:
                return refuse(IN_DUST, wall.log_ratio, looks.hole_log_ratio)
            return None
        # Nothing can be seen that would decide: the hole passes with a lower score.
        if undecided and not has_parallax and (is_sure or not has_mask):
            return None
        return None if evidence >= 1.0 else refuse("evidence of depth inside", evidence, 1.0)


def convert_to_gray(frame: Frame) -> np.ndarray:
    """Return the frame's picture in grey, `(h, w)` uint8."""
    return cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)


def linearize(gray: np.ndarray, gamma: float) -> np.ndarray:
    """Return the light of a grey picture `(h, w)` uint8, `(h, w)` float32, 255 for white.

    A tone curve moves the steepest place of a blurred edge towards the dark: a rim would become
    smaller, and its centre would move where the hole is not equally dark all around.
    """
    levels = 255.0 * (np.arange(256) / 255.0) ** gamma
    return np.asarray(cv2.LUT(gray, levels.astype(np.float32)))
