"""Depth of a pair where it is needed: coarse for the whole picture, fine around places.

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
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception.pose.plane import compute_inverse_depth
from perception.segment.window import Window
from perception.stereo import Stereo, correct_depth

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
