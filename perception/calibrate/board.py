"""How a camera sees a flat board: one pose or two that fit, and how well the corners decide each."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from rich.progress import Progress

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception.calibrate import arm, clock_offset, evaluation, transforms
from perception.calibrate.extrinsics import PoseResidual, build_calibration
from perception.calibrate.hand_eye import (
    MIN_VIEWS,
    HandEyeSolution,
    HandEyeViews,
    predict_board_poses,
    solve_hand_eye,
)
from perception.label.camera_pose import BoardTracker

# --- from by_board: Calibration from frames of a board on the arm and the joint positions there.

MAX_ERROR_RATIO = 3.0
"""A second pose whose error is less than this many times the first's is kept: the arm decides."""
NUM_CANDIDATES = 2


@dataclass(frozen=True)
class BoardPose:
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


def estimate_board_pose(
    frame: Frame, there_m: np.ndarray, seen_px: np.ndarray, corner_px: float, max_error_px: float
) -> BoardPose:
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
        pose = transforms.make_transform(np.asarray(cv2.Rodrigues(turn)[0]), np.ravel(shift))
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
        if error_px <= MAX_ERROR_RATIO * max(best_px, corner_px)
    ]
    poses = np.stack([*kept, *kept[:1]][:NUM_CANDIDATES])
    # two numbers a corner, six of them spent on the pose
    std_px = max(corner_px, best_px * np.sqrt(len(there_m) / max(2 * len(there_m) - 6, 1)))
    cov = np.stack(
        [
            std_px**2 * np.linalg.inv(_compute_pose_information(pose, there_m, matrix))
            for pose in poses
        ]
    )
    return BoardPose(poses, cov, best_px, seen_px.mean(0))


def _compute_pose_information(
    pose: np.ndarray, there_m: np.ndarray, matrix: np.ndarray
) -> np.ndarray:
    """Returns how the corners pin a small motion of the board, `(6, 6)` px^2 each; the lens is straight enough for that."""
    point = there_m @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = point.T
    slope = np.zeros((len(point), 2, 3))
    slope[:, 0, 0], slope[:, 0, 2] = matrix[0, 0] / z, -matrix[0, 0] * x / z**2
    slope[:, 1, 1], slope[:, 1, 2] = matrix[1, 1] / z, -matrix[1, 1] * y / z**2
    motion = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(point), 3, 3)), -transforms.build_cross_matrices(there_m)],
        2,
    )
    rows = (slope @ pose[:3, :3] @ motion).reshape(-1, 6)
    return rows.T @ rows + 1e-9 * np.eye(6)


log = logging.getLogger(__name__)


class BoardSpec(Protocol):
    """A board of `conf/perception/camera_pose`."""

    def build(self) -> BoardTracker:
        """Returns a tracker."""
        ...


@dataclass(frozen=True)
class BoardObservation:
    """A frame in which the board was found: its name, time, the board, and the joint positions, `(J,)`."""

    name: str
    t_s: float
    pose: BoardPose
    q: np.ndarray


