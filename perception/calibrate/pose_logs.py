"""Calibration from two logs of poses: where the arm says the link is, and where somebody else's tracker sees the board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from perception.calibrate import arm, clock_offset, evaluation, transforms
from perception.calibrate.extrinsics import build_calibration
from perception.calibrate.hand_eye import (
    MIN_VIEWS,
    HandEyeViews,
    predict_board_poses,
    solve_hand_eye,
)

COLUMNS = ("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
SPEED_OVER_S = 0.1
MIN_TIME_STEP_S = 1e-6


@dataclass(frozen=True)
class PoseLog:
    """Poses over time: times `(T,)`, strictly increasing, and transforms `(T, 4, 4)`."""

    t_s: np.ndarray
    poses: np.ndarray

    def at(self, t_s: np.ndarray) -> np.ndarray:
        """Returns poses in between, `(N, 4, 4)`: turns along the shortest way, shifts along lines."""
        inside = np.clip(t_s, self.t_s[0], self.t_s[-1])
        turns = Slerp(self.t_s, Rotation.from_matrix(self.poses[:, :3, :3]))(inside).as_matrix()
        return transforms.make_transform(
            turns, np.stack([np.interp(inside, self.t_s, self.poses[:, k, 3]) for k in range(3)], 1)
        )


@spec
class PoseLogCalibration:
    """Two CSV files of poses, `t_s,x_m,y_m,z_m,qx,qy,qz,qw`: what the arm says and what the camera sees.

    Attributes:
        arm: Poses of the link in the base.
        camera: Poses of the board in the camera.
        arm_tells: `base_from_link`, or `link_from_base` where the log has the inverse.
        camera_tells: `camera_from_board`, or `board_from_camera`.
        camera_on: `base`: the camera stands still and the board is on the link; `link`: the other
            way round, and `T_link_cam` is found.
        arm_std: By how much the link is elsewhere in each pose, standard deviation of each
            direction: m, rad. How much more it is, the poses tell.
        camera_std: By how much a board is seen elsewhere: m, rad.
        clock_s: Largest offset of the clocks that is looked for; 0 takes both logs to be of one
            clock.
        least_correlation: Of the speeds, below which their offset is taken for 0.
        least_turn_rad: The poses turn at least this far about two axes.
        max_poses: Of more poses, as many are used, evenly.
        work_m: How far before the camera it is used: there its uncertainty is told.
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
        if (
            min(*self.arm_std, *self.camera_std, self.work_m) <= 0
            or self.clock_s < 0
            or self.max_poses < 10
        ):
            raise ConfigError(
                "calibration: expected arm_std, camera_std and work_m above 0, clock_s of 0 or more, max_poses of 10 or more"
            )

    def calibrate(self, machine: Machine) -> dict[str, Any]:
        """Returns what `calibration.yaml` says.

        Raises:
            ConfigError: a file cannot be read as a log of poses.
            FrameError: the poses do not tell where the camera is.
        """
        hand, eye = read_pose_log(Path(self.arm)), read_pose_log(Path(self.camera))
        if self.arm_tells == "link_from_base":
            hand = PoseLog(hand.t_s, transforms.invert(hand.poses))
        if self.camera_tells == "board_from_camera":
            eye = PoseLog(eye.t_s, transforms.invert(eye.poses))
        offset = None
        if self.clock_s:
            turns = (eye.t_s, eye.poses[:, :3, :3], hand.t_s, hand.poses[:, :3, :3])
            offset = clock_offset.estimate_clock_offset(
                *turns, self.clock_s, self.least_correlation
            )
        shift_s = offset.offset_s if offset is not None and offset.is_trusted else 0.0
        inside = np.flatnonzero(
            (eye.t_s + shift_s >= hand.t_s[0]) & (eye.t_s + shift_s <= hand.t_s[-1])
        )
        if len(inside) > self.max_poses:
            inside = inside[np.linspace(0, len(inside) - 1, self.max_poses).round().astype(int)]
        if len(inside) < MIN_VIEWS:
            raise FrameError(
                f"calibration: {len(inside)} poses of {self.camera} lie within the time of {self.arm}, "
                f"{MIN_VIEWS} are needed at least"
            )
        views = self._views(hand, eye.t_s[inside], eye.poses[inside], shift_s, offset is not None)
        solution = solve_hand_eye(views)
        assert solution is not None  # there are enough
        turned, _ = evaluation.measure_rotation_ranges(views.base_from_link[solution.used])
        distance_m = np.linalg.norm(
            predict_board_poses(views, solution.guess)[solution.used, :3, 3], axis=1
        )
        missing = evaluation.list_missing_motions(
            views.base_from_link[solution.used], distance_m, self.least_turn_rad
        )
        if turned[1] < 0.1 * self.least_turn_rad:
            raise FrameError(
                f"calibration: the poses do not tell where the camera is: {'; '.join(missing)}"
            )
        other = "T_link_board" if self.camera_on == "base" else "T_base_board"
        more = {
            other: solution.guess.link_from_board.round(9).tolist(),
            **evaluation.summarise_solution(views, solution, offset, shift_s),
            "turns_rad": turned.round(4).tolist(),
            "missing": missing,
        }
        cov, judged = solution.cov[:6, :6], evaluation.list_residuals(views, solution)
        told = build_calibration(
            "poses", machine, solution.guess.base_from_camera, cov, judged, self.work_m, more
        )
        if self.camera_on == "base":
            return told
        return {
            ("T_link_cam" if name == "T_base_cam" else name): value for name, value in told.items()
        }

    def _views(
        self, hand: PoseLog, eye_s: np.ndarray, seen: np.ndarray, shift_s: float, moving: bool
    ) -> HandEyeViews:
        """Returns the views. A camera on the link is the same problem with link and base in each other's place."""
        t_s = eye_s + shift_s

        def at(times: np.ndarray) -> np.ndarray:
            poses = hand.at(times)
            return poses if self.camera_on == "base" else transforms.invert(poses)

        poses, count = at(t_s), len(t_s)
        about = poses if self.camera_on == "base" else np.broadcast_to(np.eye(4), poses.shape)
        slack, shared, std, names = (
            [arm.build_wobble_motions(about, *self.arm_std)],
            np.zeros((count, 0, 6)),
            [],
            (),
        )
        if moving:
            before, after = at(t_s - SPEED_OVER_S / 2), at(t_s + SPEED_OVER_S / 2)
            turn = (
                transforms.compute_rotation_vectors(
                    after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)
                )
                / SPEED_OVER_S
            )
            shift = (after[:, :3, 3] - before[:, :3, 3]) / SPEED_OVER_S - np.cross(
                turn, poses[:, :3, 3]
            )
            shared, std, names = (
                np.concatenate([shift, turn], 1)[:, None],
                [clock_offset.CLOCK_STD_S],
                (evaluation.CLOCK_NAME,),
            )
            slack.append(clock_offset.FRAME_JITTER_S * shared)
        cov = np.diag(np.repeat(self.camera_std, 3)) ** 2
        return HandEyeViews(
            poses, seen[:, None], np.broadcast_to(cov, (count, 1, 6, 6)), np.concatenate(slack, 1), shared, np.array(std),
            tuple(f"{one:.3f} s" for one in eye_s), names,
        )  # fmt: skip


