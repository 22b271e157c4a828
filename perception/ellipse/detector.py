"""Ellipse detector: convex arcs of edges, grouped on one conic, judged by their support."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.spec import Positive, spec
from perception.contracts import SizePrior
from perception.ellipse import conic
from perception.ellipse import edges as ellipse_edges
from perception.ellipse import support as ellipse_support
from perception.ellipse.edges import Edges
from perception.ellipse.support import (
    ANGLES,
    NUM_SAMPLES,
    CandidateFit,
    EllipseCandidates,
    is_other_side_of_line,
    measure_wholeness,
)

# A change of these by 20 % changed no count of drawn patterns, photographs and hidden ellipses.
REACH_RELATIVE = 0.03
"""Reach of an ellipse per px of its geometric mean semi-axis."""
FLATTEST = 0.18
"""Least ratio of the semi-axes where the size is unknown."""
# Each of these times 0.8 or 1.25 left every count of 8 drawn patterns, 3 pictures of hidden discs and
# 6 negatives as it was. SMALLEST_PICTURE_PX, ROUNDING_PX, PRECISE_PX and ROUGH_PX were not varied.
NO_ELLIPSES = np.empty((0, 5))
SMALLEST_PICTURE_PX = 8
"""Smallest side of a picture that can hold an ellipse with its edges."""
FULL_ANGLE_COVERAGE = 0.6
"""Coverage below which the limit of the angles no longer shrinks: there the waviness decides."""
FAINT, SMALL_PX = 0.12, 6.0
"""Least strength of an ellipse of that size, as a part of the strongest edges; it falls with the
size. Faint stains are round all over."""
ROUNDING_PX = 2
"""Addition to the reach within which the nearest edge is looked up, for rounding to pixels."""
LEAST_ARC, HALFWAY = 0.2, 0.3
"""Part of an ellipse from which the rest can be told, and part with support after refinement."""
PRECISE_PX, ROUGH_PX = (1.0, 0.5, 0.3, 0.2), (1.0, 0.5, 0.3)
"""Rounds of refinement: the distance at which a point counts a quarter. The rougher ones serve
where the size is known."""
ANGLE_WEIGHT = 0.05
"""Departure of the cosine between gradient and normal at which a point counts a quarter."""
TAIL = 1.6
"""Limit of the root mean square over that of the robust standard deviation of the distances."""
TIGHT = 0.7
"""Part of the reach that counts once the ellipse is refined."""
SHARED = 0.4
"""Part of its support that an ellipse may share with better ones."""
SEARCH_SLACK = 1.5
"""Factor on the size limits before refinement."""


@spec
class ContourArcs:
    """Find ellipses by grouping convex arcs of edges, judged by the edge points all around.

    Percentile Canny, convex arcs, groups of arcs on one conic, support by gradient direction.

    Attributes:
        sigma_px: Blur before the gradient.
        sigma_noise_px: Largest blur in a noisy picture; a fifth of the least size that is asked for.
        noise_levels: Noise, grey levels, that a blur of 1 px bears; the gradient's falls with the
            square of the blur.
        arc_tolerance_px: Tolerance of the polygon that finds corners and bends.
        corner_rad: Turn of that polygon at which an arc ends.
        arc_points: Least number of points of an arc.
        reach_px: Least reach of an ellipse: how far from it its edge points may lie.
        angle_rad: Largest angle between the gradient at a supporting point and the ellipse's
            normal.
        coverage: Least part of the circumference with support.
        gap: Largest unsupported stretch, as a part of the circumference.
        rms_px: Largest standard deviation of the support's distances, times the coverage.
        rms_relative: Addition to it per px of the geometric mean semi-axis of a whole ellipse.
        wave_px: Largest waviness of the support in distance, plus `rms_relative` as above. Both
            wavinesses together, each over its limit, may reach 1 where half is seen and 2 where
            all is.
        wave_rad: Largest waviness in angle.
        wave_small: Addition to it, over the geometric mean semi-axis in px.
        angle_rms_rad: Largest standard deviation of the support's angles; less for a part.
        angle_rms_small: Addition to it, over the geometric mean semi-axis in px.
        purity: Least part of the supporting edges, corner to corner, that lies on the ellipse.
        evidence: Least decimal exponent of the odds against accidental support.
        score: Least score at full coverage; it falls with the coverage, half of it at one half.
        prior_slack: Factor on the limits of distance and angle, and divisor of purity, where the
            size is known: it excludes most shapes that they are for, and rims are chipped.
        smallest_px: Least minor semi-axis.
        prior_flattest: Least ratio of the semi-axes where the size is known: the tilt of the face
            is limited then.
    """

    sigma_px: Positive
    sigma_noise_px: Positive
    noise_levels: Positive
    arc_tolerance_px: float
    corner_rad: float
    arc_points: Annotated[int, Ge(6)]
    reach_px: float
    angle_rad: float
    coverage: Annotated[float, Interval(gt=0, le=1)]
    gap: float
    rms_px: float
    rms_relative: float
    wave_px: float
    wave_rad: float
    wave_small: float
    angle_rms_rad: float
    angle_rms_small: float
    purity: float
    evidence: float
    score: float
    prior_slack: float
    smallest_px: float
    prior_flattest: float

    def detect(
        self, gray: np.ndarray, roi: np.ndarray | None, prior: SizePrior | None
    ) -> list[Ellipse]:
        """Return ellipses, the best first.

        Args:
            gray: Picture, `(h, w)` uint8.
            roi: Region to search, `(h, w)` bool; `None` for everywhere.
            prior: Range of their size; `None` for any size.
        """
        # Only the box of the region is searched: time is proportional to its area.
        left, top, width, height = (
            (0, 0, *gray.shape[::-1]) if roi is None else cv2.boundingRect(roi.view(np.uint8))
        )
        bottom, right = top + height, left + width
        part = gray[top:bottom, left:right]
        if min(part.shape) < SMALLEST_PICTURE_PX:
            return []
        # Without a prior the picture bounds the size.
        limits = prior or SizePrior(0.0, float(max(part.shape)))
        where = None if roi is None else roi[top:bottom, left:right]
        # The map of nearest edges must cover the reach of the largest ellipse.
        near_px = int(np.ceil(self.limit_reach(limits.highest_px))) + ROUNDING_PX
        blur_px = self._choose_blur(part, limits)
        edges = ellipse_edges.detect_edges(part, where, blur_px, self.arc_points, near_px)
        if edges is None:
            return []
        # An arc of a large ellipse must be long; a short one fits any curvature.
        least = max(self.arc_points, int(0.5 * limits.lowest_px))
        edges = edges.cut(self.arc_tolerance_px, self.corner_rad, least)
        found = _ArcSearch(self, edges, limits).find()
        # Back to the coordinates of the whole picture.
        return [replace(one, x=one.x + left, y=one.y + top) for one in found]

    def _choose_blur(self, gray: np.ndarray, limits: SizePrior) -> float:
        """Return the blur before the gradient, px: in noise more, of which small rims bear little."""
        wanted_px = np.sqrt(estimate_noise(gray) / self.noise_levels)
        highest_px = self.sigma_noise_px
        if limits.lowest_px > 0:
            highest_px = min(highest_px, 0.2 * limits.lowest_px)
        return float(np.clip(wanted_px, self.sigma_px, max(highest_px, self.sigma_px)))

    def limit_reach(self, size_px: np.ndarray | float) -> np.ndarray:
        """Return the reach of ellipses of a geometric mean semi-axis, px."""
        # Proportional to the size, since rims deviate by a share of it; bounded against other
        # edges.
        return np.clip(REACH_RELATIVE * size_px, self.reach_px, 4.0 * self.reach_px)


class _ArcSearch:
    """Search for ellipses on the edges of one picture.

    Args:
        settings: Limits of all gates.
        edges: Edges with their arcs.
        limits: Range of the size; from 0 on where it is unknown.
    """

    def __init__(self, settings: ContourArcs, edges: Edges, limits: SizePrior) -> None:
        self._settings, self._edges, self._limits = settings, edges, limits
        self._is_sized = limits.lowest_px > 0
        self._slack = settings.prior_slack if self._is_sized else 1.0
        self._flattest = settings.prior_flattest if self._is_sized else FLATTEST

    def find(self) -> list[Ellipse]:
        """Return the ellipses of whole contours, single arcs and groups of arcs, the best first."""
        first = self._fit_first(*self._collect_seeds())
        # With a known size few shapes compete, so rough rounds are enough.
        refined = self._refine(first, ROUGH_PX if self._is_sized else PRECISE_PX)
        return sorted(self._judge(refined), key=lambda one: -one.score)

    def _collect_seeds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return seed points `(C, NUM_SEEDS)` of spans, arcs and groups, and their lengths `(C,)`."""
        edges = self._edges
        spans, arcs = self._select_compact(edges.spans), self._select_compact(edges.arcs)
        # An arc that is a whole span would be fitted twice.
        whole = set(map(tuple, spans.tolist()))
        parts = np.array([arc for arc in arcs.tolist() if tuple(arc) not in whole], int)
        parts = parts.reshape(-1, 2)
        # Longer groups first: more arcs determine the ellipse better.
        groups = [arcs[group] for group in ellipse_edges.group_arcs(arcs, edges, (4, 3, 2))]
        # Pieces of arcs only where the size is unknown: elsewhere they add nothing but time.
        if not self._is_sized:
            pieces = ellipse_edges.split_arcs(arcs, self._settings.arc_points)
            parts = np.concatenate([parts, pieces])
        kinds = (spans[:, None], parts[:, None], *groups)
        seeds = np.concatenate([ellipse_edges.select_seed_points(some) for some in kinds])
        lengths = np.concatenate([(some[..., 1] - some[..., 0]).sum(1) for some in kinds])
        return seeds, lengths

    def _fit_first(self, seeds: np.ndarray, lengths: np.ndarray) -> EllipseCandidates:
        """Return candidates of seed points `(C, P)`: of a possible size, with one polarity.

        The arcs behind the seeds have `lengths`, `(C,)` points; they must be a good part of the
        circumference.
        """
        edges, least_px = self._edges, np.array(self._limits.lowest_px / SEARCH_SLACK)
        # The smallest ellipse of the flattest form bounds the length of any arc from below.
        smallest = conic.compute_perimeter(least_px, least_px * self._flattest)
        # Cut before the fit: most seeds are too short, and the fit is the dear part.
        is_long = lengths >= LEAST_ARC * smallest
        seeds, lengths = seeds[is_long], lengths[is_long]
        if not len(seeds):
            return EllipseCandidates(NO_ELLIPSES, np.empty(0), edges)
        points = edges.points[seeds]
        ellipses = conic.fit_ellipses(points, np.ones(seeds.shape))
        possible = self._has_possible_size(ellipses, SEARCH_SLACK)
        perimeter = conic.compute_perimeter(ellipses[:, 2], ellipses[:, 3])
        possible &= lengths >= LEAST_ARC * np.nan_to_num(perimeter)
        ellipses, points, seeds = ellipses[possible], points[possible], seeds[possible]
        off, outward = conic.measure_sampson_distance(ellipses, points)
        # Gradients along the normal on one side: edges of an ellipse are bright all inside or all
        # outside.
        along = conic.sum_products(outward, edges.directions[seeds])
        # More than half of the points, so that one wrong arc of a group does not carry it.
        near = (np.abs(off) < self._reach(ellipses)[:, None]).mean(1) > 0.5
        keep = near & (np.abs(along.mean(1)) > 0.5)
        return EllipseCandidates(ellipses[keep], np.sign(along.mean(1))[keep], edges)

    def _refine(
        self, candidates: EllipseCandidates, rounds_px: tuple[float, ...]
    ) -> EllipseCandidates:
        """Return the candidates fitted again to the edge points that support them.

        Weights turn algebraic errors into distances. From round to round they count less those
        points that lie beside the ellipse, where another edge meets it.
        """
        edges = self._edges
        for number, scale_px in enumerate(rounds_px):
            if not len(candidates.ellipses):
                break
            e = candidates.ellipses
            # All places in the last precise round only; every second one is enough before.
            angles = ANGLES[:: 1 if scale_px == PRECISE_PX[-1] else 2]
            support, off, along = self._gather(candidates, angles)
            # The geometric mean semi-axis: it scales with the picture and does not favour flat
            # ellipses.
            size = np.sqrt(e[:, 2] * e[:, 3])
            # Division by the gradient of the form turns its value into a distance (Sampson).
            slope = conic.measure_form_gradients(e, edges.points[support]) * size[:, None]
            # The square makes far points count by the fourth power less.
            robust = 1.0 / (1.0 + (off / scale_px) ** 2 + ((1.0 - along) / ANGLE_WEIGHT) ** 2) ** 2
            # The bound guards degenerate forms, whose gradient vanishes.
            weights = np.where(support >= 0, robust / np.maximum(slope, 1e-3) ** 2, 0.0)
            ellipses = conic.fit_ellipses(edges.points[support], weights)
            # After the first round an ellipse should have found half of its own edge.
            least = HALFWAY if number else LEAST_ARC
            keep = np.isfinite(ellipses).all(1) & ((support >= 0).mean(1) >= least)
            candidates = EllipseCandidates(ellipses[keep], candidates.polarity[keep], edges)
        return candidates

    def _judge(self, candidates: EllipseCandidates) -> list[Ellipse]:
        """Return the candidates with enough support of the right kind, each rim once."""
        # Sized without slack now: the refined ellipse is final.
        height, width = self._edges.nearest.shape
        x, y = candidates.ellipses[:, :2].T
        is_inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        candidates = candidates[is_inside & self._has_possible_size(candidates.ellipses, 1.0)]
        if not len(candidates.ellipses):
            return []
        fit = self._measure_fit(candidates)
        good = self._has_good_shape(fit)
        # Coverage, distance and angle each scale the score, so that none can make up for another.
        score = (
            fit.coverage
            * np.clip(1 - 0.5 * fit.spread_px / fit.spread_limit_px, 0, 1)
            * np.clip(1 - 0.5 * fit.angle_rad / fit.angle_limit_rad, 0, 1)
        )
        fit, score = fit[good], score[good]
        # Costly gates come last and see only the candidates that passed the others.
        good = self._has_own_edges(fit)
        # A whole ellipse must fit well to count; of half of one its limits are nearly enough.
        share = np.maximum(np.clip(3 * fit.coverage - 1.5, 0.0, 1.0), 0.9 * fit.coverage)
        good &= score * self._slack**2 >= self._settings.score * share
        return self._choose(fit[good], score[good])

    def _measure_fit(self, candidates: EllipseCandidates) -> CandidateFit:
        """Return how well the edges around the candidates fit, with the limits of that."""
        s, e, slack = self._settings, candidates.ellipses, self._slack
        support, off, along = self._gather(candidates, ANGLES, TIGHT)
        # No support has index -1, which must not count as the last edge point.
        there = support >= 0
        length = conic.sample_ellipses(e, ANGLES)[2]
        coverage = (length * there).sum(1) / length.sum(1)
        count = np.maximum(there.sum(1), 1)
        # At least one, so that an unsupported candidate gives zeros and no error.
        size, whole = np.sqrt(e[:, 2] * e[:, 3]), measure_wholeness(coverage)
        seen = np.maximum(coverage, FULL_ANGLE_COVERAGE)
        angles = np.arccos(np.clip(along, -1, 1))
        return CandidateFit(
            candidates=candidates,
            support=support,
            length=length,
            coverage=coverage,
            off_px=off,
            rms_px=np.sqrt((off**2 * there).sum(1) / count),
            spread_px=ellipse_support.estimate_spread(np.abs(off), there),
            spread_limit_px=slack * (s.rms_px * coverage + s.rms_relative * size * whole),
            angle_rad=ellipse_support.estimate_spread(angles, there),
            angle_limit_rad=slack * (s.angle_rms_rad * seen**1.5 + s.angle_rms_small / size * seen),
        )

    def _has_good_shape(self, fit: CandidateFit) -> np.ndarray:
        """Find candidates whose support is long and close enough, and no accident, `(C,)`."""
        s, e = self._settings, fit.candidates.ellipses
        size, whole = np.sqrt(e[:, 2] * e[:, 3]), measure_wholeness(fit.coverage)
        good = fit.coverage >= s.coverage
        good &= fit.spread_px <= fit.spread_limit_px
        good &= fit.rms_px <= TAIL * fit.spread_limit_px
        good &= fit.angle_rad <= fit.angle_limit_rad
        wave_px, wave_rad = ellipse_support.measure_waviness(fit)
        waviness = np.hypot(
            # A fixed part for noise, and a share of the size for rims that are not quite round.
            wave_px / (s.wave_px + s.rms_relative * size * whole),
            wave_rad / (s.wave_rad + s.wave_small / size),
        )
        good &= waviness <= self._slack * (1 + whole)
        perimeter = conic.compute_perimeter(e[:, 2], e[:, 3])
        # The odds grow with the perimeter: a longer support is less of an accident.
        evidence = ellipse_support.compute_evidence(
            fit.coverage, fit.angle_rad, perimeter, s.angle_rad
        )
        return good & (evidence >= s.evidence)

    def _has_own_edges(self, fit: CandidateFit) -> np.ndarray:
        """Find candidates whose edges are theirs alone: those of no spiral, heart or stain, `(C,)`."""
        good = ellipse_support.measure_largest_gap(fit) <= self._settings.gap
        # An occluder explains a corner between the edge and the ellipse.
        is_pure = ellipse_support.measure_purity(fit) >= self._settings.purity / self._slack
        good &= is_pure | ellipse_support.find_occluded(fit)
        if not self._is_sized:
            # A known size excludes the shapes that these two gates are for.
            e = fit.candidates.ellipses
            # The strongest edges tell the contrast of the picture; small ellipses are blurred more.
            faintest = FAINT * np.percentile(self._edges.strength, 95.0)
            faintest = faintest * np.minimum(SMALL_PX / np.sqrt(e[:, 2] * e[:, 3]), 1.0)
            good &= ellipse_support.measure_strength(fit) >= faintest
            good[good] &= ~ellipse_support.find_smooth_continuations(fit[good])
        return good

    def _choose(self, fit: CandidateFit, score: np.ndarray) -> list[Ellipse]:
        """Return the candidates that share little support with better ones."""
        # Points of a better ellipse are claimed: a second ellipse may not live on them.
        claimed = np.zeros(len(self._edges.points), bool)
        found: list[Ellipse] = []
        # A stable order, so that equal scores give the same result everywhere.
        for k in np.argsort(-score, kind="stable"):
            own = fit.support[k][fit.support[k] >= 0]
            candidate = fit.candidates[k : k + 1]
            row = candidate.ellipses[0]
            if claimed[own].mean() > SHARED or is_other_side_of_line(row, found):
                continue
            claimed[own] = True
            # Twice as many places as pixels claim all edge points along the ellipse.
            number = max(NUM_SAMPLES, int(conic.compute_perimeter(*row[2:4])) * 2)
            angles = np.arange(number) * (2 * np.pi / number)
            dense = self._gather(candidate, angles)[0][0]
            claimed[dense[dense >= 0]] = True
            judged = (values[k] for values in (fit.rms_px, fit.coverage, score))
            found.append(Ellipse(*map(float, (*row, *judged))))
        return found

    def _gather(
        self, candidates: EllipseCandidates, angles_rad: np.ndarray, tight: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the support within reach; see `gather_support`."""
        reach_px = tight * self._reach(candidates.ellipses)
        angle_rad = self._settings.angle_rad
        return ellipse_support.gather_support(candidates, angles_rad, reach_px, angle_rad)

    def _reach(self, ellipses: np.ndarray) -> np.ndarray:
        return self._settings.limit_reach(np.sqrt(ellipses[:, 2] * ellipses[:, 3]))

    def _has_possible_size(self, ellipses: np.ndarray, slack: float) -> np.ndarray:
        """Find ellipses of a possible size and flatness, `(C,)`."""
        a, b = ellipses[:, 2], ellipses[:, 3]
        # A failed fit is NaN, compares false and is left out.
        with np.errstate(invalid="ignore"):
            return (
                (a * slack >= self._limits.lowest_px)
                & (a <= self._limits.highest_px * slack)
                & (b * slack >= self._settings.smallest_px)
                & (b * slack >= a * self._flattest)
            )

    def _select_compact(self, spans: np.ndarray) -> np.ndarray:
        """Return the spans that are neither larger nor smaller than a good part of an ellipse."""
        if not len(spans):
            return spans
        # Nine points of a span tell its extent well enough.
        steps = np.linspace(0, 1, 9) * (spans[:, 1:] - 1 - spans[:, :1])
        places = self._edges.points[(spans[:, :1] + steps).astype(int)]
        extent = np.ptp(places, axis=1)
        # An ellipse of semi-axis `a` is at most 2 a long; 10 % allow for the error of the prior.
        fits = extent.max(1) <= 2.2 * self._limits.highest_px
        return spans[fits & (np.hypot(*extent.T) >= 0.5 * self._limits.lowest_px)]


def estimate_noise(gray: np.ndarray) -> float:
    """Return the standard deviation of a picture's noise, grey levels (Immerkær 1996).

    Edges of surfaces cancel in the mask, and the median leaves those of things out.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    away = np.abs(cv2.filter2D(gray, cv2.CV_32F, mask))[::2, ::2]
    # The mask's norm is 6; the median of a normal distribution's absolute value is 0.6745.
    return float(np.median(away)) / (6.0 * 0.6745)
