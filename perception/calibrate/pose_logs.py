"""Calibration from two logs of poses: of the link by any arm, of the board by any tracker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from perception.calibrate import arm, clock_offset, evaluation, transforms, verdict
from perception.calibrate.board import MIN_TURN_SHARE
from perception.calibrate.extrinsics import build_calibration
from perception.calibrate.hand_eye import (
    MIN_VIEWS,
    HandEyeSolution,
    HandEyeViews,
    compute_deviance,
    predict_board_poses,
    solve_hand_eye,
)

COLUMNS = ("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
"""Columns of a log: time, place, unit quaternion."""
MIN_TIME_STEP_S = 1e-6
"""Times must grow by more than this; chosen by hand."""
MAX_NORM_ERROR = 0.01
"""Largest deviation of a quaternion's norm from 1; chosen by hand, for rounded logs."""

INVERSE_NAMES = {
    "base_from_link": "link_from_base",
    "link_from_base": "base_from_link",
    "camera_from_board": "board_from_camera",
    "board_from_camera": "camera_from_board",
}


@dataclass(frozen=True)
class PoseLog:
    """Poses over time: times `(T,)`, strictly increasing, and transforms `(T, 4, 4)`."""

    t_s: np.ndarray
    poses: np.ndarray

    def at(self, t_s: np.ndarray) -> np.ndarray:
        """Return interpolated poses, `(N, 4, 4)`: turns along the shortest way, shifts linearly."""
        inside = np.clip(t_s, self.t_s[0], self.t_s[-1])
        turns = Slerp(self.t_s, Rotation.from_matrix(self.poses[:, :3, :3]))(inside).as_matrix()
        shifts = arm.interpolate_columns(inside, self.t_s, self.poses[:, :3, 3])
        return transforms.make_transform(turns, shifts)

    def invert(self) -> PoseLog:
        """Return the log of the inverse transforms."""
        return PoseLog(self.t_s, transforms.invert(self.poses))