@spec
class BoardCalibration:
    """A board on the last link, somewhere, watched by a camera that stands still in the base frame.

    Attributes:
        source: The frames.
        board: What it looks like.
        joints: A recording (Parquet) that ran along, or YAML: stem of a frame to its joint
            positions.
        corner_px: Standard deviation of a corner in the picture.
        max_error_px: Largest reprojection error of a board that is believed.
        joint_std_rad: By how much a joint is off in each pose on its own (rad or m): backlash,
            sensor.
        zero_std_rad: By how much the zero of a joint may be off in all poses (rad or m); 0 leaves
            zeros alone. They are estimated along, as far as the poses tell; a wrong zero of the
            first joint is part of the camera's place as the arm sees it.
        wobble_m: By which the link is elsewhere in each pose beyond what joints do, standard
            deviation: play, bending.
        wobble_rad: The same, as a turn.
        clock_s: Largest offset of the clocks that is looked for.
        least_correlation: Of the speeds, below which their offset is taken for 0.
        least_turn_rad: The poses turn at least this far about two axes.
        max_poses: Of more frames, as many are used, evenly.
        work_m: How far before the camera it is used: there its uncertainty is told.
        temperature_c: Of the day, for the record; `null` where nobody measured.
    """

    source: FrameSourceSpec
    board: BoardSpec
    joints: str
    corner_px: float
    max_error_px: float
    joint_std_rad: float
    zero_std_rad: float
    wobble_m: float
    wobble_rad: float
    clock_s: float
    least_correlation: float
    least_turn_rad: float
    max_poses: int
    work_m: float
    temperature_c: float | None

    def check(self) -> None:
        positive = (
            self.corner_px,
            self.max_error_px,
            self.joint_std_rad,
            self.wobble_m,
            self.wobble_rad,
            self.work_m,
        )
        if min(positive) <= 0 or min(self.zero_std_rad, self.clock_s) < 0 or self.max_poses < 10:
            raise ConfigError(
                "calibration: expected corner_px, max_error_px, joint_std_rad, wobble_m, wobble_rad and work_m above 0, "
                "zero_std_rad and clock_s of 0 or more, max_poses of 10 or more"
            )

    def calibrate(self, machine: Machine) -> dict[str, Any]:
        """Returns what `calibration.yaml` says.

        Raises:
            FrameError: the poses do not tell where the camera is; says which are missing.
            ConfigError, RecordingError: the joint positions cannot be read.
        """
        track = arm.read_joint_positions(Path(self.joints), machine)
        seen, refused = self._seen(track)
        offset = self._offset(machine, track, seen)
        shift_s = offset.offset_s if offset is not None and offset.is_trusted else 0.0
        seen = self._with_joints(track, seen, shift_s, refused)
        if len(seen) < MIN_VIEWS:
            reasons = sorted({one.left_out or "" for one in refused})[:3]
            raise FrameError(
                f"calibration: {len(seen)} frames show the board where the joint positions are known, {MIN_VIEWS} are needed, "
                f"20 are good. Left out: {'; '.join(reasons) or 'none'}"
            )
        if len(seen) > self.max_poses:
            seen = [
                seen[k] for k in np.linspace(0, len(seen) - 1, self.max_poses).round().astype(int)
            ]
        views = self._views(machine, track, seen, shift_s, offset is not None)
        solution = solve_hand_eye(views)
        assert solution is not None  # there are enough
        return self._told(machine, views, solution, seen, refused, offset, shift_s)

    def _seen(
        self, track: arm.JointTrajectory
    ) -> tuple[list[BoardObservation], list[PoseResidual]]:
        """Returns the boards in the frames, joint positions still missing, and frames without one."""
        tracker, found, refused = self.board.build(), [], []
        with self.source.build() as source, Progress(transient=True) as progress:
            task = progress.add_task("boards", total=source.num_frames)
            while True:
                progress.advance(task)
                try:
                    frame = source.read_latest()
                    if frame is None:
                        return found, refused
                    there, where = tracker.corners(frame)
                    one = estimate_board_pose(
                        frame, there, where, self.corner_px, self.max_error_px
                    )
                    found.append(
                        BoardObservation(
                            Path(frame.name).name, frame.t_s, one, np.zeros(track.q.shape[1])
                        )
                    )
                except FrameError as error:
                    refused.append(
                        PoseResidual(
                            str(error).split(":")[0].split("/")[-1], None, None, str(error)
                        )
                    )

    def _offset(
        self, machine: Machine, track: arm.JointTrajectory, seen: list[BoardObservation]
    ) -> clock_offset.ClockEstimate | None:
        if track.t_s is None or len(seen) < clock_offset.MIN_SPEEDS or not self.clock_s:
            return None
        times, turns = (
            np.array([one.t_s for one in seen]),
            np.stack([one.pose.camera_from_board[0, :3, :3] for one in seen]),
        )
        link_turns = arm.compute_link_poses(machine, track.q).base_from_link[:, :3, :3]
        return clock_offset.estimate_clock_offset(
            times, turns, track.t_s, link_turns, self.clock_s, self.least_correlation
        )

    def _with_joints(
        self,
        track: arm.JointTrajectory,
        seen: list[BoardObservation],
        shift_s: float,
        refused: list[PoseResidual],
    ) -> list[BoardObservation]:
        known = []
        for one in seen:
            q = track.at(one.name, one.t_s + shift_s)
            if q is None:
                refused.append(
                    PoseResidual(
                        one.name, None, None, f"{self.joints} has no joint positions for it"
                    )
                )
            else:
                known.append(BoardObservation(one.name, one.t_s, one.pose, q))
        return known

    def _views(
        self,
        machine: Machine,
        track: arm.JointTrajectory,
        seen: list[BoardObservation],
        shift_s: float,
        moving: bool,
    ) -> HandEyeViews:
        q = np.stack([one.q for one in seen])
        links = arm.compute_link_poses(machine, q)
        # a wrong zero of the first joint is a camera elsewhere, one of the last a board elsewhere:
        # the arm itself believes it too
        inner = range(1, machine.num_joints - 1) if self.zero_std_rad else range(0)
        shared, std = links.joints[:, inner], [self.zero_std_rad] * len(inner)
        names = [machine.joint_names[k] for k in inner]
        slack = [
            self.joint_std_rad * links.joints,
            arm.build_wobble_motions(links.base_from_link, self.wobble_m, self.wobble_rad),
        ]
        if moving:
            speed = track.speed(np.array([one.t_s for one in seen]) + shift_s)
            late = np.einsum("nj,njk->nk", speed, links.joints)[:, None]
            shared, std, names = (
                np.concatenate([shared, late], 1),
                [*std, clock_offset.CLOCK_STD_S],
                [*names, evaluation.CLOCK_NAME],
            )
            slack.append(clock_offset.FRAME_JITTER_S * late)
        poses, covs = (
            np.stack([getattr(one.pose, name) for one in seen])
            for name in ("camera_from_board", "cov")
        )
        return HandEyeViews(
            links.base_from_link, poses, covs, np.concatenate(slack, 1), shared, np.array(std), tuple(one.name for one in seen),
            tuple(names),
        )  # fmt: skip

    def _told(
        self, machine: Machine, views: HandEyeViews, solution: HandEyeSolution, seen: list[BoardObservation],
        refused: list[PoseResidual], offset: clock_offset.ClockEstimate | None, shift_s: float,
    ) -> dict[str, Any]:  # fmt: skip
        used = np.flatnonzero(solution.used)
        q = np.stack([seen[k].q for k in used])
        distance_m = np.linalg.norm(predict_board_poses(views, solution.guess)[used, :3, 3], axis=1)
        missing = evaluation.list_missing_poses(
            machine, q, views.base_from_link[used], distance_m, self.least_turn_rad
        )
        turns, _ = evaluation.measure_rotation_ranges(views.base_from_link[used])
        if turns[1] < 0.1 * self.least_turn_rad or len(used) < MIN_VIEWS:
            raise FrameError(
                f"calibration: the poses do not tell where the camera is: {'; '.join(missing) or 'too few agree'}"
            )
        for one in missing:
            log.warning("calibration: %s", one)
        more = {
            "temperature_c": self.temperature_c,
            "T_link_board": solution.guess.link_from_board.round(9).tolist(),
            **evaluation.summarise_solution(views, solution, offset, shift_s),
            "corners_px": round(float(np.median([one.pose.error_px for one in seen])), 3),
            "turns_rad": turns.round(4).tolist(),
            "missing": missing,
        }
        judged = [*evaluation.list_residuals(views, solution), *refused]
        cov = solution.cov[:6, :6]
        return build_calibration(
            "board", machine, solution.guess.base_from_camera, cov, judged, self.work_m, more
        )