def read_pose_log(path: Path) -> PoseLog:
    """Returns the poses of a CSV file; a line of names may come first.

    Raises:
        ConfigError: it cannot be read, times do not increase, or turns are no unit quaternions;
            names the line.
    """
    try:
        lines = path.read_text().splitlines()
        skipped = (
            1
            if lines and any(letter.isalpha() and letter not in "eE" for letter in lines[0])
            else 0
        )
        table = np.loadtxt(lines[skipped:], delimiter=",", ndmin=2)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ConfigError(
            f"{path}: expected CSV with the columns {','.join(COLUMNS)} ({error})"
        ) from error
    if table.ndim != 2 or table.shape[1] != len(COLUMNS) or not len(table):
        raise ConfigError(
            f"{path}: expected the columns {','.join(COLUMNS)}, got {table.shape[-1]} columns"
        )
    wrong = ~np.isfinite(table).all(1) | (np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0) > 0.01)
    if wrong.any():
        raise ConfigError(
            f"{path}: line {int(np.flatnonzero(wrong)[0]) + skipped + 1}: expected numbers and a unit quaternion qx qy qz qw"
        )
    if len(table) < MIN_VIEWS:
        raise ConfigError(f"{path}: {len(table)} poses, {MIN_VIEWS} are needed at least")
    if (step := np.diff(table[:, 0])).min() <= MIN_TIME_STEP_S:
        raise ConfigError(
            f"{path}: line {int(np.argmin(step)) + skipped + 2}: time does not increase"
        )
    return PoseLog(
        table[:, 0],
        transforms.make_transform(Rotation.from_quat(table[:, 4:]).as_matrix(), table[:, 1:4]),
    )
