"""`brokk mode=score_camera`: holes found in a recorded session against holes measured by hand.

A board lies on the drilled face or beside it, in its plane. Each frame sees the board, and so the
measured holes have a place in each frame. Real sessions and rendered ones are different rows.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from annotated_types import MinLen

from brokk_rl.console_table import print_table
from brokk_rl.contracts.vision import FinderSpec, FrameSourceSpec, HolePose
from brokk_rl.errors import FrameError
from brokk_rl.session import Session, write_json
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception.label.camera_pose import Charuco
from perception.label.labeller import MeasuredHole, read_measured
from perception.sources.look import look_at_frames

log = logging.getLogger(__name__)

FILE = "score.json"
NEAR_M = 0.05
"""A found hole belongs to the true one whose centre lies this near: a hole's radius."""


@dataclass(frozen=True)
class HoleError:
    """Error of one found hole.

    Attributes:
        frame: Name of the frame.
        distance_m: From the camera.
        position_m: Error of the centre.
        std_m: Its standard deviation as stated, the root of the covariance's trace.
        sigmas: Error in standard deviations as stated (Mahalanobis).
        normal_rad: Error of the axis.
    """

    frame: str
    distance_m: float
    position_m: float
    std_m: float
    sigmas: float
    normal_rad: float


@spec
class ScoreOptions:
    """Truth of a session and the row that it becomes.

    Attributes:
        truth: YAML file of the measured holes.
        kind: `real` or `rendered`: rows of one kind are never mixed with the other's.
        name: Name of the row: camera, place and day.
    """

    truth: str
    kind: Literal["real", "rendered"]
    name: Annotated[str, MinLen(1)]


@spec
class ScoreCamera:
    """Find the holes of a session's frames, and compare them with those measured by hand.

    Attributes:
        session: Folder to write into.
        perception: Finder of boreholes.
        source: The frames.
        board: The board in view.
        score: Truth and row.
    """

    session: Session
    perception: FinderSpec
    source: FrameSourceSpec
    board: Charuco
    score: ScoreOptions

    def run(self) -> float | None:
        """Write `score.json`, and show its row.

        Returns:
            The median error of the centre, m; `None` where nothing was found.

        Raises:
            ConfigError: the truth cannot be read.
            FrameError: no frame shows the board.
        """
        scene = read_measured(Path(self.score.truth), "score.truth")
        frames, refused = self._score_frames(scene.holes)
        if not frames:
            first = next(iter(refused.values()), "none")
            raise FrameError(f"score_camera: no frame can be judged; the first: {first}")
        errors = [one for some, _ in frames for one in some]
        median_m = high_m = normal_rad = None
        if errors:
            median_m, high_m = np.percentile([one.position_m for one in errors], (50, 95)).tolist()
            normal_rad = float(np.median([one.normal_rad for one in errors]))
        row = {
            "kind": self.score.kind,
            "name": self.score.name,
            "frames": len(frames),
            "refused_frames": len(refused),
            "holes": len(frames) * len(scene.holes),
            "found": len(errors),
            "false": sum(num_false for _, num_false in frames),
            "position_m_median": median_m,
            "position_m_p95": high_m,
            "normal_rad_median": normal_rad,
            "inside_3_sigma": sum(one.sigmas <= 3.0 for one in errors),
            "truth_std_m": scene.std_m,
        }
        content = {"schema": 1, **row, "refused": refused, "errors": [vars(one) for one in errors]}
        write_json(self.session.folder / FILE, content)
        rows = []
        for name, value in row.items():
            rows.append((name, f"{value:.3g}" if isinstance(value, float) else value))
        print_table((), rows)
        return median_m

    def _score_frames(
        self, holes: Sequence[MeasuredHole]
    ) -> tuple[list[tuple[list[HoleError], int]], dict[str, str]]:
        """Return errors and false holes of each frame, and why others were left out."""
        finder = self.perception.build()

        def score(frame: Frame) -> tuple[list[HoleError], int]:
            camera_from_board = self.board.locate(frame).camera_from_board[0]
            # In camera coordinates, as the board tells the truth.
            found = finder.find(replace(frame, base_from_camera=None))
            turn, shift_m = camera_from_board[:3, :3], camera_from_board[:3, 3]
            true = [(turn @ hole.center_m + shift_m, turn @ hole.outward) for hole in holes]
            return match_found_holes(Path(frame.name).name, found.holes, true)

        frames, refused = [], {}
        for name, one, reason in look_at_frames(self.source, "frames", score):
            if one is None:
                refused[name] = reason
            else:
                frames.append(one)
        return frames, refused


def match_found_holes(
    name: str, found: Sequence[HolePose], true: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[list[HoleError], int]:
    """Return the errors of the found holes of one frame, and how many belong to none that is there.

    Args:
        name: Of the frame.
        found: Holes in the camera's coordinates.
        true: Centre and axis of each hole that could be found, in the same coordinates.
    """
    errors, left = [], list(found)
    for center_m, axis in true:
        best = min(left, key=lambda one: _measure_away_m(one, center_m), default=None)
        if best is None or _measure_away_m(best, center_m) > NEAR_M:
            continue
        left = [one for one in left if one is not best]
        away = best.center_m - center_m
        errors.append(
            HoleError(
                frame=name,
                distance_m=float(np.linalg.norm(center_m)),
                position_m=float(np.linalg.norm(away)),
                std_m=float(np.sqrt(np.trace(best.cov_m2))),
                sigmas=float(np.sqrt(away @ np.linalg.pinv(best.cov_m2) @ away)),
                normal_rad=float(np.arccos(np.clip(np.dot(best.axis, axis), -1, 1))),
            )
        )
    return errors, len(left)


def _measure_away_m(hole: HolePose, center_m: np.ndarray) -> float:
    return float(np.linalg.norm(hole.center_m - center_m))
