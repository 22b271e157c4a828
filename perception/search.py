"""Where holes are looked for, how large they look there, and in which resolution that is best seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse, EllipseDetector, SizePrior
from brokk_rl.signals import Frame

STEP = 8
"""Pixels to one of the grid on which regions are put together."""
OCTAVES = 5
"""Resolutions: the full one, half of it, and so on."""
LEAST = 20
"""Pixels of that grid below which a region is an accident of depth."""
AROUND = 1.6
"""Sizes of an ellipse within which the face around it tells how large it may be."""
BEFORE, NOISES = 1.04, 3.0
"""By how many times as near as the face beside it something is that stands before it, and standard
deviations of noise on top."""
NEAR = 2
"""Cells of the grid across which one sees that."""
NOWHERE = 1e6
"""As large as no hole looks, px."""
SPREAD_PX = 8
"""By how much larger than it is a stereo matcher makes what stands before something: its edge lies
within."""
DRAWN_PX = 1
"""Beside what stands before a face: its own edge is there, and those of the face are bent towards
it by the blur."""
HALF = 1.5
"""What shows half of itself must look so many times larger to be known."""
UNSEEN = 3.0
"""Sizes of a hole across which a face may go on where nobody knows the depth: beside an arm, whose
other side one camera sees."""


@dataclass(frozen=True)
class SearchLevel:
    """A part of the picture in which holes look alike large.

    Attributes:
        shrink: Pixels of the picture to one of this level.
        region: Where to look, of the whole picture, on the grid of `STEP`, uint8 of 0 and 1.
        prior: How large a hole may look there, px of the picture; `None` for any size.
        sizes_px: How large a hole would look at each place of the grid of `STEP`, NaN where nobody
            knows; `None` for nowhere.
        slack: By how much the size may be off at a place, as a part of it.
        depth_m: Of the picture, `(h, w)`; `None` if nobody knows.
        nearest_m: Depth before which things stand before the face, at each place of the grid of
            `STEP`, 0 where nothing does.
    """

    shrink: int
    region: np.ndarray
    prior: SizePrior | None
    sizes_px: np.ndarray | None = None
    slack: float = 0.0
    depth_m: np.ndarray | None = None
    nearest_m: np.ndarray | None = None

    def detect(self, detector: EllipseDetector, gray: np.ndarray) -> list[Ellipse]:
        """Return the ellipses of this level that have a possible size where they are, in px of the picture `(h, w)`."""
        return [one for one in self._found(detector, gray) if self._fits(one)]

    def _fits(self, one: Ellipse) -> bool:
        """Says whether a circle of the face around an ellipse could look so large; it does if nobody knows the depth there."""
        if self.sizes_px is None:
            return True
        reach = AROUND * one.a
        rows, columns = (
            slice(max(0, int((at - reach) / STEP)), int((at + reach) / STEP) + 1)
            for at in (one.y, one.x)
        )
        near = self.sizes_px[rows, columns]
        near = near[np.isfinite(near)]
        return not near.size or near.min() / (1.0 + self.slack) <= one.a <= near.max() * (
            1.0 + self.slack
        )

    def _found(self, detector: EllipseDetector, gray: np.ndarray) -> list[Ellipse]:
        x, y, wide, high = cv2.boundingRect(self.region)
        left, top = x * STEP, y * STEP
        height, width = (
            min(size * STEP, whole - start) // self.shrink
            for size, whole, start in ((high, len(gray), top), (wide, len(gray[0]), left))
        )
        if min(height, width) < 1:
            return []
        part = gray[top : top + height * self.shrink, left : left + width * self.shrink]
        small = (
            cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
            if self.shrink > 1
            else part
        )
        finer = (-(-wide * STEP // self.shrink), -(-high * STEP // self.shrink))
        roi = cv2.resize(
            self.region[y : y + high, x : x + wide], finer, interpolation=cv2.INTER_NEAREST
        )[:height, :width]
        part_m = None if self.nearest_m is None else self.nearest_m[y : y + high, x : x + wide]
        if self.depth_m is not None and part_m is not None and part_m.any():
            nearest = cv2.resize(part_m, finer, interpolation=cv2.INTER_NEAREST)[:height, :width]
            middle, step = self.shrink // 2, self.shrink
            depth = self.depth_m[
                top + middle : top + height * step : step,
                left + middle : left + width * step : step,
            ]
            before = cv2.morphologyEx(
                (depth < nearest).view(np.uint8), cv2.MORPH_OPEN, _make_square(1)
            )  # not where it is unknown
            inner = cv2.erode(before, _make_square(-(-SPREAD_PX // step)))
            roi = roi & ((cv2.dilate(before, _make_square(DRAWN_PX)) == 0) | (inner > 0))
        prior = self.prior and SizePrior(
            self.prior.lowest_px / self.shrink, self.prior.highest_px / self.shrink
        )
        return [
            _enlarge(one, self.shrink, left, top)
            for one in detector.detect(small, np.ascontiguousarray(roi).astype(bool), prior)
        ]


def plan_search_levels(
    frame: Frame, mask: np.ndarray, radius_m: float, slack: float, comfortable_px: float
) -> list[SearchLevel]:
    """Return where to look: each part of the block in the coarsest resolution in which a hole there has a good size.

    A circle's major semi-axis is focal length times radius over depth, however it is tilted. What
    is looked at reaches as far
    beyond the mask as a hole is wide: one is a gap of the mask where the segmenter does not count
    it to the block, and lies at its border where something stands before half of it; where depth is
    unknown beside the mask, the face may go on a few times as far.

    Args:
        frame: For depth and camera.
        mask: The block, `(h, w)` bool.
        radius_m: Of the holes.
        slack: By how much the size may be off, as a part of it.
        comfortable_px: Least semi-axis in the chosen resolution.
    """
    focal_px = float(np.sqrt(frame.camera_matrix[0, 0] * frame.camera_matrix[1, 1]))
    depth = frame.depth_m[STEP // 2 :: STEP, STEP // 2 :: STEP]
    inside = mask[STEP // 2 :: STEP, STEP // 2 :: STEP]
    known = inside & np.isfinite(depth)
    if np.count_nonzero(known) < LEAST:
        return [SearchLevel(1, _dilate(inside, 0.03 * inside.shape[1]), None)]
    size_px = np.divide(
        focal_px * radius_m, depth, out=np.zeros(depth.shape, np.float32), where=known
    )
    everywhere_px, unknown = np.where(known, size_px, np.nan), ~np.isfinite(depth)
    before_px = _measure_occluders(
        np.divide(
            focal_px * radius_m, depth, out=np.zeros(depth.shape, np.float32), where=~unknown
        ),
        known,
    )
    behind = size_px < cv2.dilate(
        np.where(before_px < NOWHERE, before_px, np.float32(0.0)), _make_square(1)
    )
    nearest_m = np.where(before_px < NOWHERE, focal_px * radius_m / before_px, np.float32(0.0))
    found, rest = [], known.copy()
    shown_px = np.where(behind, size_px / HALF, size_px)
    suited = [
        _select_sizes(shown_px, comfortable_px * 2**octave, octave) for octave in range(OCTAVES)
    ]
    for _ in range(
        OCTAVES
    ):  # the resolution next that suits most of what is left, the coarser one of two alike
        number = max(
            range(OCTAVES), key=lambda octave: (np.count_nonzero(rest & suited[octave]), octave)
        )
        here = rest & suited[number]
        if np.count_nonzero(here) < LEAST:
            break
        rest &= ~here
        reach = float(np.percentile(size_px[here], 98.0)) * (1.0 + slack) / STEP
        hidden = (_dilate(here, UNSEEN * reach) > 0) & unknown
        count, pieces = cv2.connectedComponents(_dilate(here | hidden, reach))
        for piece in range(1, count):
            part = pieces == piece
            some_px = size_px[part & here]
            if len(some_px) >= LEAST:
                low, high = np.percentile(some_px, (2.0, 98.0))
                prior = SizePrior(float(low) / (1.0 + slack), float(high) * (1.0 + slack))
                found.append(
                    SearchLevel(
                        2**number,
                        part.astype(np.uint8),
                        prior,
                        everywhere_px,
                        slack,
                        frame.depth_m,
                        nearest_m,
                    )
                )
    return found


def merge_levels_to_box(mask: np.ndarray, whole: Sequence[SearchLevel]) -> list[SearchLevel]:
    """Return one level instead, in full resolution: the bounding box of the mask, as large as a hole may be anywhere."""
    x, y, wide, high = cv2.boundingRect(mask.view(np.uint8))
    region = np.zeros([-(-size // STEP) for size in mask.shape], np.uint8)
    region[y // STEP : (y + high - 1) // STEP + 1, x // STEP : (x + wide - 1) // STEP + 1] = 1
    priors = [level.prior for level in whole if level.prior]
    prior = (
        SizePrior(min(p.lowest_px for p in priors), max(p.highest_px for p in priors))
        if priors
        else None
    )
    return [SearchLevel(1, region, prior)]


def _measure_occluders(seen_px: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Return how large a hole looks at least on what stands before a face, `(h, w)`, `NOWHERE` where nothing does.

    Args:
        seen_px: How large it would look at each place, 0 where nobody knows.
        face: Where the faces are, bool.
    """
    reach = _make_square(round(float(np.percentile(seen_px[face], 98.0)) / STEP))
    rough_px, seen_px = seen_px, cv2.medianBlur(seen_px, 5)
    noise = 1.4826 * float(np.median(np.abs(rough_px[face] / np.maximum(seen_px[face], 1.0) - 1.0)))
    around = cv2.dilate(
        np.where(face, seen_px, np.float32(0.0)), reach
    )  # depth within a mouth is no face's
    # where there is a face alone: beyond it, where something hides half of a mouth, nothing but the
    # mouth's depth may be in reach
    around = cv2.erode(np.where(face & (around > 0), around, np.float32(NOWHERE)), reach)
    least = np.float32(BEFORE + NOISES * noise) * cv2.erode(
        np.where(face | (seen_px == 0), around, np.float32(NOWHERE)), _make_square(NEAR)
    )
    there = cv2.dilate((seen_px > least).view(np.uint8), _make_square(1))
    return np.where(there > 0, least, np.float32(NOWHERE))


def _make_square(reach: int) -> np.ndarray:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _select_sizes(size_px: np.ndarray, comfortable_px: float, octave: int) -> np.ndarray:
    """Says which sizes suit a resolution: from the least comfortable one to three times it, and what suits none beyond."""
    low = comfortable_px if octave else 0.0
    return (size_px >= low) & ((size_px < 3.0 * comfortable_px) | (octave == OCTAVES - 1))


def _dilate(small: np.ndarray, reach: float) -> np.ndarray:
    size = 2 * max(1, round(reach)) + 1
    return cv2.dilate(
        small.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    )


def _enlarge(one: Ellipse, factor: int, left: int, top: int) -> Ellipse:
    x, y = ((place + 0.5) * factor - 0.5 + start for place, start in ((one.x, left), (one.y, top)))
    return replace(one, x=x, y=y, a=one.a * factor, b=one.b * factor, rms_px=one.rms_px * factor)
