"""Search levels: where holes may be, how large they look there, and the resolution to search in."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.signals import Frame
from perception.contracts import SizePrior
from perception.ellipse.detector import ContourArcs
from perception.robust_fit import estimate_spread

# Chosen by hand on rendered scenes (benchmarks/perception/table.py), unless a comment says
# otherwise.
STEP = 8
"""Pixels of the picture to a cell of the grid on which regions are built."""
OCTAVES = 5
"""Resolutions: the full one, half of it, and so on."""
LEAST_CELLS = 20
"""Cells below which a region is an accident of depth."""
DEPTH_REACH = 1.6
"""Major semi-axes around an ellipse within which the depth of the face limits its size."""
OCCLUDER_RATIO, OCCLUDER_SIGMAS = 1.04, 3.0
"""Ratio of inverse depths, and standard deviations of noise on top, from which something is an
occluder of the face beside it."""
OCCLUDER_CELLS = 2
"""Cells across which that is compared."""
HUGE_PX = 1e6
"""Larger than any hole looks, px."""
SPREAD_PX = 8
"""Width by which a stereo matcher enlarges an occluder: its true edge lies within."""
DRAWN_PX = 1
"""Margin beside an occluder in which its own edge and its blur lie."""
HALF_HIDDEN = 1.5
"""Factor on the size from which a hole that is half occluded is found: 2 finds little more and
takes three times as long."""
SIZE_PERCENTILES = 2.0, 98.0
"""Percentiles of the sizes in a region that limit the size of its holes."""


@dataclass(frozen=True)
class SearchLevel:
    """A part of the picture in which holes look similarly large.

    Attributes:
        shrink: Pixels of the picture to one of this level.
        region: Cells to search, uint8 of 0 and 1, on the grid of the whole picture.
        prior: Range of the size of a hole, px of the picture; `None` for any size.
        sizes_px: Size of a hole at each cell, NaN where depth is unknown; `None` for all unknown.
        slack: Allowed relative error of that size.
        depth_m: Depth of the picture, `(h, w)`; `None` if unknown.
        nearest_m: Depth at each cell below which something is an occluder, 0 for no occluder.
    """

    shrink: int
    region: np.ndarray
    prior: SizePrior | None
    sizes_px: np.ndarray | None = None
    slack: float = 0.0
    depth_m: np.ndarray | None = None
    nearest_m: np.ndarray | None = None

    def find_missed_limit(self, one: Ellipse) -> float | None:
        """Return the limit that the size of an ellipse misses where it lies, px; `None` for none.

        Where the depth of the face is unknown, any size is possible.
        """
        if self.sizes_px is None:
            return None
        # An ellipse may lie on the border of two depths; one of them must allow its size.
        reach = DEPTH_REACH * one.a
        rows = slice(max(0, int((one.y - reach) / STEP)), int((one.y + reach) / STEP) + 1)
        columns = slice(max(0, int((one.x - reach) / STEP)), int((one.x + reach) / STEP) + 1)
        near = self.sizes_px[rows, columns]
        # No depth near the ellipse: nothing speaks against its size.
        near = near[np.isfinite(near)]
        if not near.size:
            return None
        lowest, highest = near.min() / (1.0 + self.slack), near.max() * (1.0 + self.slack)
        if one.a < lowest:
            return float(lowest)
        return float(highest) if one.a > highest else None

    def detect(self, detector: ContourArcs, gray: np.ndarray) -> list[Ellipse]:
        """Return the ellipses of the region in px of the picture `(h, w)`, whatever their size there."""
        # Only the bounding box is searched: the cost of the detector is proportional to its area.
        x, y, wide, high = cv2.boundingRect(self.region)
        left, top = x * STEP, y * STEP
        height = min(high * STEP, len(gray) - top) // self.shrink
        width = min(wide * STEP, len(gray[0]) - left) // self.shrink
        if min(height, width) < 1:
            return []
        part = gray[top : top + height * self.shrink, left : left + width * self.shrink]
        # Area interpolation averages, so that grain does not alias into edges.
        small = part
        if self.shrink > 1:
            small = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
        # Rounded up, so that every cell has pixels; the surplus is cut off below.
        finer = (-(-wide * STEP // self.shrink), -(-high * STEP // self.shrink))
        roi = cv2.resize(
            self.region[y : y + high, x : x + wide], finer, interpolation=cv2.INTER_NEAREST
        )[:height, :width]
        # The grid of occluders is cut to the same box as the picture.
        part_m = None if self.nearest_m is None else self.nearest_m[y : y + high, x : x + wide]
        if self.depth_m is not None and part_m is not None and part_m.any():
            nearest = cv2.resize(part_m, finer, interpolation=cv2.INTER_NEAREST)[:height, :width]
            middle, step = self.shrink // 2, self.shrink
            depth = self.depth_m[
                top + middle : top + height * step : step,
                left + middle : left + width * step : step,
            ]
            # The edges of an occluder are no rims: search neither along them nor in their blur.
            # Unknown depth compares false.
            before = cv2.morphologyEx(
                (depth < nearest).view(np.uint8), cv2.MORPH_OPEN, _make_square(1)
            )
            # A wide occluder hides holes only at its border: its own surface is searched like any
            # other.
            inner = cv2.erode(before, _make_square(-(-SPREAD_PX // step)))
            roi = roi & ((cv2.dilate(before, _make_square(DRAWN_PX)) == 0) | (inner > 0))
        prior = self.prior and SizePrior(
            self.prior.lowest_px / self.shrink, self.prior.highest_px / self.shrink
        )
        found = detector.detect(small, np.ascontiguousarray(roi).astype(bool), prior)
        return [_enlarge(one, self.shrink, left, top) for one in found]


def plan_search_levels(
    frame: Frame, mask: np.ndarray, radius_m: float, slack: float, comfortable_px: float
) -> list[SearchLevel]:
    """Return the levels to search: each part of the block in the coarsest resolution that suits it.

    The major semi-axis of a circle is focal length times radius over depth, however it is tilted.
    The search reaches beyond the mask by the size of a hole: a hole may be a gap of the mask, or
    lie at its border where something hides half of it.

    Args:
        frame: Frame with depth and camera matrix.
        mask: Block, `(h, w)` bool.
        radius_m: Radius of the holes.
        slack: Allowed relative error of their size.
        comfortable_px: Least semi-axis in the chosen resolution.
    """
    # The geometric mean serves for pixels that are not quite square.
    focal_px = float(np.sqrt(frame.camera_matrix[0, 0] * frame.camera_matrix[1, 1]))
    # The middle of each cell stands for the cell: reading every pixel would take 64 times as
    # long.
    depth = frame.depth_m[STEP // 2 :: STEP, STEP // 2 :: STEP]
    inside = mask[STEP // 2 :: STEP, STEP // 2 :: STEP]
    known = inside & np.isfinite(depth)
    if np.count_nonzero(known) < LEAST_CELLS:
        # Without depth any size is possible, so the whole block is searched at full resolution. A
        # margin of 3 % of the width covers a ragged mask. Chosen by hand; not searched.
        return [SearchLevel(1, _dilate(inside, 0.03 * inside.shape[1]), None)]
    # Division only where depth is known: NaN would spread through the filters below.
    size_px = np.divide(
        focal_px * radius_m, depth, out=np.zeros(depth.shape, np.float32), where=known
    )
    everywhere_px, unknown = np.where(known, size_px, np.nan), ~np.isfinite(depth)
    seen_px = np.divide(
        focal_px * radius_m, depth, out=np.zeros(depth.shape, np.float32), where=~unknown
    )
    # Occluders are found by size too: inverse depth and size are proportional.
    before_px = _measure_occluders(seen_px, known)
    # Beside an occluder a hole may show only half of itself: search there in a finer resolution.
    # Dilated by one cell: the border of an occluder falls between two cells.
    beside = cv2.dilate(np.where(before_px < HUGE_PX, before_px, np.float32(0.0)), _make_square(1))
    behind = size_px < beside
    nearest_m = np.where(before_px < HUGE_PX, focal_px * radius_m / before_px, np.float32(0.0))
    found, rest = [], known.copy()
    shown_px = np.where(behind, size_px / HALF_HIDDEN, size_px)
    # Each octave suits a range of sizes; a cell may suit two of them.
    suited = []
    for octave in range(OCTAVES):
        suited.append(_select_sizes(shown_px, comfortable_px * 2**octave, octave))
    for _ in range(OCTAVES):
        # Next is the resolution that suits most of the rest; of two the coarser one.
        counts = [np.count_nonzero(rest & one) for one in suited]
        number = max(range(OCTAVES), key=lambda octave: (counts[octave], octave))
        here = rest & suited[number]
        if np.count_nonzero(here) < LEAST_CELLS:
            break
        # Cells that have found their resolution are not searched again in another.
        rest &= ~here
        for piece, prior in _split_region(here, size_px, slack):
            level = SearchLevel(
                2**number, piece, prior, everywhere_px, slack, frame.depth_m, nearest_m
            )
            found.append(level)
    return found


def _split_region(
    here: np.ndarray, size_px: np.ndarray, slack: float
) -> list[tuple[np.ndarray, SizePrior]]:
    """Return the connected regions around cells, uint8, each with its range of sizes.

    Args:
        here: Cells of one resolution, bool.
        size_px: Size of a hole at each cell.
        slack: Allowed relative error of the size.
    """
    # The upper percentile and not the maximum: one wrong depth must not enlarge the region.
    reach = float(np.percentile(size_px[here], SIZE_PERCENTILES[1])) * (1.0 + slack) / STEP
    # Separate regions get separate ranges of size: two blocks at two distances do not share one.
    count, pieces = cv2.connectedComponents(_dilate(here, reach))
    found = []
    for piece in range(1, count):
        part = pieces == piece
        some_px = size_px[part & here]
        if len(some_px) >= LEAST_CELLS:
            low, high = np.percentile(some_px, SIZE_PERCENTILES)
            prior = SizePrior(float(low) / (1.0 + slack), float(high) * (1.0 + slack))
            found.append((part.astype(np.uint8), prior))
    return found


def _measure_occluders(seen_px: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Return the least size of a hole on an occluder of a face, `(h, w)`, `HUGE_PX` for no occluder.

    Args:
        seen_px: Size of a hole at each cell, 0 for unknown depth.
        face: Cells of the faces, bool.
    """
    reach = _make_square(round(float(np.percentile(seen_px[face], SIZE_PERCENTILES[1])) / STEP))
    # The median removes single cells; an occluder is wider than two of them.
    rough_px, seen_px = seen_px, cv2.medianBlur(seen_px, 5)
    noise = estimate_spread(rough_px[face] / np.maximum(seen_px[face], 1.0) - 1.0)
    # A closing over the size of a hole: depth inside a hole is not that of the face. Only on the
    # face: beyond it nothing but the inside of a half-hidden hole may be in reach.
    around = cv2.dilate(np.where(face, seen_px, np.float32(0.0)), reach)
    around = cv2.erode(np.where(face & (around > 0), around, np.float32(HUGE_PX)), reach)
    least = np.float32(OCCLUDER_RATIO + OCCLUDER_SIGMAS * noise) * cv2.erode(
        np.where(face | (seen_px == 0), around, np.float32(HUGE_PX)), _make_square(OCCLUDER_CELLS)
    )
    there = cv2.dilate((seen_px > least).view(np.uint8), _make_square(1))
    return np.where(there > 0, least, np.float32(HUGE_PX))


def _make_square(reach: int) -> np.ndarray:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _select_sizes(size_px: np.ndarray, comfortable_px: float, octave: int) -> np.ndarray:
    """Find sizes that suit a resolution: up to three times the comfortable one, the rest beyond."""
    low = comfortable_px if octave else 0.0
    return (size_px >= low) & ((size_px < 3.0 * comfortable_px) | (octave == OCTAVES - 1))


def _dilate(small: np.ndarray, reach: float) -> np.ndarray:
    size = 2 * max(1, round(reach)) + 1
    return cv2.dilate(
        small.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    )


def _enlarge(one: Ellipse, factor: int, left: int, top: int) -> Ellipse:
    x = (one.x + 0.5) * factor - 0.5 + left
    y = (one.y + 0.5) * factor - 0.5 + top
    return replace(one, x=x, y=y, a=one.a * factor, b=one.b * factor, rms_px=one.rms_px * factor)
