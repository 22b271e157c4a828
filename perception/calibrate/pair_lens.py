"""Lenses and place of both cameras of a pair, from pictures of a printed board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from perception.label.camera_pose import Charuco, match_corners

LEAST_VIEWS, LEAST_CORNERS = 8, 12
"""Views, and corners of each that both pictures show: nine numbers of each lens and six of the pair
are fitted, and a view adds six."""
LARGEST_PX = 1.0
"""Largest root mean square reprojection error; 0.25 px with 13 pictures of a hand-held chessboard by
two cameras of 640 x 480 px (OpenCV's sample data)."""
LARGEST_FOCAL, MOST_ASIDE = 0.01, 0.1
"""Largest relative standard deviation of a focal length, 2 cm at 2 m; largest distance of the right
camera up, down, before or behind the left one, over that beside it: more says that views are alike."""


@dataclass(frozen=True)
class BoardPair:
    """Corners of a board that both pictures of a raw pair show.

    Attributes:
        board_m: On the board, `(n, 3)` float32.
        left_px: In the left picture, `(n, 2)` float32.
        right_px: In the right one.
    """

    board_m: np.ndarray
    left_px: np.ndarray
    right_px: np.ndarray


def find_board_pair(
    board: Charuco, left: np.ndarray, right: np.ndarray, gamma: float
) -> BoardPair | None:
    """Return the corners that two pictures, RGB `(h, w, 3)`, share; `None` for too few."""
    nothing = np.zeros(left.shape[:2], np.float32)
    frame = Frame(left, nothing, np.eye(3), None, 0.0, gamma=gamma)
    try:
        left_m, left_px = board.find_corners(frame)
        right_m, right_px = board.find_corners(replace(frame, color=right))
    except FrameError:
        return None
    mine, theirs = match_corners(left_m, right_m)
    if len(mine) < LEAST_CORNERS:
        return None
    parts = (left_m[mine], left_px[mine], right_px[theirs])
    return BoardPair(*(part.astype(np.float32) for part in parts))


def calibrate_pair(pairs: Sequence[BoardPair], size_px: tuple[int, int]) -> dict[str, Any]:
    """Return `K1 D1 K2 D2 R T size_px error_px` as a lens file holds them, by OpenCV.

    Args:
        pairs: Views of the board, at several distances and tilts.
        size_px: Columns and rows of a picture.

    Raises:
        FrameError: the views do not determine the lenses; the message says what they lack.
    """
    if len(pairs) < LEAST_VIEWS:
        raise FrameError(
            f"lens=board: expected {LEAST_VIEWS} pairs or more in which both pictures show the board, "
            f"got {len(pairs)}; hold it nearer, still, and in the light"
        )
    boards = [one.board_m for one in pairs]
    left_px, right_px = [one.left_px for one in pairs], [one.right_px for one in pairs]
    lenses = []
    for side, pixels in (("left", left_px), ("right", right_px)):
        _, matrix, bent, _, _, std, *_ = cv2.calibrateCameraExtended(
            boards, pixels, size_px, np.eye(3), np.zeros(5)
        )
        doubt = float(std[0, 0] / matrix[0, 0])
        if not doubt < LARGEST_FOCAL:
            raise FrameError(
                f"lens=board: the focal length of the {side} camera is known to {doubt:.1%}, expected "
                f"{LARGEST_FOCAL:.0%}; tilt the board by 30 degrees, to all sides, and fill the picture"
            )
        lenses.append((matrix, bent))
    (one, bent), (other, other_bent) = lenses
    error_px, *found = cv2.stereoCalibrate(
        boards, left_px, right_px, one, bent, other, other_bent, size_px,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    if error_px > LARGEST_PX:
        raise FrameError(
            f"lens=board: the corners miss by {error_px:.2f} px, expected {LARGEST_PX:g} or less; is the "
            "board flat, are both pictures of one moment, are its sizes those of board.columns, rows, "
            "square_m and marker_m?"
        )
    shift_m = np.ravel(found[5])
    if np.hypot(shift_m[1], shift_m[2]) > MOST_ASIDE * abs(shift_m[0]):
        raise FrameError(
            f"lens=board: the right camera stands {shift_m.round(3).tolist()} m from the left one, "
            "expected side by side; tilt the board by 30 degrees, to all sides, and fill the picture"
        )
    names = ("K1", "D1", "K2", "D2", "R", "T")
    content = {name: np.asarray(value).tolist() for name, value in zip(names, found, strict=False)}
    for name in ("D1", "D2", "T"):
        content[name] = np.ravel(content[name]).tolist()
    return content | {"size_px": list(size_px), "error_px": round(float(error_px), 4)}
