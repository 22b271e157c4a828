"""The detector of `perception.ellipse.contour_arcs`.

It refines, judges and chooses among candidates: whole contours, arcs and groups of arcs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse, SizePrior
from perception.ellipse import conic
from perception.ellipse import edges as ellipse_edges
from perception.ellipse import ends as ellipse_ends
from perception.ellipse import groups as ellipse_groups
from perception.ellipse import support as ellipse_support
from perception.ellipse.edges import Edges
from perception.ellipse.ends import STROKE_PX
from perception.ellipse.support import ANGLES, NUM_SAMPLES, Candidates

if TYPE_CHECKING:
    from perception.ellipse.contour_arcs import ContourArcs

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
class Judged:
    """Candidates that passed, with the figures of `Ellipse` and the edge points behind each, `(C, NUM_SAMPLES)`, -1 for none."""

    candidates: Candidates
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
        edges = ellipse_edges.find(
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
        groups = [arcs[group] for group in ellipse_groups.find(arcs, edges, (4, 3, 2))]
        if limits.lowest_px == 0:
            parts = np.concatenate([parts, _within(arcs, self.settings.arc_points)])
        kinds = (spans[:, None], parts[:, None], *groups)
        seeds = np.concatenate([_seeds(some) for some in kinds])
        lengths = np.concatenate([(some[..., 1] - some[..., 0]).sum(1) for some in kinds])
        first = self.first(seeds, lengths, edges, limits)
        known = np.repeat(
            further[self._sized(further, limits, 1.5)], 2, 0
        )  # dark inside, and bright inside
        first = Candidates(
            np.concatenate([first.ellipses, known]),
            np.concatenate([first.polarity, np.tile([1.0, -1.0], len(known) // 2)]),
        )
        refined = self.refine(first, edges, ROUGH_PX if limits.lowest_px > 0 else ROUNDS_PX)
        return sorted(
            self._chosen(self.judge(refined, edges, limits), edges), key=lambda one: -one[3]
        )

    def _chosen(self, judged: Judged, edges: Edges) -> list[tuple[np.ndarray, float, float, float]]:
        """Returns the candidates that share their support with no better one."""
        claimed = np.zeros(len(edges.points), bool)
        found = []
        for k in np.argsort(-judged.score, kind="stable"):
            mine = judged.support[k][judged.support[k] >= 0]
            one = judged.candidates[k : k + 1]
            if claimed[mine].mean() > 0.4 or _other_side(
                one.ellipses[0], [row for row, *_ in found]
            ):
                continue
            claimed[mine] = True
            number = max(NUM_SAMPLES, int(conic.perimeter(*one.ellipses[0, 2:4])) * 2)
            dense = self._gather(one, edges, np.arange(number) * (2 * np.pi / number))[0][0]
            claimed[dense[dense >= 0]] = True
            found.append((one.ellipses[0], judged.rms_px[k], judged.coverage[k], judged.score[k]))
        return found

    def first(
        self, seeds: np.ndarray, lengths: np.ndarray, edges: Edges, limits: SizePrior
    ) -> Candidates:
        """Returns the candidates of seed points `(C, P)` that lie on an ellipse of a possible size, their gradients all one way.

        The arcs that the seeds stand for have `lengths`, `(C,)` points, which must be a good part
        of the circumference.
        """
        smallest = conic.perimeter(
            np.array(limits.lowest_px / 1.5),
            np.array(limits.lowest_px / 1.5 * self._flattest(limits)),
        )
        seeds, lengths = (some[lengths >= LEAST_ARC * smallest] for some in (seeds, lengths))
        if not len(seeds):
            return Candidates(np.empty((0, 5)), np.empty(0))
        points = edges.points[seeds]
        ellipses = conic.fit(points, np.ones(seeds.shape))
        ellipses = ellipses.copy()
        possible = self._sized(ellipses, limits, 1.5)
        possible &= lengths >= LEAST_ARC * np.nan_to_num(
            conic.perimeter(ellipses[:, 2], ellipses[:, 3])
        )
        ellipses, points, seeds = ellipses[possible], points[possible], seeds[possible]
        off, outward = conic.beside(ellipses, points)
        outward = conic.dot(outward, edges.directions[seeds])
        reach = self._reach(ellipses)
        near = (np.abs(off) < reach[:, None]).mean(1) > 0.5
        keep = near & (np.abs(outward.mean(1)) > 0.5)
        return Candidates(ellipses[keep], np.sign(outward.mean(1))[keep])

    def refine(
        self, candidates: Candidates, edges: Edges, rounds_px: tuple[float, ...]
    ) -> Candidates:
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
            slope = conic.slopes(e, edges.points[support]) * size[:, None]
            robust = 1.0 / (1.0 + (off / scale_px) ** 2 + ((1.0 - along) / 0.05) ** 2) ** 2
            weights = np.where(support >= 0, robust / np.maximum(slope, 1e-3) ** 2, 0.0)
            ellipses = conic.fit(edges.points[support], weights)
            keep = np.isfinite(ellipses).all(1) & (
                (support >= 0).mean(1) >= (HALFWAY if number else LEAST_ARC)
            )
            candidates = Candidates(ellipses[keep], candidates.polarity[keep])
        return candidates

    def judge(self, candidates: Candidates, edges: Edges, limits: SizePrior) -> Judged:
        """Returns the candidates with enough support of the right kind."""
        s = self.settings
        candidates = candidates[
            self._sized(candidates.ellipses, limits, 1.0) & self._inside(candidates.ellipses, edges)
        ]
        e = candidates.ellipses
        if not len(e):
            return Judged(
                candidates, np.empty((0, NUM_SAMPLES), int), np.empty(0), np.empty(0), np.empty(0)
            )
        support, off, along = self._gather(candidates, edges, ANGLES, TIGHT)
        there = support >= 0
        length = conic.sample(e, ANGLES)[2]
        coverage = (length * there).sum(1) / length.sum(1)
        count = np.maximum(there.sum(1), 1)
        rms = np.sqrt((off**2 * there).sum(1) / count)
        spread, angle = (
            ellipse_support.typical(np.abs(off), there),
            ellipse_support.typical(np.arccos(np.clip(along, -1, 1)), there),
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
        wave_px, wave_rad = ellipse_support.waves(candidates, edges, support, off)
        form = np.hypot(
            wave_px / (s.wave_px + s.rms_relative * size * whole),
            wave_rad / (s.wave_rad + s.wave_small / size),
        )
        good &= form <= slack * (1 + whole)
        good &= (
            ellipse_support.evidence(
                coverage, angle, conic.perimeter(e[:, 2], e[:, 3]), s.angle_rad
            )
            >= s.evidence
        )
        candidates, support, length = candidates[good], support[good], length[good]
        rms, spread, coverage, angle = (v[good] for v in (rms, spread, coverage, angle))
        rms_limit, angle_limit = rms_limit[good], angle_limit[good]
        good = ellipse_support.gap(support >= 0, length) <= s.gap
        screened = ellipse_ends.screened(candidates, edges, support, length)
        good &= screened | (ellipse_support.purity(edges, support, length) >= s.purity / slack)
        if limits.lowest_px == 0:
            good &= ellipse_support.strength(edges, support) >= FAINT * np.percentile(
                edges.strength, 95.0
            ) * np.minimum(
                SMALL_PX / np.sqrt(candidates.ellipses[:, 2] * candidates.ellipses[:, 3]), 1.0
            )
            good[good] &= ~ellipse_ends.leaving(
                candidates[good], edges, support[good], length[good]
            )
            good[good] &= screened[good] | ~ellipse_ends.crossed(
                candidates[good], edges, support[good], length[good]
            )
        departure = ellipse_support.departure(
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
        return Judged(candidates[good], support[good], rms[good], coverage[good], score[good])

    def _gather(
        self, candidates: Candidates, edges: Edges, angles_rad: np.ndarray, tight: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return ellipse_support.gather(
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


def _other_side(ellipse: np.ndarray, others: list[np.ndarray]) -> bool:
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


def _within(arcs: np.ndarray, least: int) -> np.ndarray:
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


def _seeds(groups: np.ndarray) -> np.ndarray:
    """Returns evenly spread points of each group of spans `(C, G, 2)`, of each span as many as it is long, `(C, NUM_SEEDS)`."""
    ends = np.cumsum(groups[..., 1] - groups[..., 0], 1)
    place = (np.arange(NUM_SEEDS) + 0.5) / NUM_SEEDS * ends[:, -1:]
    number = (place[..., None] >= ends[:, None]).sum(-1)
    rows = np.arange(len(groups))[:, None]
    before = np.concatenate([np.zeros((len(ends), 1), int), ends], 1)[rows, number]
    return (groups[rows, number, 0] + place - before).astype(int)
