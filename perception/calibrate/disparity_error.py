"""Error of a pair's disparity, measured on a board: its size in the left picture tells its distance.

The disparity of a corner at depth z is focal length times baseline over z. A board seen by the left
camera alone gives the same quotient without the focal length: picture size over true size. What the
pair shows beyond it is a constant and two slopes across the picture, which stay the same at all
distances, and a part that grows with the disparity: a wrong baseline, or a board printed too large.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from perception.label.camera_pose import Charuco, match_corners
from perception.robust_fit import TUKEY, compute_biweight, estimate_spread

MIN_VIEWS = 8
"""Views from which four numbers are estimated; chosen by hand."""
MIN_RANGE = 1.3
"""Largest disparity over the smallest: at one distance a constant looks like a wrong baseline."""
SLOPE_STD_PX = 0.25
"""Prior of the slopes, px for a unit of x/z and y/z: that of `perception.pose.rig_px`."""
SCALE_STD = 0.002
"""Prior of the part that grows with the disparity: 0.2 mm of 10 cm on paper; chosen by hand."""
ROUNDS = 5
"""Rounds of reweighting."""
PLACE = 0.02
"""Views that differ by less, in x/z, y/z and relative distance, are of one rest; by hand."""
FLOOR_PX = 0.02
"""Least standard deviation of a view's mean: corners share a bias of the detector; by hand."""


@dataclass(frozen=True)
class BoardDisparity:
    """Means over the corners of one view.

    Attributes:
        excess_px: Measured less expected disparity.
        expected_px: Expected disparity.
        x: Coordinate x/z.
        y: Coordinate y/z.
    """

    excess_px: float
    expected_px: float
    x: float
    y: float


@dataclass(frozen=True)
class DisparityError:
    """Error of the disparity: `c0 + c1 x/z + c2 y/z`.

    Attributes:
        px: `(c0, c1, c2)`.
        std_px: Largest standard deviation of the three.
        scale: Part that grows with the disparity; not corrected, since board and baseline are
            equally likely.
        num_views: Views that it rests on.
    """

    px: tuple[float, float, float]
    std_px: float
    scale: float
    num_views: int

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data, rounded."""
        return {
            "error_px": [round(one, 4) for one in self.px],
            "std_px": round(self.std_px, 4),
            "scale": round(self.scale, 6),
            "num_views": self.num_views,
        }


def measure_board_disparity(
    board: Charuco,
    frame: Frame,
    corners_m: np.ndarray,
    corners_px: np.ndarray,
    camera_from_board: np.ndarray,
) -> BoardDisparity | None:
    """Return the disparity of a board in one frame; `None` without a right picture that shows it.

    Args:
        board: The board.
        frame: A rectified frame.
        corners_m: Corners on the board, `(n, 3)`, found in the left picture.
        corners_px: The same in the left picture, `(n, 2)`.
        camera_from_board: Pose of the board by the left picture, `(4, 4)`.
    """
    if frame.right is None or frame.baseline_m is None or frame.distortion is not None:
        return None
    try:
        others_m, others_px = board.find_corners(replace(frame, color=frame.right))
    except FrameError:
        return None
    mine, theirs = match_corners(corners_m, others_m)
    if not len(mine):
        return None
    point = corners_m[mine] @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
    expected = frame.camera_matrix[0, 0] * frame.baseline_m / point[:, 2]
    x, y = (point[:, :2] / point[:, 2:]).mean(0)
    excess = float(np.mean(corners_px[mine, 0] - others_px[theirs, 0] - expected))
    return BoardDisparity(excess, float(expected.mean()), float(x), float(y))


def estimate_disparity_error(views: list[BoardDisparity]) -> DisparityError | None:
    """Return the error that views of a board at several distances agree on.

    Returns:
        `None` for fewer than `MIN_VIEWS` places of the board, or for one that is always as far
        away.
    """
    views = _merge_rests(views)
    if len(views) < MIN_VIEWS:
        return None
    expected = np.array([one.expected_px for one in views])
    if expected.max() < MIN_RANGE * expected.min():
        return None
    excess = np.array([one.excess_px for one in views])
    design = np.array([[1.0, one.x, one.y, one.expected_px] for one in views])
    prior = np.diag([0.0, SLOPE_STD_PX**-2, SLOPE_STD_PX**-2, SCALE_STD**-2])
    weight, scale_px = np.ones(len(views)), 1.0
    solution, information = np.zeros(4), prior
    for _ in range(ROUNDS):
        information = design.T @ (design * weight[:, None]) / scale_px**2 + prior
        solution = np.linalg.solve(information, design.T @ (weight * excess) / scale_px**2)
        away = excess - design @ solution
        # Four numbers are spent on the fit.
        spent = len(views) / (len(views) - 4)
        scale_px = max(estimate_spread(away) * spent**0.5, FLOOR_PX)
        weight = compute_biweight(away, TUKEY * scale_px)
    std_px = float(np.sqrt(np.diag(np.linalg.inv(information))[:3].max()))
    constant, across, down, scale = (float(one) for one in solution)
    return DisparityError((constant, across, down), std_px, scale, len(views))


def _merge_rests(views: list[BoardDisparity]) -> list[BoardDisparity]:
    """Return one view for each place of the board: those of a rest share their errors."""
    rests: list[list[BoardDisparity]] = []
    for view in views:
        last = rests[-1][0] if rests else None
        if last is not None and _is_same_place(view, last):
            rests[-1].append(view)
        else:
            rests.append([view])
    merged = []
    for rest in rests:
        numbers = np.mean([(one.excess_px, one.expected_px, one.x, one.y) for one in rest], 0)
        merged.append(BoardDisparity(*(float(one) for one in numbers)))
    return merged


def _is_same_place(one: BoardDisparity, other: BoardDisparity) -> bool:
    aside = max(abs(one.x - other.x), abs(one.y - other.y))
    return aside < PLACE and abs(one.expected_px / other.expected_px - 1.0) < PLACE
