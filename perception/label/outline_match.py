"""Placement of a projected outline: it must fit the picture better than shifted and scaled copies.

The nearest edges of a picture say little: a textured face has one beside every point. The gradient
across an edge of the block keeps its sign along that edge, and the gradients of a texture do not.
Their mean over a stretch of the outline therefore singles out the copy that lies on the edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.label.refinement import Outline

POINTS_PER_STRETCH = 15
"""A quarter of an edge: long enough for a texture to average out, short enough for a background
that changes along the edge; chosen by hand."""
LEAST_STRETCHES = 4
"""Stretches of the outline that a comparison needs; chosen by hand."""
BEND = 0.98
"""Least cosine between neighbouring normals of one stretch: lenses bend an edge less."""
STEP_PX = 1.0
"""Distance of neighbouring copies; edges are blurred over more."""
SCALES = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Growth of the copies, as parts of the reach at the outermost point."""
APART = 0.3
"""Copies farther from the best one than this part of the reach show other places of the picture."""
LEAST_SIGMAS = 5.0
"""Standard deviations by which the best copy must exceed copies elsewhere. On ten rendered frames of
720p the true outline gave 7.9 to 11; eight outlines of ten that lay 60 px beside it gave 3.4 to 5.6.
Pictures of 270 rows gave 5.5 to 7.9 for the true outline."""


@dataclass(frozen=True)
class OutlineMatch:
    """The copy of an outline that fits a picture best.

    Attributes:
        offset_px: Root mean square distance of its points from those of the outline. Of copies
            that fit equally well within one standard error the nearest counts: along a single
            straight edge no distance can be seen.
        num_sigmas: Its gradient over that of copies elsewhere, in standard deviations of theirs.
    """

    offset_px: float
    num_sigmas: float

    @property
    def is_significant(self) -> bool:
        """The best place stands out from the texture."""
        return self.num_sigmas >= LEAST_SIGMAS


def match_outline(outline: Outline, gray: np.ndarray, reach_px: float) -> OutlineMatch | None:
    """Compare an outline with shifted and scaled copies of itself.

    Args:
        outline: Visible points and their normals, in order along the edges.
        gray: The picture, slightly smoothed, `(h, w)` float32.
        reach_px: Largest shift in each direction, and largest growth.

    Returns:
        The best copy, `None` for an outline of too few points.
    """
    stretches = _split_stretches(outline.normal)
    if len(stretches) < LEAST_STRETCHES:
        return None
    points, normal = outline.seen_px, outline.normal.astype(np.float32)
    steps = np.arange(-reach_px, reach_px + STEP_PX / 2, STEP_PX)
    shift = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 1, 2)
    from_middle = points - points.mean(0)
    outermost_px = float(np.linalg.norm(from_middle, axis=1).max())
    slope_x = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    slope_y = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    strength, offset_px = [], []
    for part in SCALES:
        moved = shift + part * reach_px / outermost_px * from_middle
        maps = (points + moved).astype(np.float32)
        across = np.zeros(maps.shape[:2], np.float32)
        for slope, component in ((slope_x, 0), (slope_y, 1)):
            seen = cv2.remap(slope, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
            across += np.asarray(seen) * normal[:, component]
        means = [np.abs(across[:, stretch].mean(1)) for stretch in stretches]
        strength.append(np.stack(means, axis=1))
        offset_px.append(np.sqrt((moved**2).sum(-1).mean(1)))
    return _find_best_copy(np.concatenate(strength), np.concatenate(offset_px), reach_px)


def _find_best_copy(
    strength: np.ndarray, offset_px: np.ndarray, reach_px: float
) -> OutlineMatch | None:
    """Return the best copy; `strength` is `(copies, stretches)`, `offset_px` `(copies,)`."""
    usual = strength.mean(0)
    # A stretch of no contrast at all, as on a saturated picture, says nothing.
    strength = strength[:, usual > 0] / usual[usual > 0]
    num_stretches = strength.shape[1]
    if num_stretches < LEAST_STRETCHES:
        return None
    # Relative strengths: one stretch on a strong shadow must not outvote the others.
    score = strength.mean(1)
    best = int(score.argmax())
    elsewhere = score[np.abs(offset_px - offset_px[best]) > APART * reach_px]
    spread = float(elsewhere.std())
    num_sigmas = float((score[best] - elsewhere.mean()) / spread) if spread > 0 else 0.0
    # Paired over the stretches: all copies share what makes a stretch strong or weak.
    lead = strength[best] - strength
    error = lead.std(1, ddof=1) / np.sqrt(num_stretches)
    as_good = lead.mean(1) <= error
    return OutlineMatch(float(offset_px[as_good].min()), num_sigmas)


def _split_stretches(normal: np.ndarray) -> list[slice]:
    """Return stretches of consecutive points whose normals agree; shorter rests are left out."""
    stretches, begin = [], 0
    for end in range(1, len(normal) + 1):
        bends = end < len(normal) and abs(float(normal[end] @ normal[end - 1])) < BEND
        if end == len(normal) or bends or end - begin == POINTS_PER_STRETCH:
            if end - begin > POINTS_PER_STRETCH // 2:
                stretches.append(slice(begin, end))
            begin = end
    return stretches
