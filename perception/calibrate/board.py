"""Calibration from frames of a board on the arm and the joint positions there."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import FrameError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, spec
from perception.calibrate import arm, clock_offset, evaluation
from perception.calibrate.disparity_error import (
    BoardDisparity,
    estimate_disparity_error,
    measure_board_disparity,
)
from perception.calibrate.evaluation import judge_fit
from perception.calibrate.extrinsics import build_calibration
from perception.calibrate.hand_eye import (
    MIN_VIEWS,
    HandEyeSolution,
    HandEyeViews,
    predict_board_poses,
    solve_hand_eye,
)
from perception.label.camera_pose import BoardPose, Charuco, estimate_board_pose
from perception.sources.look import look_at_frames

log = logging.getLogger(__name__)

MIN_TURN_SHARE = 0.1
"""Below this part of `least_turn_rad` about the second axis the problem counts as singular."""


@dataclass(frozen=True)
class BoardObservation:
    """A frame in which the board was found.

    Attributes:
        name: Stem of the frame.
        t_s: Its time.
        pose: The board.
        disparity: Its disparity; `None` without a right picture of it.
        q: Joint positions then, `(J,)`, rad or m; `None` until they were looked up.
    """

    name: str
    t_s: float
    pose: BoardPose
    disparity: BoardDisparity | None
    q: np.ndarray | None = None


@spec
class BoardCalibration:
    """A board on the last link, watched by a camera that stands still in the base frame.

    The board's pose on the link is estimated too.

    Attributes:
        source: The frames.
        board: Layout of the board.
        joints: A recording (Parquet) that ran along, or YAML: stem of a frame to its joint
            positions.
        corner_px: Standard deviation of a corner in the picture.
        max_error_px: Largest reprojection error of a board that is used.
        joint_std_rad: Independent error of a joint in each pose, standard deviation (rad or m):
            backlash, sensor.
        zero_std_rad: Standard deviation of the zero of a joint, the same in all poses (rad or m); 0
            leaves zeros alone. They are estimated too, but for the first and the last joint: a
            camera elsewhere, or a board elsewhere, explains those as well.
        wobble_m: Error of the link's place in each pose beyond that of the joints, standard
            deviation: play, bending.
        wobble_rad: The same, as a turn.
        clock_s: Largest offset of the clocks that is tried.
        least_correlation: Of the speeds, below which the offset is taken as 0.
        least_turn_rad: The poses should turn at least this far about two axes.
        max_poses: Of more frames, as many are used, evenly.
        work_m: Working distance, at which the uncertainty of a point is stated.
    """

    source: FrameSourceSpec
    board: Charuco
    joints: str
    corner_px: Positive
    max_error_px: Positive
    joint_std_rad: Positive
    zero_std_rad: NonNegative
    wobble_m: Positive
    wobble_rad: Positive
    clock_s: NonNegative
    least_correlation: float
    least_turn_rad: float
    max_poses: Annotated[int, Ge(10)]
    work_m: Positive

    def calibrate(self, machine: Machine) -> dict[str, Any]:
        """Return the content of `calibration.yaml`.

        Raises:
            FrameError: the poses do not determine the camera; names those that are missing.
            ConfigError, RecordingError: the joint positions cannot be read.
        """
        trajectory = arm.read_joint_positions(Path(self.joints), machine)
        observations, refused = self._find_boards()
        clock = self._estimate_clock(machine, trajectory, observations)
        # Joint positions are read at the time of the exposure.
        shift_s = 0.0 if clock is None else clock.applied_s
        known = []
        for one in observations:
            q = trajectory.at(one.name, one.t_s + shift_s)
            if q is None:
                reason = f"{self.joints} has no joint positions for it"
                refused.append(evaluation.describe_residual(one.name, reason))
            else:
                known.append(replace(one, q=q))
        if len(known) < MIN_VIEWS:
            reasons = sorted({one["left_out"] for one in refused})[:3]
            raise FrameError(
                f"calibration: {len(known)} frames show the board where the joint positions are "
                f"known, {MIN_VIEWS} are needed, 20 are good. Left out: "
                f"{'; '.join(reasons) or 'none'}"
            )
        if len(known) > self.max_poses:
            # Evenly over the recording: neighbouring frames show nearly the same pose.
            chosen = np.linspace(0, len(known) - 1, self.max_poses).round().astype(int)
            known = [known[k] for k in chosen]
        q = np.stack([one.q for one in known])
        views = self._build_views(machine, trajectory, known, q, clock)
        solution = solve_hand_eye(views)
        assert solution is not None  # there are enough
        turns_rad, missing = self._check_coverage(machine, views, solution, q)
        summary = evaluation.summarise_solution(views, solution, clock)
        zeros = {name: one["mean"] for name, one in summary["joint_zeros"].items()}
        judged = judge_fit(solution.used, solution.factor, zeros, self.zero_std_rad, missing)
        more = {
            "T_link_board": solution.guess.link_from_board.round(9).tolist(),
            **summary,
            "corners_px": round(float(np.median([one.pose.error_px for one in known])), 3),
            "turns_rad": turns_rad.round(4).tolist(),
            "missing": missing,
            "verdict": vars(judged),
        }
        pairs = [known[k].disparity for k in np.flatnonzero(solution.used)]
        error = estimate_disparity_error([one for one in pairs if one is not None])
        if error is not None:
            more["disparity"] = error.to_dict()
        residuals = [*evaluation.list_residuals(views, solution), *refused]
        camera, cov = solution.guess.base_from_camera, solution.cov[:6, :6]
        return build_calibration(machine, camera, cov, residuals, self.work_m, more)

    def _find_boards(self) -> tuple[list[BoardObservation], list[dict[str, Any]]]:
        """Return the boards in the frames, and the entries of frames without one."""
        found, refused = [], []

        def observe(frame: Frame) -> BoardObservation:
            corners = self.board.find_corners(frame)
            pose = estimate_board_pose(frame, *corners, self.corner_px, self.max_error_px)
            place = pose.camera_from_board[0]
            disparity = measure_board_disparity(self.board, frame, *corners, place)
            return BoardObservation(Path(frame.name).name, frame.t_s, pose, disparity)

        for name, one, reason in look_at_frames(self.source, "boards", observe):
            if one is None:
                refused.append(evaluation.describe_residual(name, reason))
            else:
                found.append(one)
        return found, refused

    def _estimate_clock(
        self,
        machine: Machine,
        trajectory: arm.JointTrajectory,
        observations: list[BoardObservation],
    ) -> clock_offset.ClockEstimate | None:
        # A few frames fit any offset.
        is_enough = len(observations) >= clock_offset.MIN_SPEEDS
        if trajectory.t_s is None or not is_enough or not self.clock_s:
            return None
        # Speeds of the link and of the board are compared; both are known without calibration.
        links = arm.compute_link_poses(machine, trajectory.q)
        return clock_offset.estimate_clock_offset(
            np.array([one.t_s for one in observations]),
            np.stack([one.pose.camera_from_board[0, :3, :3] for one in observations]),
            trajectory.t_s,
            links.base_from_link[:, :3, :3],
            self.clock_s,
            self.least_correlation,
        )

    def _build_views(
        self,
        machine: Machine,
        trajectory: arm.JointTrajectory,
        observations: list[BoardObservation],
        q: np.ndarray,
        clock: clock_offset.ClockEstimate | None,
    ) -> HandEyeViews:
        links = arm.compute_link_poses(machine, q)
        # a wrong zero of the first joint is a camera elsewhere, one of the last a board elsewhere:
        # no camera can tell them apart
        inner = range(1, machine.num_joints - 1) if self.zero_std_rad else range(0)
        shared, std = links.joints[:, inner], [self.zero_std_rad] * len(inner)
        names = [machine.joint_names[k] for k in inner]
        slack = [
            self.joint_std_rad * links.joints,
            arm.build_wobble_motions(links.base_from_link, self.wobble_m, self.wobble_rad),
        ]
        if clock is not None:
            frame_s = np.array([one.t_s for one in observations])
            speed = trajectory.speed(frame_s + clock.applied_s)
            motion = np.einsum("nj,njk->nk", speed, links.joints)[:, None]
            shared = np.concatenate([shared, motion], 1)
            std, names = [*std, clock_offset.CLOCK_STD_S], [*names, evaluation.CLOCK_NAME]
            slack.append(clock_offset.FRAME_JITTER_S * motion)
        return HandEyeViews(
            base_from_link=links.base_from_link,
            camera_from_board=np.stack([one.pose.camera_from_board for one in observations]),
            seen_cov=np.stack([one.pose.cov for one in observations]),
            slack=np.concatenate(slack, 1),
            shared=shared,
            shared_std=np.array(std),
            names=tuple(one.name for one in observations),
            shared_names=tuple(names),
        )

    def _check_coverage(
        self, machine: Machine, views: HandEyeViews, solution: HandEyeSolution, q: np.ndarray
    ) -> tuple[np.ndarray, list[str]]:
        """Return by how much the poses turn, `(3,)` rad, and which are missing.

        Refuse poses that do not determine the camera; only those that were used can.
        """
        used = solution.used
        board = predict_board_poses(views, solution.guess)[used]
        turns_rad, axes = evaluation.measure_rotation_ranges(views.base_from_link[used])
        distance_m = np.linalg.norm(board[:, :3, 3], axis=1)
        missing = evaluation.list_missing_poses(
            machine, q[used], turns_rad, axes, distance_m, self.least_turn_rad
        )
        # The problem is singular: more poses of the same kind would not help.
        if turns_rad[1] < MIN_TURN_SHARE * self.least_turn_rad or used.sum() < MIN_VIEWS:
            raise FrameError(
                "calibration: the poses do not determine where the camera is: "
                f"{'; '.join(missing) or 'too few agree'}"
            )
        for one in missing:
            log.warning("calibration: %s", one)
        return turns_rad, missing
