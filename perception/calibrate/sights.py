"""How a camera sees a flat board: one pose or two that fit, and how well the corners decide each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from perception.calibrate import rigid

AMBIGUOUS = 3.0
"""A second pose whose error is less than this many times the first's is kept: the arm decides."""
NUM_CANDIDATES = 2


@dataclass(frozen=True)
class Sight:
    """A board in one frame.

    Attributes:
        camera_from_board: Poses that fit, the better first, `(2, 4, 4)`; twice the same where the
            corners leave no doubt.
        cov: Covariance of each as a small motion in the board's frame, `(2, 6, 6)`.
        error_px: Root mean square reprojection error of the better.
        middle_px: Where the board is in the picture, `(2,)`.
    """

    camera_from_board: np.ndarray
    cov: np.ndarray
    error_px: float
    middle_px: np.ndarray


def sight(
    frame: Frame, there_m: np.ndarray, seen_px: np.ndarray, corner_px: float, max_error_px: float
) -> Sight:
    """Returns the board's poses.

    Args:
        frame: Gives camera matrix and distortion.
        there_m: Corners on the board, `(n, 3)`.
        seen_px: The same in the picture, `(n, 2)`.
        corner_px: Standard deviation of a corner; where the corners show more, that counts.
        max_error_px: Largest root mean square reprojection error.

    Raises:
        FrameError: the corners fit no pose.
    """
    matrix, dist = np.asarray(frame.camera_matrix, float), frame.distortion
    # at its middle a small motion of the board is least entangled: shift and turn are nearly
    # independent there
    found = []
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        there_m, seen_px, matrix, dist, flags=cv2.SOLVEPNP_IPPE
    )
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        turn, shift = cv2.solvePnPRefineLM(there_m, seen_px, matrix, dist, turn, shift)
        pose = rigid.pose(np.asarray(cv2.Rodrigues(turn)[0]), np.ravel(shift))
        if not np.isfinite(pose).all() or (there_m @ pose[:3, :3].T + pose[:3, 3])[:, 2].min() <= 0:
            continue  # behind the camera
        away = cv2.projectPoints(there_m, turn, shift, matrix, dist)[0][:, 0] - seen_px
        found.append((float(np.sqrt((away**2).sum(1).mean())), pose))
    found.sort(key=lambda one: one[0])
    if not found or found[0][0] > max_error_px:
        what = (
            "fit no pose"
            if not found
            else f"miss by {found[0][0]:.1f} px, {max_error_px:g} are allowed"
        )
        raise FrameError(f"{frame.name}: the board's corners {what}")
    best_px = found[0][0]
    kept = [
        pose
        for error_px, pose in found[:NUM_CANDIDATES]
        if error_px <= AMBIGUOUS * max(best_px, corner_px)
    ]
    poses = np.stack([*kept, *kept[:1]][:NUM_CANDIDATES])
    # two numbers a corner, six of them spent on the pose
    std_px = max(corner_px, best_px * np.sqrt(len(there_m) / max(2 * len(there_m) - 6, 1)))
    cov = np.stack(
        [std_px**2 * np.linalg.inv(_information(pose, there_m, matrix)) for pose in poses]
    )
    return Sight(poses, cov, best_px, seen_px.mean(0))


def _information(pose: np.ndarray, there_m: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Returns how the corners pin a small motion of the board, `(6, 6)` px^2 each; the lens is straight enough for that."""
    point = there_m @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = point.T
    slope = np.zeros((len(point), 2, 3))
    slope[:, 0, 0], slope[:, 0, 2] = matrix[0, 0] / z, -matrix[0, 0] * x / z**2
    slope[:, 1, 1], slope[:, 1, 2] = matrix[1, 1] / z, -matrix[1, 1] * y / z**2
    motion = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(point), 3, 3)), -rigid.crossing(there_m)], 2
    )
    rows = (slope @ pose[:3, :3] @ motion).reshape(-1, 6)
    return rows.T @ rows + 1e-9 * np.eye(6)