@spec
class PoseLogCalibration:
    """Two CSV files of poses, `t_s,x_m,y_m,z_m,qx,qy,qz,qw`: of the arm and of the camera.

    Attributes:
        arm: Poses of the link in the base.
        camera: Poses of the board in the camera.
        arm_tells: `base_from_link`, or `link_from_base` where the log has the inverse.
        camera_tells: `camera_from_board`, or `board_from_camera`.
        camera_on: `base`: the camera stands still and the board is on the link; `link`: the other
            way round, and `T_link_cam` is found.
        arm_std: Error of the link in each pose, standard deviation of each direction: m, rad; a
            factor on it is estimated.
        camera_std: Error of the board as seen: m, rad.
        clock_s: Largest offset of the clocks that is tried; 0 takes both logs to be of one clock.
        least_correlation: Of the speeds, below which the offset is taken as 0.
        least_turn_rad: The poses should turn at least this far about two axes.
        max_poses: Of more poses, as many are used, evenly.
        work_m: Working distance, at which the uncertainty of a point is stated.
    """

    arm: str
    camera: str
    arm_tells: Literal["base_from_link", "link_from_base"]
    camera_tells: Literal["camera_from_board", "board_from_camera"]
    camera_on: Literal["base", "link"]
    arm_std: tuple[float, float]
    camera_std: tuple[float, float]
    clock_s: float
    least_correlation: float
    least_turn_rad: float
    max_poses: int
    work_m: float

    def check(self) -> None:
        smallest = min(*self.arm_std, *self.camera_std, self.work_m)
        if smallest <= 0 or self.clock_s < 0 or self.max_poses < 10:
            raise ConfigError(
                "calibration: expected arm_std, camera_std and work_m above 0, clock_s of 0 or "
                "more, max_poses of 10 or more"
            )

    def calibrate(self, machine: Machine) -> dict[str, Any]:
        """Return the content of `calibration.yaml`.

        Raises:
            ConfigError: a file cannot be read as a log of poses.
            FrameError: the poses do not determine where the camera is.
        """
        hand, eye = read_pose_log(Path(self.arm)), read_pose_log(Path(self.camera))
        if self.arm_tells == "link_from_base":
            hand = hand.invert()
        if self.camera_tells == "board_from_camera":
            eye = eye.invert()
        clock, views = self._match_logs(hand, eye)
        solution = solve_hand_eye(views)
        assert solution is not None  # there are enough
        link = views.base_from_link[solution.used]
        turns, _ = evaluation.measure_rotation_ranges(link)
        board = predict_board_poses(views, solution.guess)[solution.used]
        distance_m = np.linalg.norm(board[:, :3, 3], axis=1)
        missing = evaluation.list_missing_motions(link, distance_m, self.least_turn_rad)
        if turns[1] < MIN_TURN_SHARE * self.least_turn_rad:
            raise FrameError(
                f"calibration: the poses do not determine where the camera is: {'; '.join(missing)}"
            )
        board_key = "T_link_board" if self.camera_on == "base" else "T_base_board"
        more = {
            board_key: solution.guess.link_from_board.round(9).tolist(),
            **evaluation.summarise_solution(views, solution, clock),
            "turns_rad": turns.round(4).tolist(),
            "missing": missing,
            "verdict": self._judge(hand, eye, views, solution, missing),
        }
        residuals = evaluation.list_residuals(views, solution)
        camera, cov = solution.guess.base_from_camera, solution.cov[:6, :6]
        content = build_calibration("poses", machine, camera, cov, residuals, self.work_m, more)
        if self.camera_on == "base":
            return content
        return {
            ("T_link_cam" if name == "T_base_cam" else name): value
            for name, value in content.items()
        }

    def _match_logs(
        self, hand: PoseLog, eye: PoseLog
    ) -> tuple[clock_offset.ClockEstimate | None, HandEyeViews]:
        """Return the offset of the clocks and the views."""
        clock = None
        if self.clock_s:
            clock = clock_offset.estimate_clock_offset(
                eye.t_s,
                eye.poses[:, :3, :3],
                hand.t_s,
                hand.poses[:, :3, :3],
                self.clock_s,
                self.least_correlation,
            )
        return clock, self._build_views(hand, self._choose_poses(hand, eye, clock), clock)

    def _judge(
        self,
        hand: PoseLog,
        eye: PoseLog,
        views: HandEyeViews,
        solution: HandEyeSolution,
        missing: list[str],
    ) -> dict[str, Any]:
        """Return the verdict and whether an inverted log explains a bad one; see `verdict`.

        An inverted arm and an inverted camera look alike, since `A Y = X B` holds for the inverses
        too. For the same reason two inverted logs fit as well as none.
        """
        arm_words = INVERSE_NAMES[self.arm_tells]
        camera_words = INVERSE_NAMES[self.camera_tells]
        words = (
            "one of the logs holds the inverse poses: give "
            f"calibration.arm_tells={arm_words} or calibration.camera_tells={camera_words}"
        )
        _, other = self._match_logs(hand.invert(), eye)
        inverted = solve_hand_eye(other)
        assert inverted is not None  # as many views as before
        explanation = verdict.choose_explanation(
            [verdict.Explanation(words, compute_deviance(other, inverted.guess), inverted)],
            compute_deviance(views, solution.guess),
        )
        alone = verdict.judge_fit(
            int(solution.used.sum()), len(views), solution.factor, {}, missing
        )
        otherwise = (
            "no inverted log explains this: look at the order of the quaternions (qx qy qz qw), "
            "the units, and whether both logs are of the same motion"
        )
        return verdict.add_explanation(alone, explanation, otherwise).to_dict()

    def _choose_poses(
        self, hand: PoseLog, eye: PoseLog, clock: clock_offset.ClockEstimate | None
    ) -> PoseLog:
        """Return the boards that lie within the arm's time, at most `max_poses` of them."""
        shifted = eye.t_s + (0.0 if clock is None else clock.applied_s)
        inside = np.flatnonzero((shifted >= hand.t_s[0]) & (shifted <= hand.t_s[-1]))
        if len(inside) > self.max_poses:
            inside = inside[np.linspace(0, len(inside) - 1, self.max_poses).round().astype(int)]
        if len(inside) < MIN_VIEWS:
            raise FrameError(
                f"calibration: {len(inside)} poses of {self.camera} lie within the time of "
                f"{self.arm}, {MIN_VIEWS} are needed at least"
            )
        return PoseLog(eye.t_s[inside], eye.poses[inside])

    def _build_views(
        self, hand: PoseLog, eye: PoseLog, clock: clock_offset.ClockEstimate | None
    ) -> HandEyeViews:
        """Return the views; for a camera on the link, link and base swap their roles."""
        t_s = eye.t_s + (0.0 if clock is None else clock.applied_s)

        def interpolate_links(times_s: np.ndarray) -> np.ndarray:
            poses = hand.at(times_s)
            return poses if self.camera_on == "base" else transforms.invert(poses)

        poses, count = interpolate_links(t_s), len(t_s)
        moving = poses if self.camera_on == "base" else np.broadcast_to(np.eye(4), poses.shape)
        slack = [arm.build_wobble_motions(moving, *self.arm_std)]
        shared, std, names = np.zeros((count, 0, 6)), [], ()
        if clock is not None:
            interval_s = arm.SPEED_INTERVAL_S
            before = interpolate_links(t_s - interval_s / 2)
            after = interpolate_links(t_s + interval_s / 2)
            change = after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)
            turn = transforms.compute_rotation_vectors(change) / interval_s
            shift = (after[:, :3, 3] - before[:, :3, 3]) / interval_s
            shift = shift - np.cross(turn, poses[:, :3, 3])
            shared = np.concatenate([shift, turn], 1)[:, None]
            std, names = [clock_offset.CLOCK_STD_S], (evaluation.CLOCK_NAME,)
            slack.append(clock_offset.FRAME_JITTER_S * shared)
        cov = np.diag(np.repeat(self.camera_std, 3)) ** 2
        return HandEyeViews(
            base_from_link=poses,
            camera_from_board=eye.poses[:, None],
            seen_cov=np.broadcast_to(cov, (count, 1, 6, 6)),
            slack=np.concatenate(slack, 1),
            shared=shared,
            shared_std=np.array(std),
            names=tuple(f"{one:.3f} s" for one in eye.t_s),
            shared_names=names,
        )


