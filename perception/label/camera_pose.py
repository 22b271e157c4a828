"""Where the camera was in each frame of real footage: from a board that lies in view, or from poses that someone else knows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import yaml

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec


@dataclass(frozen=True)
class CameraPose:
    """A camera in the world, which is the board's frame or that of the given poses.

    Attributes:
        world_from_camera: `(4, 4)`, optical convention.
        error_px: Root mean square distance of the board's corners from where this pose puts them; 0
            for a given pose.
    """

    world_from_camera: np.ndarray
    error_px: float


class CameraTracker(Protocol):
    """Says where the camera was."""

    def locate(self, frame: Frame) -> CameraPose:
        """Returns the camera's pose.

        Raises:
            FrameError: nobody can tell for this frame; the message says why.
        """
        ...


class BoardTracker(CameraTracker, Protocol):
    """A tracker that finds a board, and says where its corners are."""

    def corners(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Returns the corners that are seen, `(n, 3)` m in the board's frame, and where, `(n, 2)` px.

        Raises:
            FrameError: there are too few.
        """
        ...


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
    columns: int
    rows: int
    square_m: float
    marker_m: float
    min_corners: int
    max_error_px: float

    def check(self) -> None:
        _check(self.dictionary, self.min_corners)
        if not 0 < self.marker_m < self.square_m:
            raise ConfigError(
                f"board: expected 0 < marker_m < square_m, got {self.marker_m} and {self.square_m}"
            )

    def build(self) -> BoardTracker:
        """Returns a tracker."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, markers
        )
        detector = cv2.aruco.CharucoDetector(board)

        def corners(gray: np.ndarray) -> tuple[Any, Any]:
            return detector.detectBoard(gray)[:2]

        return _BoardTracker(board, corners, self.min_corners, self.max_error_px)


@spec
class TagGrid:
    """The camera's pose from a grid of AprilTags or ArUco markers beside the block.

    Attributes:
        dictionary: Markers, a name of OpenCV's: `DICT_APRILTAG_36h11`, …
        columns: Markers across.
        rows: Markers down.
        marker_m: Side of a marker.
        gap_m: Between two markers.
        min_corners: Corners of markers that must be seen, four each.
        max_error_px: Largest error of a pose that is used.
    """

    dictionary: str
    columns: int
    rows: int
    marker_m: float
    gap_m: float
    min_corners: int
    max_error_px: float

    def check(self) -> None:
        _check(self.dictionary, self.min_corners)

    def build(self) -> BoardTracker:
        """Returns a tracker."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.GridBoard((self.columns, self.rows), self.marker_m, self.gap_m, markers)
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        detector = cv2.aruco.ArucoDetector(markers, parameters)

        def corners(gray: np.ndarray) -> tuple[Any, Any]:
            return detector.detectMarkers(gray)[:2]

        return _BoardTracker(board, corners, self.min_corners, self.max_error_px)


@spec
class GivenPoses:
    """Camera poses from a file, or from the frames themselves.

    Attributes:
        poses: YAML file: stem of a frame to its pose `T_world_cam`, 4 x 4; `null` takes each
            frame's own, `T_base_cam`.
    """

    poses: str | None

    def build(self) -> CameraTracker:
        """Returns a tracker.

        Raises:
            ConfigError: the file cannot be read.
        """
        if self.poses is None:
            return _GivenTracker(None)
        try:
            told = yaml.safe_load(Path(self.poses).read_text())
            poses = {str(stem): np.asarray(pose, float) for stem, pose in told.items()}
        except (OSError, yaml.YAMLError, AttributeError, ValueError, TypeError) as error:
            raise ConfigError(
                f"camera_pose.poses={self.poses}: expected YAML of '<stem>: 4 x 4 numbers' ({error})"
            ) from error
        if wrong := [stem for stem, pose in poses.items() if not _is_pose(pose)]:
            raise ConfigError(
                f"camera_pose.poses={self.poses}: '{wrong[0]}' is no rigid 4 x 4 transform"
            )
        return _GivenTracker(poses)


class _BoardTracker:
    def __init__(self, board: Any, corners: Any, min_corners: int, max_error_px: float) -> None:
        self._board, self._corners, self._min_corners, self._max_error_px = (
            board,
            corners,
            min_corners,
            max_error_px,
        )

    def corners(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        found, numbers = self._corners(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY))
        count = 0 if numbers is None else sum(len(np.reshape(one, (-1, 2))) for one in found)
        if count < self._min_corners:
            raise FrameError(
                f"{frame.name}: {count} corners of the board are seen, {self._min_corners} are needed"
            )
        there, seen = self._board.matchImagePoints(found, numbers)
        return there.reshape(-1, 3).astype(float), seen.reshape(-1, 2).astype(float)

    def locate(self, frame: Frame) -> CameraPose:
        there, seen = self.corners(frame)
        matrix = np.asarray(frame.camera_matrix, float)
        done, turn, shift = cv2.solvePnP(
            there, seen, matrix, frame.distortion, flags=cv2.SOLVEPNP_SQPNP
        )
        if not done:
            raise FrameError(f"{frame.name}: the board's corners fit no pose of the camera")
        turn, shift = cv2.solvePnPRefineLM(there, seen, matrix, frame.distortion, turn, shift)
        again, _ = cv2.projectPoints(there, turn, shift, matrix, frame.distortion)
        error_px = float(np.sqrt(((again[:, 0] - seen) ** 2).sum(-1).mean()))
        if error_px > self._max_error_px:
            raise FrameError(
                f"{frame.name}: the board's corners miss by {error_px:.1f} px, {self._max_error_px:g} are allowed"
            )
        rotation = np.asarray(cv2.Rodrigues(turn)[0])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ np.ravel(shift)
        return CameraPose(pose, error_px)


class _GivenTracker:
    def __init__(self, poses: dict[str, np.ndarray] | None) -> None:
        self._poses = poses

    def locate(self, frame: Frame) -> CameraPose:
        stem = Path(frame.name).name
        pose = frame.base_from_camera if self._poses is None else self._poses.get(stem)
        if pose is None:
            raise FrameError(f"{frame.name}: no pose of the camera is given for '{stem}'")
        return CameraPose(np.asarray(pose, float), 0.0)


def _check(dictionary: str, min_corners: int) -> None:
    if not dictionary.startswith("DICT_") or not hasattr(cv2.aruco, dictionary):
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise ConfigError(
            f"board.dictionary: OpenCV has no '{dictionary}'; choices: {', '.join(known)}"
        )
    if min_corners < 4:
        raise ConfigError(f"board.min_corners: a pose needs 4 corners or more, got {min_corners}")


def _is_pose(pose: np.ndarray) -> bool:
    rigid = pose.shape == (4, 4) and np.allclose(
        pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3
    )
    return bool(rigid and np.linalg.det(pose[:3, :3]) > 0 and np.allclose(pose[3], [0, 0, 0, 1]))
