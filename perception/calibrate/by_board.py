"""Calibration from frames of a board on the arm and the joint positions there."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from rich.progress import Progress

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from perception.calibrate import arm, clock, judgement, spread
from perception.calibrate.hand_eye import FEWEST, Solution, solve
from perception.calibrate.result import Judged, stored
from perception.calibrate.sights import Sight, sight
from perception.calibrate.views import Views, expected
from perception.label.camera import BoardTracker

log = logging.getLogger(__name__)


class BoardSpec(Protocol):
    """A board of `conf/perception/camera_pose`."""

    def build(self) -> BoardTracker:
        """Returns a tracker."""
        ...


@dataclass(frozen=True)
class Seen:
    """A frame in which the board was found: its name, time, the board, and the joint positions, `(J,)`."""

    name: str
    t_s: float
    sight: Sight
    q: np.ndarray


@spec
class ByBoard:
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
        track = arm.read(Path(self.joints), machine)
        seen, refused = self._seen(track)
        offset = self._offset(machine, track, seen)
        shift_s = offset.offset_s if offset is not None and offset.is_trusted else 0.0
        seen = self._with_joints(track, seen, shift_s, refused)
        if len(seen) < FEWEST:
            reasons = sorted({one.left_out or "" for one in refused})[:3]
            raise FrameError(
                f"calibration: {len(seen)} frames show the board where the joint positions are known, {FEWEST} are needed, "
                f"20 are good. Left out: {'; '.join(reasons) or 'none'}"
            )
        if len(seen) > self.max_poses:
            seen = [
                seen[k] for k in np.linspace(0, len(seen) - 1, self.max_poses).round().astype(int)
            ]
        views = self._views(machine, track, seen, shift_s, offset is not None)
        solution = solve(views)
        assert solution is not None  # there are enough
        return self._told(machine, views, solution, seen, refused, offset, shift_s)

    def _seen(self, track: arm.Track) -> tuple[list[Seen], list[Judged]]:
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
                    one = sight(frame, there, where, self.corner_px, self.max_error_px)
                    found.append(
                        Seen(Path(frame.name).name, frame.t_s, one, np.zeros(track.q.shape[1]))
                    )
                except FrameError as error:
                    refused.append(
                        Judged(str(error).split(":")[0].split("/")[-1], None, None, str(error))
                    )

    def _offset(
        self, machine: Machine, track: arm.Track, seen: list[Seen]
    ) -> clock.ClockOffset | None:
        if track.t_s is None or len(seen) < clock.FEWEST or not self.clock_s:
            return None
        times, turns = (
            np.array([one.t_s for one in seen]),
            np.stack([one.sight.camera_from_board[0, :3, :3] for one in seen]),
        )
        link_turns = arm.links(machine, track.q).base_from_link[:, :3, :3]
        return clock.offset(
            times, turns, track.t_s, link_turns, self.clock_s, self.least_correlation
        )

    def _with_joints(
        self, track: arm.Track, seen: list[Seen], shift_s: float, refused: list[Judged]
    ) -> list[Seen]:
        known = []
        for one in seen:
            q = track.at(one.name, one.t_s + shift_s)
            if q is None:
                refused.append(
                    Judged(one.name, None, None, f"{self.joints} has no joint positions for it")
                )
            else:
                known.append(Seen(one.name, one.t_s, one.sight, q))
        return known

    def _views(
        self, machine: Machine, track: arm.Track, seen: list[Seen], shift_s: float, moving: bool
    ) -> Views:
        q = np.stack([one.q for one in seen])
        links = arm.links(machine, q)
        # a wrong zero of the first joint is a camera elsewhere, one of the last a board elsewhere:
        # the arm itself believes it too
        inner = range(1, machine.num_joints - 1) if self.zero_std_rad else range(0)
        shared, std = links.joints[:, inner], [self.zero_std_rad] * len(inner)
        names = [machine.joint_names[k] for k in inner]
        slack = [
            self.joint_std_rad * links.joints,
            arm.wobble(links.base_from_link, self.wobble_m, self.wobble_rad),
        ]
        if moving:
            speed = track.speed(np.array([one.t_s for one in seen]) + shift_s)
            late = np.einsum("nj,njk->nk", speed, links.joints)[:, None]
            shared, std, names = (
                np.concatenate([shared, late], 1),
                [*std, clock.STD_S],
                [*names, judgement.CLOCK],
            )
            slack.append(clock.JITTER_S * late)
        poses, covs = (
            np.stack([getattr(one.sight, name) for one in seen])
            for name in ("camera_from_board", "cov")
        )
        return Views(
            links.base_from_link, poses, covs, np.concatenate(slack, 1), shared, np.array(std), tuple(one.name for one in seen),
            tuple(names),
        )  # fmt: skip

    def _told(
        self, machine: Machine, views: Views, solution: Solution, seen: list[Seen], refused: list[Judged],
        offset: clock.ClockOffset | None, shift_s: float,
    ) -> dict[str, Any]:  # fmt: skip
        used = np.flatnonzero(solution.used)
        q = np.stack([seen[k].q for k in used])
        distance_m = np.linalg.norm(expected(views, solution.guess)[used, :3, 3], axis=1)
        missing = spread.missing(
            machine, q, views.base_from_link[used], distance_m, self.least_turn_rad
        )
        turns, _ = spread.turns_rad(views.base_from_link[used])
        if turns[1] < 0.1 * self.least_turn_rad or len(used) < FEWEST:
            raise FrameError(
                f"calibration: the poses do not tell where the camera is: {'; '.join(missing) or 'too few agree'}"
            )
        for one in missing:
            log.warning("calibration: %s", one)
        more = {
            "temperature_c": self.temperature_c,
            "T_link_board": solution.guess.link_from_board.round(9).tolist(),
            **judgement.told(views, solution, offset, shift_s),
            "corners_px": round(float(np.median([one.sight.error_px for one in seen])), 3),
            "turns_rad": turns.round(4).tolist(),
            "missing": missing,
        }
        judged = [*judgement.of_views(views, solution), *refused]
        cov = solution.cov[:6, :6]
        return stored(
            "board", machine, solution.guess.base_from_camera, cov, judged, self.work_m, more
        )
