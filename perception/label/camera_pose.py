"""Camera poses of real footage: from a board in view, or from given poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

import cv2
import numpy as np
import yaml
from annotated_types import Ge

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception.pose.plane_conic import convert_to_gray, linearize
from perception.sources.validation import check_pose

MIN_CORNERS = 4
"""Corners that determine a pose."""


@dataclass(frozen=True)
class CameraPose:
    """Pose of a camera in the world: the board's frame or that of the given poses.

    Attributes:
        world_from_camera: `(4, 4)`, optical convention.
        error_px: Root mean square reprojection error of the board's corners; 0 for a given pose.
    """

    world_from_camera: np.ndarray
    error_px: float


class CameraTracker(Protocol):
    """Finds the pose of the camera."""

    def locate(self, frame: Frame) -> CameraPose:
        """Return the camera's pose.

        Raises:
            FrameError: this frame does not determine it; the message says why.
        """
        ...


class CameraTrackerSpec(Protocol):
    """A spec in `conf/perception/camera_pose`."""

    def build(self) -> CameraTracker:
        """Return a tracker."""
        ...


class BoardTracker:
    """Finds a flat board in frames.

    Args:
        board: OpenCV's description of it.
        detect: Returns corners and their numbers, as OpenCV gives them, in a grey picture.
        min_corners: Corners that must be seen.
        max_error_px: Largest reprojection error of a pose.
    """

    def __init__(
        self,
        board: Any,
        detect: Callable[[np.ndarray], Sequence[Any]],
        min_corners: int,
        max_error_px: float,
    ) -> None:
        self._board, self._detect = board, detect
        self._min_corners, self._max_error_px = min_corners, max_error_px

    def find_corners(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners in the board's frame, `(n, 3)` m, and in the picture, `(n, 2)` px.

        Raises:
            FrameError: too few are seen.
        """
        gray = convert_to_gray(frame)
        found, numbers = self._detect(gray)[:2]
        count = _count_corners(found, numbers)
        if frame.gamma != 1.0:
            # A tone curve brightens blurred cells of small markers; dark boards have few levels of
            # linear light. The picture in which more is seen counts.
            light = np.rint(linearize(gray, frame.gamma)).astype(np.uint8)
            other = self._detect(light)[:2]
            if _count_corners(*other) > count:
                (found, numbers), count = other, _count_corners(*other)
        if count < self._min_corners:
            raise FrameError(
                f"{frame.name}: {count} corners of the board are seen, {self._min_corners} are "
                "needed"
            )
        corners_m, corners_px = self._board.matchImagePoints(found, numbers)
        return corners_m.reshape(-1, 3).astype(float), corners_px.reshape(-1, 2).astype(float)

    def locate(self, frame: Frame) -> CameraPose:
        """Return the camera's pose in the board's frame.

        Raises:
            FrameError: too few corners are seen, or they fit no pose.
        """
        corners_m, corners_px = self.find_corners(frame)
        matrix, distortion = np.asarray(frame.camera_matrix, float), frame.distortion
        # SQPNP needs no start and finds the global optimum.
        done, turn, shift = cv2.solvePnP(
            corners_m, corners_px, matrix, distortion, flags=cv2.SOLVEPNP_SQPNP
        )
        if not done:
            raise FrameError(f"{frame.name}: the board's corners fit no pose of the camera")
        turn, shift = cv2.solvePnPRefineLM(corners_m, corners_px, matrix, distortion, turn, shift)
        projected, _ = cv2.projectPoints(corners_m, turn, shift, matrix, distortion)
        error_px = float(np.sqrt(((projected[:, 0] - corners_px) ** 2).sum(-1).mean()))
        if error_px > self._max_error_px:
            raise FrameError(
                f"{frame.name}: the board's corners miss by {error_px:.1f} px, "
                f"{self._max_error_px:g} are allowed"
            )
        rotation = np.asarray(cv2.Rodrigues(turn)[0])
        pose = np.eye(4)
        # OpenCV gives the board in the camera; the inverse is wanted.
        pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ np.ravel(shift)
        return CameraPose(pose, error_px)


def _count_corners(found: Sequence[np.ndarray], numbers: np.ndarray | None) -> int:
    """Return the number of corners; OpenCV gives one array for each marker, or one for all."""
    return 0 if numbers is None else sum(len(np.reshape(one, (-1, 2))) for one in found)


class GivenPoseTracker:
    """Looks poses up by the frame's stem."""

    def __init__(self, poses: dict[str, np.ndarray]) -> None:
        self._poses = poses

    def locate(self, frame: Frame) -> CameraPose:
        """Return the camera's pose.

        Raises:
            FrameError: none is given for this frame.
        """
        stem = Path(frame.name).name
        if stem not in self._poses:
            raise FrameError(f"{frame.name}: no pose of the camera is given for '{stem}'")
        return CameraPose(self._poses[stem], 0.0)


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
        _check_dictionary(self.dictionary)
        if self.marker_m >= self.square_m:
            raise ConfigError(
                f"marker_m: expected less than square_m={self.square_m}, got {self.marker_m}"
            )

    def build(self) -> BoardTracker:
        """Return a tracker."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, markers
        )
        detect = cv2.aruco.CharucoDetector(board).detectBoard
        return BoardTracker(board, detect, self.min_corners, self.max_error_px)


@spec
class GivenPoses:
    """Camera poses from a file.

    Attributes:
        poses: YAML file: stem of a frame to its pose `T_world_cam`, 4 x 4.
    """

    poses: str

    def build(self) -> CameraTracker:
        """Return a tracker.

        Raises:
            ConfigError: the file cannot be read.
        """
        try:
            table = yaml.safe_load(Path(self.poses).read_text())
            poses = {str(stem): check_pose(pose, str(stem)) for stem, pose in table.items()}
        except (OSError, yaml.YAMLError, AttributeError, FrameError) as error:
            raise ConfigError(
                f"camera_pose.poses={self.poses}: expected YAML of '<stem>: 4 x 4 numbers' "
                f"({error})"
            ) from error
        return GivenPoseTracker(poses)


def _check_dictionary(dictionary: str) -> None:
    if not dictionary.startswith("DICT_") or not hasattr(cv2.aruco, dictionary):
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise ConfigError(f"dictionary: OpenCV has no '{dictionary}'; choices: {', '.join(known)}")
