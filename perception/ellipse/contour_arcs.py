"""Ellipses from edges: convex arcs, grouped where they lie on one conic, judged by what supports them all around."""

from __future__ import annotations

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from perception.ellipse.arcs import ArcDetector


@spec
class ContourArcs:
    """Ellipses by arc grouping on plain OpenCV: percentile Canny, convex arcs, co-conic groups, support by gradient direction.

    Attributes:
        sigma_px: Blur before the gradient.
        percentile: Of the gradient's magnitude, the upper threshold of the edges.
        noise: Least upper threshold in standard deviations of noise.
        low: Lower threshold as a part of the upper one.
        arc_tolerance_px: Polygon that finds where arcs bend back.
        corner_rad: Turn of that polygon at which an arc ends.
        arc_points: Least number of points of an arc.
        reach_px: How far from an ellipse its edge points may lie, per px of the geometric mean of
            the semi-axes `reach_relative`, at least this.
        reach_relative: See `reach_px`.
        angle_rad: Largest angle between the gradient at a supporting point and the ellipse's
            normal.
        coverage: Least part of the circumference with support.
        gap: Largest part of the circumference without any.
        rms_px: Largest standard deviation of the support's distances, plus `rms_relative` per px of
            the geometric mean semi-axis; for an ellipse seen in part, as large a part of that.
        rms_relative: See `rms_px`.
        wave_px: Deviation of the support's distances in the mean over an eighth of a turn, which
            noise leaves no trace in; together with that of its angles, over this and `wave_rad`, at
            most 1 where half is seen, 2 where all is.
        wave_rad: See `wave_px`; plus `wave_small` over the geometric mean semi-axis in px.
        wave_small: See `wave_rad`.
        angle_rms_rad: Largest standard deviation of the support's angles, plus `angle_rms_small`
            over the geometric mean semi-axis in px; for an ellipse seen in part, as large a part of
            that.
        angle_rms_small: See `angle_rms_rad`.
        purity: Least part of the supporting edges, from corner to corner, that lies on the ellipse.
        departure: Largest part of the circumference where the supporting edges run on beside the
            ellipse, up to their corners (spirals, hearts).
        evidence: Least decimal exponent by which the support is no accident.
        score: Least score of an ellipse that is seen nearly all around; of half of one less than
            half of it will do.
        prior_slack: By how much wider the limits of residual, angle and departure are, and the one
            of purity lower, where a size is
            given: it shuts out most of what else they do, and rims are chipped.
        smallest_px: Least minor semi-axis.
        flattest: Least ratio of the semi-axes.
        prior_flattest: The same where a size is given: what has a known size lies on a face that is
            seen.
    """

    sigma_px: float
    percentile: float
    noise: float
    low: float
    arc_tolerance_px: float
    corner_rad: float
    arc_points: int
    reach_px: float
    reach_relative: float
    angle_rad: float
    coverage: float
    gap: float
    rms_px: float
    rms_relative: float
    wave_px: float
    wave_rad: float
    wave_small: float
    angle_rms_rad: float
    angle_rms_small: float
    purity: float
    departure: float
    evidence: float
    score: float
    prior_slack: float
    smallest_px: float
    flattest: float
    prior_flattest: float

    def check(self) -> None:
        if not 0 < self.percentile < 100 or not 0 < self.low <= 1 or self.sigma_px <= 0:
            raise ConfigError(
                "perception.ellipse.contour_arcs: expected 0 < percentile < 100, 0 < low <= 1 and sigma_px > 0, got "
                f"{self.percentile}, {self.low} and {self.sigma_px}"
            )
        if not 0 < self.coverage <= 1 or self.arc_points < 6:
            raise ConfigError(
                f"perception.ellipse: expected 0 < coverage <= 1 and arc_points >= 6, got {self.coverage} and {self.arc_points}"
            )

    def build(self) -> ArcDetector:
        """Returns a detector."""
        return ArcDetector(self)
