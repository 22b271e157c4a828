"""Depth from a rectified pair of pictures: semi-global matching, refined by least squares.

Semi-global matching answers in sixteenths of a pixel and leans towards whole ones: rendered pairs
show a mean error of 0.05 px, which is 6 mm at 4 m and does not average out over a face. A few steps
of Lucas and Kanade's registration (1981), with brightness and contrast free, remove it.

A coarse match of the whole picture is enough to find the block and holes on it. Around each hole
the pictures are matched again, in a narrow band of disparities around its plane. Near places are
matched coarsely, far ones finely, so that a hole is as many pixels wide everywhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.errors import ConfigError
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, Positive, spec
from perception.pose.plane import compute_inverse_depth
from perception.segment.window import Window

_SMOOTH_PX = 0.8
"""Blur of both pictures before refinement: noise would bias the gradient. Chosen by hand."""
_LARGEST_STEP_PX = 0.5
"""Largest step of refinement; longer ones leave the linear range. Chosen by hand."""
_LARGEST_CHANGE_PX = 1.0
"""Total change from which the match was wrong. Chosen by hand."""
_LEAST_SLOPE = 0.01
"""Least mean squared gradient for refinement, (grey levels a pixel)². Chosen by hand."""


@spec
class Stereo:
    """Match a pair semi-globally (Hirschmüller 2008) and refine to sub-pixels.

    Attributes:
        shrink: Pixels of the pictures to one that is matched: 2 takes an eighth of the time. Each
            pixel has the depth of the matched one that covers it.
        nearest_m: Least depth; decides the range of disparities, and so the time.
        window_px: Side of the compared windows; odd.
        smoothness: Factor on the usual penalties for steps and jumps between neighbours.
        uniqueness: Percent by which the best match must beat the second.
        consistency_px: Largest error of the match back from right to left.
        speckle_px: Least pixels of a patch that stands alone in depth; 0 keeps all.
        speckle_range_px: Largest step within such a patch.
        refinements: Steps of least squares; 0 for none.
        refinement_px: Side of the window of a step; odd.
        farthest_m: Largest depth.
    """

    shrink: Count
    nearest_m: Positive
    window_px: Count
    smoothness: float
    uniqueness: int
    consistency_px: int
    speckle_px: int
    speckle_range_px: int
    refinements: int
    refinement_px: Count
    farthest_m: float

    def check(self) -> None:
        if self.nearest_m >= self.farthest_m:
            raise ConfigError(f"nearest_m: {self.nearest_m} is not < farthest_m={self.farthest_m}")
        for name in ("window_px", "refinement_px"):
            if getattr(self, name) % 2 == 0:
                raise ConfigError(f"{name}: expected an odd number, got {getattr(self, name)}")

    def depth_m(
        self, left: np.ndarray, right: np.ndarray, focal_px: float, baseline_m: float
    ) -> np.ndarray:
        """Return the depth of each pixel of the left picture, m, `(h, w)` float32, NaN for unknown.

        Args:
            left: RGB, `(h, w, 3)` uint8.
            right: Its partner; both are rectified.
            focal_px: Focal length.
            baseline_m: Distance between the cameras.
        """
        height, width = left.shape[:2]
        # Matching is done on grey values; colour adds time and little information.
        one = np.asarray(cv2.cvtColor(left, cv2.COLOR_RGB2GRAY))
        other = np.asarray(cv2.cvtColor(right, cv2.COLOR_RGB2GRAY))
        whole = Window(0, 0, width, height)
        pull_px = np.float32(focal_px * baseline_m)
        found = self.match_part(one, other, whole, 0.0, float(pull_px) / self.nearest_m)
        # No disparity is infinitely far; the limits below remove it.
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = pull_px / found
            known = (found > 0) & (depth >= self.nearest_m) & (depth <= self.farthest_m)
        return np.where(known, depth, np.float32(np.nan))

    def match_frame(self, frame: Frame) -> Frame:
        """Return a frame with the depth of its pair; the frame itself if it has depth, or no pair."""
        if frame.right is None or frame.baseline_m is None or np.isfinite(frame.depth_m).any():
            return frame
        focal_px = float(frame.camera_matrix[0, 0])
        depth_m = self.depth_m(frame.color, frame.right, focal_px, frame.baseline_m)
        place = (frame.camera_matrix, frame.baseline_m, frame.disparity_error_px)
        return replace(frame, depth_m=correct_depth(depth_m, *place), depth_shrink=self.shrink)

    def match_part(
        self, left: np.ndarray, right: np.ndarray, part: Window, least_px: float, largest_px: float
    ) -> np.ndarray:
        """Return the disparities of a part of the left picture, px, float32, NaN for unknown.

        Args:
            left: Grey picture, `(h, w)` uint8.
            right: Its partner.
            part: Part of the left picture.
            least_px: Least disparity that is searched.
            largest_px: Largest one.
        """
        width, s = left.shape[1], self.shrink
        columns, rows = max(1, part.width // s), max(1, part.height // s)
        first = int(least_px / s)
        # The matcher wants a multiple of 16, and no more than the picture is wide.
        count = max(1, -(-int(np.ceil(largest_px / s - first)) // 16))
        count = 16 * min(count, max(1, (width // s - 1) // 16))
        # The matcher leaves out a border as wide as the largest disparity: the parts begin earlier,
        # and the matches of that stretch are discarded. That of the right picture is moved by the
        # least disparity.
        begin = part.left - count * s
        size = columns + count, rows
        one, other = (
            shrink_part(picture, start, part.top, size, s)
            for picture, start in ((left, begin), (right, begin - first * s))
        )
        step = self.smoothness * self.window_px**2
        matcher = cv2.StereoSGBM.create(
            minDisparity=0, numDisparities=count, blockSize=self.window_px, P1=round(8 * step), P2=round(32 * step),
            disp12MaxDiff=self.consistency_px, preFilterCap=31, uniquenessRatio=self.uniqueness,
            speckleWindowSize=self.speckle_px, speckleRange=self.speckle_range_px, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip
        found = matcher.compute(one, other).astype(np.float32) / 16.0
        # Left of its border the right picture shows nothing.
        place = part.left // s + np.arange(-count, columns, dtype=np.float32)
        known = (found >= 0) & (found + first > 0) & (place - first - found >= 0)
        known[:, :count] = False
        found = np.where(known, found, np.nan).astype(np.float32)
        if self.refinements:
            found = self._refined(one, other, found)
        return self._enlarge(s * (found[:, count:] + np.float32(first)), part)

    def _enlarge(self, shrunk: np.ndarray, part: Window) -> np.ndarray:
        """Return a map of a part in its full resolution; NaN in a last, incomplete row or column."""
        # Nearest: a mean of two surfaces is a place where nothing is.
        found = shrunk.repeat(self.shrink, 0).repeat(self.shrink, 1) if self.shrink > 1 else shrunk
        found = found[: part.height, : part.width]
        missing = (0, part.height - len(found)), (0, part.width - len(found[0]))
        return np.pad(found, missing, constant_values=np.nan) if np.any(missing) else found

    def _refined(self, left: np.ndarray, right: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Return disparities refined by registration of windows, free in brightness and contrast.

        Each step removes attraction by whole pixels and adds noise to a pixel.
        """
        one = cv2.GaussianBlur(left.astype(np.float32), (0, 0), _SMOOTH_PX)
        other = cv2.GaussianBlur(right.astype(np.float32), (0, 0), _SMOOTH_PX)
        slope = cv2.Sobel(other, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
        x, y = np.meshgrid(*[np.arange(size, dtype=np.float32) for size in left.shape[::-1]])
        known = np.isfinite(start).astype(np.float32)
        counted = np.maximum(self._mean(known), 1e-3)
        found = np.nan_to_num(start)

        def mean(values: np.ndarray) -> np.ndarray:
            return self._mean(values * known) / counted

        mine = mean(one)
        mine_spread = mean(one * one) - mine * mine
        for _ in range(self.refinements):
            seen = cv2.remap(other, x - found, y, cv2.INTER_CUBIC)
            rise = cv2.remap(slope, x - found, y, cv2.INTER_CUBIC)
            theirs, mean_rise = mean(seen), mean(rise)
            spread = mean(seen * seen) - theirs * theirs
            gain = np.sqrt(np.clip(spread / np.maximum(mine_spread, 1e-3), 0.25, 4.0))
            off = gain * (one - mine) - (seen - theirs)
            steep = mean(rise * rise) - mean_rise * mean_rise
            step = -(mean(off * rise) - mean(off) * mean_rise) / np.maximum(steep, 1e-6)
            found = found + np.where(
                steep > _LEAST_SLOPE, np.clip(step, -_LARGEST_STEP_PX, _LARGEST_STEP_PX), 0.0
            )
        # Where the start is unknown the comparison is false.
        near = np.abs(found - start) < _LARGEST_CHANGE_PX
        return np.where(near, found, np.nan).astype(np.float32)

    def _mean(self, values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, -1, (self.refinement_px, self.refinement_px))


def correct_depth(
    depth_m: np.ndarray,
    camera_matrix: np.ndarray,
    baseline_m: float | None,
    error_px: tuple[float, ...],
) -> np.ndarray:
    """Return depth, `(h, w)` float32, without an error `(c0, c1, c2)` of its disparity."""
    if baseline_m is None or not any(error_px):
        return depth_m
    height, width = depth_m.shape
    x = (np.arange(width, dtype=np.float32) - camera_matrix[0, 2]) / camera_matrix[0, 0]
    y = (np.arange(height, dtype=np.float32) - camera_matrix[1, 2]) / camera_matrix[1, 1]
    pull_px = camera_matrix[0, 0] * baseline_m
    constant, across, down = error_px
    wrong = (constant + across * x)[None, :] + (down * y)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        right_px = pull_px / depth_m - wrong
        return np.where(right_px > 0, pull_px / right_px, np.nan).astype(np.float32)


def shrink_part(
    picture: np.ndarray, left: int, top: int, size: tuple[int, int], shrink: int
) -> np.ndarray:
    """Return a part of a picture, `size` columns and rows of `shrink` px each.

    Beyond the picture its border is repeated.
    """
    right, bottom = left + size[0] * shrink, top + size[1] * shrink
    height, width = picture.shape
    part = picture[max(0, top) : max(1, bottom), max(0, min(left, width - 1)) : max(1, right)]
    beyond = (
        max(0, -top),
        max(0, bottom - height),
        min(max(0, -left), size[0] * shrink - 1),
        max(0, right - width),
    )
    if any(beyond):
        part = cv2.copyMakeBorder(part, *beyond, cv2.BORDER_REPLICATE)
    # Averages of whole blocks: both pictures shrink alike, so a disparity only scales.
    return cv2.resize(part, size, interpolation=cv2.INTER_AREA) if shrink > 1 else part


# Chosen by hand on rendered scenes (benchmarks/perception/table.py).
BEHIND_M = 0.3
"""Depth behind the face that is matched too: the inside of a hole."""
BEFORE_M, NEAREST_M = 0.2, 0.3
"""Depth before the face that is matched too, for an arm that hides it; and least depth that is matched
there."""
ON_FACE = 0.03
"""Relative departure of depth from the expected face within which it may be it."""
BAND_PX = 2.0
"""Margin of the band, in pixels of the match."""


@spec
class PairDepth:
    """Match the surroundings of a place as finely as it needs.

    Attributes:
        stereo: The matcher; its `shrink` serves where the whole picture is matched, and is chosen
            for each place elsewhere.
        radius_px: Least major semi-axis of a hole in the pictures that are matched.
        extent: Half the side of the matched square in major semi-axes.
    """

    stereo: Stereo
    radius_px: Positive
    extent: Annotated[float, Ge(1)]

    def match_near(self, frame: Frame, place: Ellipse, m: np.ndarray) -> tuple[Frame, np.ndarray]:
        """Return a frame with depth around one hole, and the pixels of its face, `(h, w)` float32.

        Args:
            frame: A frame with a right picture.
            place: The ellipse of the rim, as expected.
            m: Its face, the plane `m · P = 1`.
        """
        assert frame.right is not None and frame.baseline_m is not None
        pair = [cv2.cvtColor(some, cv2.COLOR_RGB2GRAY) for some in (frame.color, frame.right)]
        pull_px = float(frame.camera_matrix[0, 0]) * frame.baseline_m
        height, width = pair[0].shape
        depth_m = np.full((height, width), np.nan, np.float32)
        face = np.zeros((height, width), np.float32)
        shrink = max(1, int(place.a / self.radius_px))
        part = _build_square(place, self.extent * place.a, shrink, height, width)
        square = np.s_[part.top : part.top + part.height, part.left : part.left + part.width]
        columns = part.left + np.arange(part.width)[None, :]
        rows = part.top + np.arange(part.height)[:, None]
        inverse = compute_inverse_depth(m, frame.camera_matrix, columns, rows)
        near_px, far_px = pull_px * inverse.max(), pull_px * max(inverse.min(), 1e-3)
        least_px = max(0.0, pull_px / (pull_px / far_px + BEHIND_M) - BAND_PX * shrink)
        largest_px = pull_px / max(pull_px / near_px - BEFORE_M, NEAREST_M)
        matcher = replace(self.stereo, shrink=shrink)
        found_px = matcher.match_part(pair[0], pair[1], part, least_px, largest_px)
        depth_m[square] = _convert_to_depth(found_px, frame, part)
        with np.errstate(invalid="ignore"):
            face[square] = np.abs(depth_m[square] * inverse - 1.0) < ON_FACE
        return replace(frame, depth_m=depth_m, depth_shrink=shrink), face


def _convert_to_depth(found_px: np.ndarray, frame: Frame, part: Window) -> np.ndarray:
    """Return the depth of a part, m, from its disparities, without their known error."""
    assert frame.baseline_m is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        found_m = float(frame.camera_matrix[0, 0]) * frame.baseline_m / found_px
    matrix = part.crop_matrix(frame.camera_matrix)
    return correct_depth(found_m, matrix, frame.baseline_m, frame.disparity_error_px)


def _build_square(place: Ellipse, reach_px: float, shrink: int, height: int, width: int) -> Window:
    """Return the square around a place; it begins at a pixel of the shrunk picture."""
    left = int(np.clip(place.x - reach_px, 0, width - 1)) // shrink * shrink
    top = int(np.clip(place.y - reach_px, 0, height - 1)) // shrink * shrink
    right = int(np.clip(place.x + reach_px, 1, width))
    bottom = int(np.clip(place.y + reach_px, 1, height))
    return Window(left, top, max(1, right - left), max(1, bottom - top))
