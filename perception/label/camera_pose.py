"""Camera poses of real footage from a board in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception.calibrate import transforms
from perception.pose.plane_conic import convert_to_gray, linearize

MIN_CORNERS = 4
"""Corners that determine a pose."""
MAX_ERROR_RATIO = 3.0
"""A second pose is kept if its error is less than this many times the first's; chosen by hand.

The poses of the arm then decide between the two.
"""
NUM_CANDIDATES = 2
SMALL_MOTION = 1e-6
"""Step of the derivatives of a projection, m or rad: a thousandth of a pixel."""
SAME_CORNER_M = 1e-6
"""Distance below which two corners are the same one."""


@dataclass(frozen=True)
class BoardPose:
    """Pose of a board in one frame.

    Attributes:
        camera_from_board: Poses that fit, the better first, `(2, 4, 4)`; twice the same where the
            corners leave no doubt.
        cov: Covariance of each as a small motion in the board's frame, `(2, 6, 6)`.
        error_px: Root mean square reprojection error of the better.
    """

    camera_from_board: np.ndarray
    cov: np.ndarray
    error_px: float


def estimate_board_pose(
    frame: Frame,
    corners_m: np.ndarray,
    corners_px: np.ndarray,
    corner_px: float,
    max_error_px: float,
) -> BoardPose:
    """Return the one or two poses of a flat board that fit its corners.

    Args:
        frame: Gives camera matrix and distortion.
        corners_m: Corners on the board, `(n, 3)`.
        corners_px: The same in the picture, `(n, 2)`.
        corner_px: Least standard deviation of a corner; a larger reprojection error replaces it.
        max_error_px: Largest root mean square reprojection error.

    Raises:
        FrameError: the corners fit no pose.
    """
    matrix, distortion = np.asarray(frame.camera_matrix, float), frame.distortion
    # IPPE gives both poses of a flat board that fit about equally well.
    fits = []
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        corners_m, corners_px, matrix, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        turn, shift = cv2.solvePnPRefineLM(corners_m, corners_px, matrix, distortion, turn, shift)
        pose = transforms.make_transform(np.asarray(cv2.Rodrigues(turn)[0]), np.ravel(shift))
        # A pose behind the camera reproduces the picture too.
        depth_m = (corners_m @ pose[:3, :3].T + pose[:3, 3])[:, 2]
        if not np.isfinite(pose).all() or depth_m.min() <= 0:
            continue
        away_px = _project_corners(frame, pose, corners_m) - corners_px
        fits.append((float(np.sqrt((away_px**2).sum(1).mean())), pose))
    fits.sort(key=lambda fit: fit[0])
    if not fits:
        raise FrameError(f"{frame.name}: the board's corners fit no pose")
    best_px = fits[0][0]
    if best_px > max_error_px:
        raise FrameError(
            f"{frame.name}: the board's corners miss by {best_px:.1f} px, {max_error_px:g} are "
            "allowed"
        )
    # A second pose that fits much worse is no doubt.
    largest_px = MAX_ERROR_RATIO * max(best_px, corner_px)
    kept = [pose for error_px, pose in fits[:NUM_CANDIDATES] if error_px <= largest_px]
    # The first pose stands in where there is no second, so that shapes stay the same.
    poses = np.stack([*kept, *kept[:1]][:NUM_CANDIDATES])
    # two numbers a corner, six of them spent on the pose
    freedom = max(2 * len(corners_m) - 6, 1)
    std_px = max(corner_px, best_px * np.sqrt(len(corners_m) / freedom))
    information = np.stack([_compute_information(frame, pose, corners_m) for pose in poses])
    return BoardPose(poses, std_px**2 * np.linalg.inv(information), best_px)


def _compute_information(frame: Frame, pose: np.ndarray, corners_m: np.ndarray) -> np.ndarray:
    """Return the information of the corners on a small motion of the board, `(6, 6)`, px^2."""
    slopes = []
    for motion in SMALL_MOTION * np.eye(6):
        forth = _project_corners(frame, transforms.apply_motion(pose, motion), corners_m)
        back = _project_corners(frame, transforms.apply_motion(pose, -motion), corners_m)
        slopes.append((forth - back).ravel() / (2.0 * SMALL_MOTION))
    rows = np.stack(slopes)
    # The small addition keeps a board seen edge-on invertible.
    return rows @ rows.T + 1e-9 * np.eye(6)


def _project_corners(frame: Frame, pose: np.ndarray, corners_m: np.ndarray) -> np.ndarray:
    """Return the pixels, `(n, 2)`, at which a frame shows the corners of a board at a pose."""
    turn, matrix = np.asarray(cv2.Rodrigues(pose[:3, :3])[0]), frame.camera_matrix
    return cv2.projectPoints(corners_m, turn, pose[:3, 3], matrix, frame.distortion)[0][:, 0]


@spec
class Charuco:
    """The camera's pose from a ChArUco board beside the block.

    Attributes:
        dictionary: Markers, a name of OpenCV's: `DICT_5X5_100`, …
        columns: Squares across.
        rows: Squares down.
        square_m: Side of a square.
        marker_m: Side of a marker.
        min_corners: Inner corners that must be seen.
        max_error_px: Largest error of a pose that is used.
    """

    dictionary: str
    columns: Annotated[int, Ge(2)]
    rows: Annotated[int, Ge(2)]
    square_m: float
    marker_m: Positive
    min_corners: Annotated[int, Ge(MIN_CORNERS)]
    max_error_px: float

    def check(self) -> None:
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        if self.dictionary not in known:
            raise ConfigError(f"dictionary: '{self.dictionary}' is none of {', '.join(known)}")
        if self.marker_m >= self.square_m:
            raise ConfigError(f"marker_m: {self.marker_m} is not below square_m={self.square_m}")

    def find_corners(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners in the board's frame, `(n, 3)` m, and in the picture, `(n, 2)` px.

        Raises:
            FrameError: too few are seen.
        """
        board = self.describe()
        gray, detector = convert_to_gray(frame), cv2.aruco.CharucoDetector(board)
        found, numbers = detector.detectBoard(gray)[:2]
        if frame.gamma != 1.0:
            # A tone curve brightens blurred cells of small markers; dark boards have few levels of
            # linear light. The picture in which more is seen counts.
            light = np.rint(linearize(gray, frame.gamma)).astype(np.uint8)
            others, other_numbers = detector.detectBoard(light)[:2]
            if _count(other_numbers) > _count(numbers):
                found, numbers = others, other_numbers
        if _count(numbers) < self.min_corners:
            raise FrameError(
                f"{frame.name}: {_count(numbers)} corners of the board are seen, {self.min_corners} "
                "are needed"
            )
        corners_m, corners_px = board.matchImagePoints(found, numbers)
        return corners_m.reshape(-1, 3).astype(float), corners_px.reshape(-1, 2).astype(float)

    def locate(self, frame: Frame) -> BoardPose:
        """Return the pose of the board in the camera.

        Raises:
            FrameError: too few corners are seen, or they fit no pose.
        """
        return estimate_board_pose(frame, *self.find_corners(frame), 0.0, self.max_error_px)

    def describe(self) -> Any:
        """Return OpenCV's description of the board."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, markers)


def match_corners(one_m: np.ndarray, other_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows, `(k,)` each, of the corners that are in both lists, `(n, 3)` and `(m, 3)`."""
    apart_m = np.abs(one_m[:, None] - other_m).max(2)
    rows = np.nonzero(apart_m < SAME_CORNER_M)
    return rows[0], rows[1]


def _count(numbers: np.ndarray | None) -> int:
    return 0 if numbers is None else len(numbers)
