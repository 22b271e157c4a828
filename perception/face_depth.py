"""Depth around places that may be holes, matched once more in the resolution that they need.

A coarse match of the whole picture is enough to find the block and places on it. Around each of
them the pictures are matched again, in a narrow band of disparities around the coarse ones: near
places coarsely, far ones finely, so that a hole is as many pixels wide everywhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception.calibrate.disparity_error import correct_depth
from perception.stereo import PicturePart, Stereo

# Chosen by hand on rendered scenes (benchmarks/perception/table.py).
LEAST = 50
"""Pixels of coarse depth on the block around a place from which its band is known."""
OUTER = 1.0, 99.0
"""Percentiles of these disparities between which the face lies."""
BEHIND_M = 0.3
"""Depth behind the face that is matched too: the inside of a hole."""
BAND_PX = 2.0
"""Margin of the band, and largest change, in pixels of the coarse match."""


@spec
class FaceDepth:
    """Match the surroundings of a place again where the depth of a frame is too coarse for it.

    Attributes:
        stereo: The matcher; its `shrink` is chosen for each place.
        radius_px: Least major semi-axis of a hole in the pictures that are matched.
        extent: Half the side of the matched square in major semi-axes.
    """

    stereo: Stereo
    radius_px: Positive
    extent: Annotated[float, Ge(1)]

    def build(self, frame: Frame, on_block: np.ndarray) -> FaceMatcher | None:
        """Return the matcher of a frame; `None` where its depth is fine enough, or has no pair.

        Args:
            frame: The frame; it is not changed.
            on_block: Pixels of the block, `(h, w)` bool.
        """
        if frame.right is None or frame.baseline_m is None or frame.depth_shrink == 1:
            return None
        return FaceMatcher(self, frame, frame.right, frame.baseline_m, on_block)


class FaceMatcher:
    """Depth of one frame, which grows finer place by place."""

    def __init__(
        self,
        settings: FaceDepth,
        frame: Frame,
        right: np.ndarray,
        baseline_m: float,
        on_block: np.ndarray,
    ) -> None:
        self._settings, self._coarse, self._on_block = settings, frame, on_block
        self._baseline_m = baseline_m
        self._pair = [cv2.cvtColor(some, cv2.COLOR_RGB2GRAY) for some in (frame.color, right)]
        # One frame for each resolution: those who look at it keep what they computed of it.
        self._fine: dict[int, Frame] = {}
        self._matched: dict[int, list[PicturePart]] = {}

    def match_around(self, place: Ellipse) -> Frame:
        """Return the frame with depth as fine around a place as it needs."""
        coarse = self._coarse
        shrink = max(1, int(place.a / self._settings.radius_px))
        if shrink >= coarse.depth_shrink:
            return coarse
        if shrink not in self._fine:
            own = replace(coarse, depth_m=coarse.depth_m.copy(), depth_shrink=shrink)
            self._fine[shrink], self._matched[shrink] = own, []
        # A place near the middle of a matched square needs no other one.
        if not any(_is_central(place, part) for part in self._matched[shrink]):
            part = self._enclose(place, shrink)
            self._matched[shrink].append(part)
            self._match(part, shrink)
        return self._fine[shrink]

    def _enclose(self, place: Ellipse, shrink: int) -> PicturePart:
        """Return the square around a place; it begins at a pixel of the shrunk picture."""
        height, width = self._on_block.shape
        reach = self._settings.extent * place.a
        left, top = (
            int(np.clip(middle - reach, 0, size - 1)) // shrink * shrink
            for middle, size in ((place.x, width), (place.y, height))
        )
        right, bottom = (
            int(np.clip(middle + reach, 1, size))
            for middle, size in ((place.x, width), (place.y, height))
        )
        return PicturePart(left, top, max(1, right - left), max(1, bottom - top))

    def _match(self, part: PicturePart, shrink: int) -> None:
        """Match a part; its depth counts where it agrees with the coarse one.

        Outside the band, on an occluder or deep inside a hole, the coarse depth stays.
        """
        coarse, matcher = self._coarse, replace(self._settings.stereo, shrink=shrink)
        pull_px = float(coarse.camera_matrix[0, 0]) * self._baseline_m
        square = np.s_[part.top : part.top + part.height, part.left : part.left + part.width]
        before_m = coarse.depth_m[square]
        with np.errstate(divide="ignore", invalid="ignore"):
            before_px = pull_px / before_m
        face_px = before_px[self._on_block[square] & np.isfinite(before_px)]
        if len(face_px) < LEAST:
            return
        far_px, near_px = np.percentile(face_px, OUTER)
        room_px = BAND_PX * coarse.depth_shrink
        least_px = max(0.0, pull_px / (pull_px / far_px + BEHIND_M) - room_px)
        largest_px = near_px + room_px
        found_px = matcher.match_part(self._pair[0], self._pair[1], part, least_px, largest_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            found_m = pull_px / found_px
            if any(coarse.disparity_error_px):
                corner = np.array([[0.0, 0.0, part.left], [0.0, 0.0, part.top], [0.0, 0.0, 0.0]])
                found_m = correct_depth(
                    found_m,
                    coarse.camera_matrix - corner,
                    self._baseline_m,
                    coarse.disparity_error_px,
                )
            differs = np.abs(pull_px / found_m - before_px) > room_px
            outside = (before_px < least_px) | (before_px > largest_px)
        # Where either is unknown, both comparisons are false: the fine match decides.
        self._fine[shrink].depth_m[square] = np.where(differs | outside, before_m, found_m)


def _is_central(place: Ellipse, part: PicturePart) -> bool:
    """Return whether a place lies in the middle third of a part."""
    x = (place.x - part.left) / part.width
    y = (place.y - part.top) / part.height
    return 1 / 3 < x < 2 / 3 and 1 / 3 < y < 2 / 3