def read_pose_log(path: Path) -> PoseLog:
    """Return the poses of a CSV file; a line of names may come first.

    Raises:
        ConfigError: it cannot be read, times do not increase, or turns are no unit quaternions;
            names the line.
    """
    try:
        lines = path.read_text().splitlines()
        # a letter other than that of an exponent marks a line of names
        has_names = bool(lines) and any(
            letter.isalpha() and letter not in "eE" for letter in lines[0]
        )
        skipped = int(has_names)
        table = np.loadtxt(lines[skipped:], delimiter=",", ndmin=2)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ConfigError(
            f"{path}: expected CSV with the columns {','.join(COLUMNS)} ({error})"
        ) from error
    if table.ndim != 2 or table.shape[1] != len(COLUMNS) or not len(table):
        raise ConfigError(
            f"{path}: expected the columns {','.join(COLUMNS)}, got {table.shape[-1]} columns"
        )
    norm_error = np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0)
    wrong = ~np.isfinite(table).all(1) | (norm_error > MAX_NORM_ERROR)
    if wrong.any():
        line = int(np.flatnonzero(wrong)[0]) + skipped + 1
        raise ConfigError(
            f"{path}: line {line}: expected numbers and a unit quaternion qx qy qz qw"
        )
    if len(table) < MIN_VIEWS:
        raise ConfigError(f"{path}: {len(table)} poses, {MIN_VIEWS} are needed at least")
    if (step := np.diff(table[:, 0])).min() <= MIN_TIME_STEP_S:
        line = int(np.argmin(step)) + skipped + 2
        raise ConfigError(f"{path}: line {line}: time does not increase")
    turns = Rotation.from_quat(table[:, 4:]).as_matrix()
    return PoseLog(table[:, 0], transforms.make_transform(turns, table[:, 1:4]))
