"""Pose of a hole from the plane of the block's face and the circle of the rim on it."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, NoReturn

import cv2
import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.contracts.vision import Ellipse, HolePose, Masks, Rejection
from brokk_rl.errors import ConfigError
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, Share, spec
from perception.ellipse import conic
from perception.pose import alignment, appearance, broken_rim, consistency, plane, rim
from perception.pose.appearance import IN_DUST, Interior, WallLight, measure_wall_light
from perception.pose.consistency import FocalBelief, FocalDoubt, compute_focal_covariances
from perception.pose.plane import FacePlane, FaceSupport
from perception.pose.rim import PlaneChart, RimCircle

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
            raise ConfigError(f"rings: {self.rings} do not increase from inner={self.inner} on")

    def build(self) -> PlaneConicEstimator:
        """Return an estimator."""
        return PlaneConicEstimator(self)


class PlaneConicEstimator:
    """Estimator of the face's plane and the rim on it, with the settings `PlaneConic`."""

    def __init__(self, settings: PlaneConic) -> None:
        self.settings = settings
        self.focal = FocalBelief(settings.focal)
        self._seen: tuple[Frame, Masks, np.ndarray, np.ndarray, np.ndarray] | None = None

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Return the hole in camera coordinates, or why it is none; `frame` has no distortion."""
        prepared = self._prepare(frame, masks)
        self.focal.begin(frame)
        try:
            return _Candidate(self, frame, masks, ellipse, *prepared).estimate()
        except _RefusalError as refused:
            return refused.rejection

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


class _RefusalError(Exception):
    """A candidate misses a gate."""

    def __init__(self, rejection: Rejection) -> None:
        super().__init__(rejection.reason)
        self.rejection = rejection


class _Candidate:
    """One ellipse of a frame; each step raises `_RefusalError` where it misses a gate.

    Args:
        estimator: Gives settings and the belief about the focal length.
        frame: The frame.
        masks: Its masks.
        ellipse: The ellipse.
        gray: Grey picture, `(h, w)` uint8.
        light: Linear light, `(h, w)` float32.
        allowed: Pixels of the face, `(h, w)` bool.
    """

    def __init__(
        self,
        estimator: PlaneConicEstimator,
        frame: Frame,
        masks: Masks,
        ellipse: Ellipse,
        gray: np.ndarray,
        light: np.ndarray,
        allowed: np.ndarray,
    ) -> None:
        self._settings, self._focal = estimator.settings, estimator.focal
        self._frame, self._masks, self._matrix = frame, masks, frame.camera_matrix
        self._gray, self._light, self._allowed = gray, light, allowed
        self._ellipse, self._row = ellipse, conic.as_row(ellipse)
        self._ray = np.linalg.solve(frame.camera_matrix, [ellipse.x, ellipse.y, 1.0])

    def estimate(self) -> HolePose:
        """Return the hole in camera coordinates."""
        s, frame = self._settings, self._frame
        # Inside the hole depth shows no face.
        reach = (s.radius_m, s.inner, s.rings[0], s.rings[-1])
        points = plane.collect_support(
            frame.depth_m, self._allowed, self._matrix, self._row, *reach, s.max_pixels, s.cell_px
        )
        face = from_depth = self._fit_face(points)
        has_good_shape = self._check_shape(face)
        # The right picture gives the plane again, without the bias of the matcher.
        both = alignment.crop_pair(frame, self._gray, face.m, self._row, face.extent)
        if both is not None:
            agreed = alignment.align_plane(
                both, face, frame, self._allowed, self._row, s.inner, s.cell_px
            )
            # `None` says that the pictures disagree: then parallax means nothing either.
            both, face = (None, face) if agreed is None else (both, agreed)
            # A refined plane may turn a plausible ellipse into an implausible one.
            has_good_shape = self._check_shape(face)
        limits = (s.rings[0], s.on_face)
        aside = consistency.check_ring(points, from_depth, limits, both is not None, self._ellipse)
        if aside is not None:
            raise _RefusalError(aside)
        circle = self._fit_circle(face, both, has_good_shape)
        doubt = self._judge_appearance(face, circle, both)
        slip = self._focal.find_slip() if frame.right is not None else None
        if slip is not None:
            self._refuse(consistency.STRETCH, slip, 1.0)
        return self._describe_hole(face, circle, float(self._ellipse.score) * doubt)

    def _refuse(self, reason: str, value: float, limit: float) -> NoReturn:
        raise _RefusalError(Rejection("pose", reason, value, limit, self._ellipse))

    def _fit_face(self, points: FaceSupport) -> FacePlane:
        """Return the plane of the face from depth."""
        s, frame = self._settings, self._frame
        # A fixed seed for each ellipse: the result must not depend on the order of ellipses.
        pair = plane.compare_pair(frame)
        floor_per_m = s.noise_floor_per_m * pair
        face = plane.fit_plane(points, s.rings, floor_per_m, np.random.default_rng(0))
        if face is None:
            num_points = float(len(points.inverse))
            self._refuse("pixels of the face with depth", num_points, float(plane.LEAST))
        # Noise above that of any matcher: the surroundings are no single plane.
        limit_per_m = s.noise_limit_per_m * max(pair, 1.0)
        if face.sigma > limit_per_m:
            self._refuse("depth noise on the face, 1/m", face.sigma, limit_per_m)
        # Errors of neighbouring pixels are alike; those of a coarse match grow with its pixels.
        cov = face.cov * s.matcher_alike * frame.depth_shrink**2
        # A bias of a matcher shifts the whole face, so it enters the constant term alone.
        bias_per_m = s.matcher_bias_per_m * pair * frame.depth_shrink + s.matcher_drift * face.sigma
        return replace(face, cov=cov + np.diag([0.0, 0.0, bias_per_m**2]))

    def _check_shape(self, face: FacePlane) -> bool:
        """Return whether the ellipse has size and shape of a whole rim; others may be hidden in part."""
        s, row = self._settings, self._row
        # The angle at the centre of the ellipse: across a close face it varies by some degrees.
        cosine = -float(face.normal @ self._ray) / float(np.linalg.norm(self._ray))
        tilt = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if tilt > s.tilt_rad:
            self._refuse("tilt of the face, rad", tilt, s.tilt_rad)
        axes = rim.build_chart(face.point(self._ray), face.m, self._matrix).flatten(row)[2:4]
        # The face is seen edge-on: the projection of the ellipse onto it is no ellipse.
        if not np.isfinite(axes).all():
            self._refuse("axis ratio on the face", 0.0, s.axis_ratio)
        radius, ratio = float(np.sqrt(axes[0] * axes[1])), float(axes[1] / axes[0])
        # The less of a rim is visible, the less precise is its ellipse.
        seen = max(1.0 - consistency.measure_hidden_part(face, row, self._frame), s.coverage)
        tolerance = AT_FIRST * s.radius_tolerance / seen * s.radius_m
        if abs(radius - s.radius_m) > tolerance:
            limit = s.radius_m + np.sign(radius - s.radius_m) * tolerance
            self._refuse("radius, m", radius, float(limit))
        least = 1.0 - AT_FIRST * (1.0 - s.axis_ratio) / seen
        if ratio < least:
            self._refuse("axis ratio on the face", ratio, least)
        return abs(radius / s.radius_m - 1.0) <= s.radius_tolerance and ratio >= s.axis_ratio

    def _fit_circle(
        self, face: FacePlane, both: alignment.StereoPatch | None, has_good_shape: bool
    ) -> RimCircle:
        """Return the circle of the rim on the final plane."""
        s, ellipse = self._settings, self._ellipse
        chart = rim.build_chart(face.point(self._ray), face.m, self._matrix)
        # On the plane a circle has only three unknowns.
        circle = rim.fit_rim_circle(
            self._light, self._row, chart, s.radius_m, s.radius_tolerance, s.center_px
        )
        # What is missing of a rim is hidden, or broken off.
        seen = 0.0 if circle is None else circle.coverage
        row = self._row if circle is None else circle.ellipse
        if seen > HALF or ellipse.coverage > WHOLE:
            outline = row if seen > AS_MUCH * ellipse.coverage else self._row
            self._judge_focal_length(chart, face, outline)
        hidden = consistency.measure_hidden_part(face, row, self._frame)
        is_broken = 1.0 - seen - hidden > s.broken
        pair = both if s.broken < 1.0 else None
        if pair is not None and broken_rim.is_below_face(self._light, chart, pair, row):
            # The circle lies below the face: a refusal is better than its place.
            is_broken, circle, seen = True, None, 0.0
        if is_broken:
            broken = broken_rim.fit_broken_rim(
                self._light, chart, both, np.zeros(2), s.radius_m, s.center_px
            )
            # Its coverage counts the broken parts too.
            if broken is not None and broken.coverage >= max(seen, BROKEN_SEEN):
                circle = broken
        # An ellipse of wrong shape, or a region with little border, may still belong to a rim, but
        # then most of the circle must be seen.
        is_sure = has_good_shape and ellipse.coverage >= s.coverage
        least = s.coverage if is_sure else max(s.coverage, FORGIVEN)
        seen = 0.0 if circle is None else circle.coverage
        if circle is None or seen < least:
            self._refuse("part of a circle on the face with a rim", seen, least)
        size = circle.radius_m / s.radius_m
        limit = s.radius_tolerance if is_broken else s.size_agrees
        if abs(size - 1.0) > limit:
            self._refuse(consistency.SIZE, size, 1.0 + float(np.sign(size - 1.0)) * limit)
        return circle

    def _judge_focal_length(self, chart: PlaneChart, face: FacePlane, row: np.ndarray) -> None:
        """Refuse a rim `(5,)` on a face that is round with another focal length of the pair."""
        told = consistency.measure_stretch(self._light, chart, face, row)
        if told is None:
            return
        if self._frame.right is not None:
            std = float(np.hypot(told[1], consistency.measure_tilt_doubt(chart, face)))
            self._focal.learn(row, self._matrix, float(np.log(told[0])), std)
        if abs(np.log(told[0])) > np.log(self._settings.stretch) + 3.0 * told[1]:
            self._refuse(consistency.STRETCH, told[0], 1.0)

    def _judge_appearance(
        self, face: FacePlane, circle: RimCircle, both: alignment.StereoPatch | None
    ) -> float:
        """Return the factor on the score of a rim that looks like a hole."""
        looks, frame, row = self._settings.looks, self._frame, circle.ellipse
        # The first ellipse may follow the shade within: the fitted circle counts.
        inside = appearance.measure_interior(self._light, frame, row, face)
        parallax, covered = float("nan"), 0.0
        if both is not None:
            parts = looks.parts
            parallax, covered = alignment.measure_parallax(both, face, frame.depth_m, row, parts)
        is_veiled = inside.darkness > looks.veiled
        # Behind an occluder, or in dust, hole and disc look the same.
        is_undecided = is_veiled or (covered > UNDECIDED and inside.unknown > UNDECIDED)
        wall = None
        if is_veiled:
            wall = measure_wall_light(self._light, frame, circle, face)
            if covered > COVERED:
                parallax = float("nan")
        self._check_appearance(inside, parallax, wall, row, is_undecided)
        # A network that marks mouths has decided already; without it the doubt stays.
        return UNDECIDED_SCORE if is_undecided and self._masks.hole_mask is None else 1.0

    def _check_appearance(
        self,
        inside: Interior,
        parallax: float,
        wall: WallLight | None,
        row: np.ndarray,
        is_undecided: bool,
    ) -> None:
        """Refuse what is no hole; `wall` is known for veiled ones."""
        looks, mask = self._settings.looks, self._masks.hole_mask
        if inside.nearer > self._settings.nearer:
            self._refuse(consistency.NEARER, inside.nearer, self._settings.nearer)
        # Written as a negation so that NaN, an inside without pixels, is refused too.
        if not inside.darkness <= looks.darkness:
            self._refuse("brightness inside over outside", inside.darkness, looks.darkness)
        # A mouth probability of 0 with no mask means "not asked", not "no mouth".
        mouth = 0.0 if mask is None else appearance.average_inside(mask, row)
        if mask is not None and mouth < looks.mouth:
            self._refuse("mouth probability inside", mouth, looks.mouth)
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
                return
            if inside.around < inside.darkness - looks.darker:
                self._refuse("brightness inside over outside", inside.darkness, looks.veiled)
            if has_parallax and from_parallax >= 1.0:
                return
            if inside.contrast < looks.contrast:
                self._refuse("contrast to the grain of the face", inside.contrast, looks.contrast)
            if wall.log_ratio < looks.hole_log_ratio:
                self._refuse(IN_DUST, wall.log_ratio, looks.hole_log_ratio)
            return
        # Nothing can be seen that would decide: the hole passes with a lower score.
        if is_undecided and not has_parallax and (is_sure or mask is None):
            return
        if not evidence >= 1.0:
            self._refuse("evidence of depth inside", evidence, 1.0)

    def _describe_hole(self, face: FacePlane, circle: RimCircle, score: float) -> HolePose:
        """Return the hole of a rim, with all that its place and axis may be off."""
        bias_per_m = self._settings.bias_per_m * plane.compare_pair(self._frame)
        own_m2 = face.point_cov_m2(circle.center_m, bias_per_m) + circle.cov_m2
        own_rad2 = face.normal_cov_rad2()
        shared_m2, shared_rad2 = self._compute_rig_covariances(face, circle.center_m)
        return HolePose(
            center_m=circle.center_m,
            axis=face.normal,
            radius_m=circle.radius_m,
            cov_m2=own_m2 if shared_m2 is None else own_m2 + shared_m2,
            axis_cov_rad2=own_rad2 if shared_rad2 is None else own_rad2 + shared_rad2,
            frame="camera",
            score=score,
            t_s=self._frame.t_s,
            shared_m2=shared_m2,
            shared_rad2=shared_rad2,
        )

    def _compute_rig_covariances(
        self, face: FacePlane, center_m: np.ndarray
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return covariances of centre and normal by the errors of a pair, `None` without one.

        A disparity that is wrong by `c0 + c1 x/z + c2 y/z` shifts the plane in inverse depth by
        `(c1, c2, c0)` over focal length and baseline. No residual shows it, in any frame; the same
        holds of a wrong focal length.
        """
        frame, std_px = self._frame, self._frame.disparity_std_px
        std_px = self._settings.rig_px if std_px is None else std_px
        if frame.baseline_m is None or (frame.right is None and not std_px):
            return None, None
        std_per_m = std_px / (float(self._matrix[0, 0]) * frame.baseline_m)
        shifted = replace(face, cov=np.eye(3) * std_per_m**2)
        shared_m2, shared_rad2 = shifted.point_cov_m2(center_m, 0.0), shifted.normal_cov_rad2()
        if frame.right is not None:
            by_focal = compute_focal_covariances(center_m, face.normal, self._focal.std)
            shared_m2 = shared_m2 + by_focal[0]
            shared_rad2 = shared_rad2 + by_focal[1]
        return shared_m2, shared_rad2


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
