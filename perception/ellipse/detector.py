"""Ellipses from edges: convex arcs, grouped where they lie on one conic, judged by what supports them all around."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse, SizePrior
from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from perception.ellipse import conic
from perception.ellipse import edges as ellipse_edges
from perception.ellipse import support as ellipse_support
from perception.ellipse.edges import Edges
from perception.ellipse.support import ANGLES, NUM_SAMPLES, STROKE_PX, EllipseCandidates


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
                "perception.ellipse: expected 0 < percentile < 100, 0 < low <= 1 and sigma_px > 0, got "
                f"{self.percentile}, {self.low} and {self.sigma_px}"
            )
        if not 0 < self.coverage <= 1 or self.arc_points < 6:
            raise ConfigError(
                f"perception.ellipse: expected 0 < coverage <= 1 and arc_points >= 6, got {self.coverage} and {self.arc_points}"
            )

    def build(self) -> ArcDetector:
        """Returns a detector."""
        return ArcDetector(self)


NUM_SEEDS = 28
"""Points that stand for an arc in its first fit."""
NOTHING = np.empty((0, 5))
PART = 0.6
"""Coverage below which the limit of angles no longer shrinks: what is left is told by how they
change along the arc."""
FAINT, SMALL_PX = 0.12, 6.0
"""Of the strongest edges: so strong that of an ellipse of this size must be, of a larger one less;
faint stains are all round."""
BESIDE_PX = 2
"""By how much farther than within reach the nearest edge is known."""
PIECE = 0.6
"""Of an arc, that may be an ellipse's where not all of it is."""
SAME_AREA = 0.6
"""Two ellipses that differ by no more than a line is wide, and in area by no more than this part,
are its two edges."""
LEAST_ARC, HALFWAY = 0.2, 0.3
"""Part of an ellipse from which the rest of it can be told; part that must support it once it was
refined."""
ROUNDS_PX, ROUGH_PX = (1.0, 0.5, 0.3, 0.2), (1.0, 0.5, 0.3)
"""Rounds of refinement: the distance at which a point counts a quarter; the rougher ones where the
size is known beforehand."""
TAIL = 1.6
"""Of the limit of what is typical, which holds for the residuals of all the support."""
TIGHT = 0.7
"""Of the reach, once the ellipse is refined."""


@dataclass(frozen=True)
class JudgedEllipses:
    """Candidates that passed, with the figures of `Ellipse` and the edge points behind each, `(C, NUM_SAMPLES)`, -1 for none."""

    candidates: EllipseCandidates
    support: np.ndarray
    rms_px: np.ndarray
    coverage: np.ndarray
    score: np.ndarray


class ArcDetector:
    """See `ContourArcs`.

    Args:
        settings: The spec.
        propose: Gives further ellipses `(C, 5)` of a picture `(h, w)`, refined and judged like
            those of the arcs; `None` for none.
    """

    def __init__(
        self, settings: ContourArcs, propose: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> None:
        self.settings = settings
        self._propose = propose

    def detect(
        self, gray: np.ndarray, roi: np.ndarray | None, prior: SizePrior | None
    ) -> list[Ellipse]:
        """Returns ellipses, the best first; see `EllipseDetector`."""
        s = self.settings
        left, top, width, height = (
            (0, 0, *gray.shape[::-1]) if roi is None else cv2.boundingRect(roi.view(np.uint8))
        )
        bottom, right = top + height, left + width
        part = gray[top:bottom, left:right]
        if min(part.shape) < 8:
            return []
        limits = prior or SizePrior(0.0, float(max(part.shape)))
        where = None if roi is None else roi[top:bottom, left:right]
        edges = ellipse_edges.detect_edges(
            part, where, s.sigma_px, s.percentile, s.noise, s.low, s.arc_points, self._near(limits)
        )
        if not len(edges.points):
            return []
        edges = edges.cut(
            s.arc_tolerance_px, s.corner_rad, max(s.arc_points, int(0.5 * limits.lowest_px))
        )
        found = self.on(edges, limits, self._propose(part) if self._propose else NOTHING)
        shift = np.array([left, top, 0.0, 0.0, 0.0])
        return [
            Ellipse(
                *map(float, row + shift),
                rms_px=float(rms),
                coverage=float(cover),
                score=float(score),
            )
            for row, rms, cover, score in found
        ]

    def on(
        self, edges: Edges, limits: SizePrior, further: np.ndarray
    ) -> list[tuple[np.ndarray, float, float, float]]:
        """Returns ellipses with residual, coverage and score: of whole contours, single arcs and groups of arcs, the best first.

        Args:
            edges: Edges with their arcs.
            limits: How large ellipses may be.
            further: Ellipses from elsewhere, `(C, 5)`, that are judged as well.
        """
        spans = self._compact(edges.spans, edges, limits)
        arcs = self._compact(edges.arcs, edges, limits)
        whole = set(map(tuple, spans.tolist()))
        parts = np.array([arc for arc in arcs.tolist() if tuple(arc) not in whole], int).reshape(
            -1, 2
        )
        groups = [arcs[group] for group in ellipse_edges.group_arcs(arcs, edges, (4, 3, 2))]
        if limits.lowest_px == 0:
            parts = np.concatenate([parts, _split_arcs(arcs, self.settings.arc_points)])
        kinds = (spans[:, None], parts[:, None], *groups)
        seeds = np.concatenate([_select_seed_points(some) for some in kinds])
        lengths = np.concatenate([(some[..., 1] - some[..., 0]).sum(1) for some in kinds])
        first = self.first(seeds, lengths, edges, limits)
        known = np.repeat(
            further[self._sized(further, limits, 1.5)], 2, 0
        )  # dark inside, and bright inside
        first = EllipseCandidates(
            np.concatenate([first.ellipses, known]),
            np.concatenate([first.polarity, np.tile([1.0, -1.0], len(known) // 2)]),
        )
        refined = self.refine(first, edges, ROUGH_PX if limits.lowest_px > 0 else ROUNDS_PX)
        return sorted(
            self._chosen(self.judge(refined, edges, limits), edges), key=lambda one: -one[3]
        )

    def _chosen(
        self, judged: JudgedEllipses, edges: Edges
    ) -> list[tuple[np.ndarray, float, float, float]]:
        """Returns the candidates that share their support with no better one."""
        claimed = np.zeros(len(edges.points), bool)
        found = []
        for k in np.argsort(-judged.score, kind="stable"):
            mine = judged.support[k][judged.support[k] >= 0]
            one = judged.candidates[k : k + 1]
            if claimed[mine].mean() > 0.4 or _is_other_side_of_line(
                one.ellipses[0], [row for row, *_ in found]
            ):
                continue
            claimed[mine] = True
            number = max(NUM_SAMPLES, int(conic.compute_perimeter(*one.ellipses[0, 2:4])) * 2)
            dense = self._gather(one, edges, np.arange(number) * (2 * np.pi / number))[0][0]
            claimed[dense[dense >= 0]] = True
            found.append((one.ellipses[0], judged.rms_px[k], judged.coverage[k], judged.score[k]))
        return found

    def first(
        self, seeds: np.ndarray, lengths: np.ndarray, edges: Edges, limits: SizePrior
    ) -> EllipseCandidates:
        """Returns the candidates of seed points `(C, P)` that lie on an ellipse of a possible size, their gradients all one way.

        The arcs that the seeds stand for have `lengths`, `(C,)` points, which must be a good part
        of the circumference.
        """
        smallest = conic.compute_perimeter(
            np.array(limits.lowest_px / 1.5),
            np.array(limits.lowest_px / 1.5 * self._flattest(limits)),
        )
        seeds, lengths = (some[lengths >= LEAST_ARC * smallest] for some in (seeds, lengths))
        if not len(seeds):
            return EllipseCandidates(np.empty((0, 5)), np.empty(0))
        points = edges.points[seeds]
        ellipses = conic.fit_ellipses(points, np.ones(seeds.shape))
        ellipses = ellipses.copy()
        possible = self._sized(ellipses, limits, 1.5)
        possible &= lengths >= LEAST_ARC * np.nan_to_num(
            conic.compute_perimeter(ellipses[:, 2], ellipses[:, 3])
        )
        ellipses, points, seeds = ellipses[possible], points[possible], seeds[possible]
        off, outward = conic.measure_sampson_distance(ellipses, points)
        outward = conic.sum_products(outward, edges.directions[seeds])
        reach = self._reach(ellipses)
        near = (np.abs(off) < reach[:, None]).mean(1) > 0.5
        keep = near & (np.abs(outward.mean(1)) > 0.5)
        return EllipseCandidates(ellipses[keep], np.sign(outward.mean(1))[keep])

    def refine(
        self, candidates: EllipseCandidates, edges: Edges, rounds_px: tuple[float, ...]
    ) -> EllipseCandidates:
        """Returns the candidates fitted again to the edge points that support them.

        Points are weighted so that distances count, not form values, and so that those beside the
        ellipse, where the edge of something else meets it, count less from round to round.
        """
        for number, scale_px in enumerate(rounds_px):
            if not len(candidates.ellipses):
                break
            e = candidates.ellipses
            support, off, along = self._gather(
                candidates, edges, ANGLES[:: 1 if scale_px == ROUNDS_PX[-1] else 2]
            )
            size = np.sqrt(e[:, 2] * e[:, 3])
            slope = conic.measure_form_gradients(e, edges.points[support]) * size[:, None]
            robust = 1.0 / (1.0 + (off / scale_px) ** 2 + ((1.0 - along) / 0.05) ** 2) ** 2
            weights = np.where(support >= 0, robust / np.maximum(slope, 1e-3) ** 2, 0.0)
            ellipses = conic.fit_ellipses(edges.points[support], weights)
            keep = np.isfinite(ellipses).all(1) & (
                (support >= 0).mean(1) >= (HALFWAY if number else LEAST_ARC)
            )
            candidates = EllipseCandidates(ellipses[keep], candidates.polarity[keep])
        return candidates

    def judge(
        self, candidates: EllipseCandidates, edges: Edges, limits: SizePrior
    ) -> JudgedEllipses:
        """Returns the candidates with enough support of the right kind."""
        s = self.settings
        candidates = candidates[
            self._sized(candidates.ellipses, limits, 1.0) & self._inside(candidates.ellipses, edges)
        ]
        e = candidates.ellipses
        if not len(e):
            return JudgedEllipses(
                candidates, np.empty((0, NUM_SAMPLES), int), np.empty(0), np.empty(0), np.empty(0)
            )
        support, off, along = self._gather(candidates, edges, ANGLES, TIGHT)
        there = support >= 0
        length = conic.sample_ellipses(e, ANGLES)[2]
        coverage = (length * there).sum(1) / length.sum(1)
        count = np.maximum(there.sum(1), 1)
        rms = np.sqrt((off**2 * there).sum(1) / count)
        spread, angle = (
            ellipse_support.estimate_spread(np.abs(off), there),
            ellipse_support.estimate_spread(np.arccos(np.clip(along, -1, 1)), there),
        )
        size = np.sqrt(e[:, 2] * e[:, 3])
        whole = np.clip(
            2 * coverage - 1, 0.0, 1.0
        )  # what is seen in part must fit the better: a lobe of a heart nearly does
        slack = s.prior_slack if limits.lowest_px > 0 else 1.0
        seen = np.maximum(coverage, PART)
        rms_limit = slack * (s.rms_px * coverage + s.rms_relative * size * whole)
        angle_limit = slack * (s.angle_rms_rad * seen**1.5 + s.angle_rms_small / size * seen)
        good = (
            (coverage >= s.coverage)
            & (spread <= rms_limit)
            & (rms <= TAIL * rms_limit)
            & (angle <= angle_limit)
        )
        wave_px, wave_rad = ellipse_support.measure_waviness(candidates, edges, support, off)
        form = np.hypot(
            wave_px / (s.wave_px + s.rms_relative * size * whole),
            wave_rad / (s.wave_rad + s.wave_small / size),
        )
        good &= form <= slack * (1 + whole)
        good &= (
            ellipse_support.compute_evidence(
                coverage, angle, conic.compute_perimeter(e[:, 2], e[:, 3]), s.angle_rad
            )
            >= s.evidence
        )
        candidates, support, length = candidates[good], support[good], length[good]
        rms, spread, coverage, angle = (v[good] for v in (rms, spread, coverage, angle))
        rms_limit, angle_limit = rms_limit[good], angle_limit[good]
        good = ellipse_support.measure_largest_gap(support >= 0, length) <= s.gap
        screened = ellipse_support.find_occluded(candidates, edges, support, length)
        good &= screened | (
            ellipse_support.measure_purity(edges, support, length) >= s.purity / slack
        )
        if limits.lowest_px == 0:
            good &= ellipse_support.measure_strength(edges, support) >= FAINT * np.percentile(
                edges.strength, 95.0
            ) * np.minimum(
                SMALL_PX / np.sqrt(candidates.ellipses[:, 2] * candidates.ellipses[:, 3]), 1.0
            )
            good[good] &= ~ellipse_support.find_smooth_continuations(
                candidates[good], edges, support[good], length[good]
            )
            good[good] &= screened[good] | ~ellipse_support.find_inward_outlines(
                candidates[good], edges, support[good], length[good]
            )
        departure = ellipse_support.measure_departure(
            candidates, edges, support, length, self._reach(candidates.ellipses)
        )
        good &= screened | (departure <= s.departure * slack)
        score = (
            coverage
            * np.clip(1 - 0.5 * spread / rms_limit, 0, 1)
            * np.clip(1 - 0.5 * angle / angle_limit, 0, 1)
        )
        # what is seen all around must fit well to count; of half of one little more is asked than
        # its limits ask
        good &= score * slack**2 >= s.score * np.maximum(
            np.clip(3 * coverage - 1.5, 0.0, 1.0), 0.9 * coverage
        )
        return JudgedEllipses(
            candidates[good], support[good], rms[good], coverage[good], score[good]
        )

    def _gather(
        self,
        candidates: EllipseCandidates,
        edges: Edges,
        angles_rad: np.ndarray,
        tight: float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return ellipse_support.gather_support(
            candidates,
            edges,
            angles_rad,
            tight * self._reach(candidates.ellipses),
            self.settings.angle_rad,
        )

    def _sized(self, ellipses: np.ndarray, limits: SizePrior, slack: float) -> np.ndarray:
        a, b = ellipses[:, 2], ellipses[:, 3]
        with np.errstate(invalid="ignore"):
            return (
                (a * slack >= limits.lowest_px)
                & (a <= limits.highest_px * slack)
                & (b * slack >= self.settings.smallest_px)
                & (b * slack >= a * self._flattest(limits))
            )

    def _flattest(self, limits: SizePrior) -> float:
        return self.settings.prior_flattest if limits.lowest_px > 0 else self.settings.flattest

    def _inside(self, ellipses: np.ndarray, edges: Edges) -> np.ndarray:
        """Says which centres lie in the picture."""
        height, width = edges.nearest.shape
        x, y = ellipses[:, 0], ellipses[:, 1]
        return (x >= 0) & (y >= 0) & (x < width) & (y < height)

    def _compact(self, spans: np.ndarray, edges: Edges, limits: SizePrior) -> np.ndarray:
        """Returns the spans that are neither larger nor smaller than a good part of an ellipse can be."""
        if not len(spans):
            return spans
        places = edges.points[
            (spans[:, :1] + np.linspace(0, 1, 9) * (spans[:, 1:] - 1 - spans[:, :1])).astype(int)
        ]
        extent = np.ptp(places, axis=1)
        return spans[
            (extent.max(1) <= 2.2 * limits.highest_px)
            & (np.hypot(*extent.T) >= 0.5 * limits.lowest_px)
        ]

    def _reach(self, ellipses: np.ndarray) -> np.ndarray:
        return self._within_reach(np.sqrt(ellipses[:, 2] * ellipses[:, 3]))

    def _within_reach(self, size_px: np.ndarray | float) -> np.ndarray:
        return np.clip(
            self.settings.reach_relative * size_px,
            self.settings.reach_px,
            4.0 * self.settings.reach_px,
        )

    def _near(self, limits: SizePrior) -> int:
        """Returns how far from an edge an ellipse is asked for it: its reach, and what rounding to pixels takes off."""
        return int(np.ceil(self._within_reach(limits.highest_px))) + BESIDE_PX


def _is_other_side_of_line(ellipse: np.ndarray, others: list[np.ndarray]) -> bool:
    """Says whether an ellipse is one edge of a thin line and another one, found before, the other edge."""
    apart = np.abs(np.array(others).reshape(-1, 5) - ellipse)[:, :4]
    area = ellipse[2] * ellipse[3]
    alike = [min(area, a * b) > SAME_AREA * max(area, a * b) for _, _, a, b, _ in others]
    return bool(
        (
            (apart[:, :2].max(1) < 0.5 * STROKE_PX)
            & (apart[:, 2:].max(1) < STROKE_PX)
            & np.array(alike, bool)
        ).any()
    )


def _split_arcs(arcs: np.ndarray, least: int) -> np.ndarray:
    """Returns first, middle and last piece of each arc, of `least` points or more: its ends may belong to something else."""
    start, length = arcs[:, 0], arcs[:, 1] - arcs[:, 0]
    part = np.maximum((PIECE * length).astype(int), least)
    start, part, left = (some[length > part + 2] for some in (start, part, length - part))
    return np.concatenate(
        [
            np.column_stack([start + shift, start + shift + part])
            for shift in (0 * part, left // 2, left)
        ]
    )


def _select_seed_points(groups: np.ndarray) -> np.ndarray:
    """Returns evenly spread points of each group of spans `(C, G, 2)`, of each span as many as it is long, `(C, NUM_SEEDS)`."""
    ends = np.cumsum(groups[..., 1] - groups[..., 0], 1)
    place = (np.arange(NUM_SEEDS) + 0.5) / NUM_SEEDS * ends[:, -1:]
    number = (place[..., None] >= ends[:, None]).sum(-1)
    rows = np.arange(len(groups))[:, None]
    before = np.concatenate([np.zeros((len(ends), 1), int), ends], 1)[rows, number]
    return (groups[rows, number, 0] + place - before).astype(int)
