"""Calibration from points that the tip of the tool has touched and that somebody clicked in a frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception.calibrate import arm, touched
from perception.calibrate.result import Judged, stored

EXAMPLE = """expected YAML such as
  points:
    - {frame: "00003", pixel: [812, 440], q: [0.1, -0.9, 0.6, 0.8, 0.7]}  # where the tip touches, and the joint positions then
    - {camera_m: [0.2, 0.1, 2.3], base_m: [2.6, 0.3, 0.4]}                # or both ends, measured"""
FEWEST_PIXELS = 12
TRIMS = 4


@dataclass(frozen=True)
class Touch:
    """A point as the file tells it; what is not given is `None`."""

    name: str
    frame: str | None
    pixel: np.ndarray | None
    camera_m: np.ndarray | None
    q: np.ndarray | None
    base_m: np.ndarray | None


@spec
class ByTouch:
    """Points touched with the tip of the tool; six or more, well apart, need neither a board nor a second person.

    Attributes:
        source: The frames that were clicked in; not opened where the file tells camera coordinates.
        points: YAML file; see `EXAMPLE`.
        tip_std_m: Standard deviation of the tip in each direction, from joints and geometry.
        click_px: Standard deviation of a click.
        noise_per_m: Standard deviation of inverse depth, 1/m; a plane through the window averages
            it.
        window_px: Depth is read from a plane through a window that reaches this far from the click.
        least_width_m: Points spread at least so far across the line that fits them best (standard
            deviation).
        work_m: How far before the camera it is used: there its uncertainty is told.
        temperature_c: Of the day, for the record; `null` where nobody measured.
    """

    source: FrameSourceSpec
    points: str
    tip_std_m: float
    click_px: float
    noise_per_m: float
    window_px: int
    least_width_m: float
    work_m: float
    temperature_c: float | None

    def check(self) -> None:
        if (
            min(self.tip_std_m, self.click_px, self.noise_per_m, self.least_width_m, self.work_m)
            <= 0
            or self.window_px < 2
        ):
            raise ConfigError(
                "calibration: expected tip_std_m, click_px, noise_per_m, least_width_m and work_m above 0, window_px of 2 or more"
            )

    def calibrate(self, machine: Machine) -> dict[str, Any]:
        """Returns what `calibration.yaml` says.

        Raises:
            ConfigError: the file of points cannot be read.
            FrameError: the points do not tell where the camera is; says what is missing.
        """
        touches = read(Path(self.points), machine.num_joints)
        frames = self._frames({one.frame for one in touches if one.frame is not None})
        names, here, there, covs, refused = [], [], [], [], []
        for one in touches:
            try:
                at, cov = self._seen(one, frames)
            except FrameError as error:
                refused.append(Judged(one.name, None, None, str(error)))
                continue
            names.append(one.name)
            here.append(at)
            covs.append(cov)
            there.append(
                one.base_m if one.q is None else arm.links(machine, one.q[None]).tip_in_base_m[0]
            )
        found = None
        if names:
            points = touched.Points(np.array(here), np.array(there), np.array(covs))
            found = touched.fit(points, self.tip_std_m)
        if found is None:
            why = (
                f" Left out: {'; '.join(str(one.left_out) for one in refused[:3])}"
                if refused
                else ""
            )
            raise FrameError(
                f"calibration: {len(names)} points can be used, {touched.FEWEST} are needed at least, 8 are good.{why}"
            )
        width_m = touched.width_m(np.array(there)[found.used])
        if width_m < self.least_width_m:
            raise FrameError(
                f"calibration: the points lie within {width_m:.3f} m of a line, {self.least_width_m:g} m are needed: "
                "touch some beside it, and some higher or lower"
            )
        judged = [
            Judged(
                name, float(np.linalg.norm(away)), None,
                None if good else f"{1000 * float(np.linalg.norm(away)):.0f} mm off while the others agree",
            )
            for name, away, good in zip(names, found.away_m, found.used, strict=True)
        ]  # fmt: skip
        more = {
            "temperature_c": self.temperature_c,
            "arm_factor": round(found.factor, 3),
            "width_m": round(width_m, 4),
            "missing": [],
        }
        return stored(
            "touched",
            machine,
            found.base_from_camera,
            found.cov,
            [*judged, *refused],
            self.work_m,
            more,
        )

    def _frames(self, wanted: set[str]) -> dict[str, Frame]:
        found: dict[str, Frame] = {}
        if not wanted:
            return found
        with self.source.build() as source:
            while True:
                try:
                    frame = source.read_latest()
                except FrameError:
                    continue  # it is missed below if somebody clicked in it
                if frame is None:
                    return found
                if Path(frame.name).name in wanted:
                    found[Path(frame.name).name] = frame

    def _seen(self, one: Touch, frames: dict[str, Frame]) -> tuple[np.ndarray, np.ndarray]:
        """Returns a point in camera coordinates, and its covariance."""
        if one.camera_m is not None:
            z, focal_px, sight = (
                float(one.camera_m[2]),
                1000.0,
                one.camera_m / np.linalg.norm(one.camera_m),
            )
            return one.camera_m, _cov(sight, self.noise_per_m * z**2, self.click_px * z / focal_px)
        frame = frames.get(str(one.frame))
        if frame is None or one.pixel is None:
            raise FrameError(f"there is no frame '{one.frame}' that can be used")
        point, along_m = depth_at(frame, one.pixel, self.window_px, self.noise_per_m)
        across_m = self.click_px * point[2] / float(frame.camera_matrix[0, 0])
        return point, _cov(point / np.linalg.norm(point), along_m, across_m)


def depth_at(
    frame: Frame, pixel: np.ndarray, window_px: int, noise_per_m: float
) -> tuple[np.ndarray, float]:
    """Returns the point behind a pixel, `(3,)` m, by a plane through the depth around it, and its standard deviation along z.

    Raises:
        FrameError: too little depth is known there.
    """
    height, width = frame.depth_m.shape
    rows, columns = np.mgrid[
        max(0, round(pixel[1]) - window_px) : min(height, round(pixel[1]) + window_px + 1),
        max(0, round(pixel[0]) - window_px) : min(width, round(pixel[0]) + window_px + 1),
    ].reshape(2, -1)
    known = np.isfinite(frame.depth_m[rows, columns])
    if known.sum() < FEWEST_PIXELS:
        raise FrameError(
            f"{frame.name}: depth is known at {known.sum()} pixels around {pixel.tolist()}, {FEWEST_PIXELS} are needed"
        )
    rows, columns = rows[known], columns[known]
    inverse = 1.0 / frame.depth_m[rows, columns].astype(float)
    table = np.stack([columns - pixel[0], rows - pixel[1], np.ones(len(rows))], 1)
    kept = (
        np.abs(inverse - np.median(inverse))
        <= 2.5 * 1.4826 * np.median(np.abs(inverse - np.median(inverse))) + 1e-6
    )
    plane = np.zeros(3)
    for _ in range(TRIMS):
        plane = np.linalg.lstsq(table[kept], inverse[kept], rcond=None)[0]
        away = np.abs(table @ plane - inverse)
        kept = away <= 2.5 * 1.4826 * np.median(away) + 1e-6
    z = 1.0 / plane[2]
    spread = np.linalg.pinv(table[kept].T @ table[kept])[2, 2]
    flat = cv2.undistortPoints(
        pixel.reshape(1, 1, 2).astype(float),
        np.asarray(frame.camera_matrix, float),
        frame.distortion,
    )
    # neighbours share a matcher's window: some ten pixels are as good as one
    return z * np.array([*flat.ravel(), 1.0]), float(
        z**2 * noise_per_m * np.sqrt(min(1.0, 10.0 * spread))
    )


def read(path: Path, num_joints: int) -> list[Touch]:
    """Returns the points of a file.

    Raises:
        ConfigError: it cannot be read, or a point lacks one of its ends; shows how it should look.
    """
    try:
        told = yaml.safe_load(path.read_text())["points"]
        found = [_touch(number, one, num_joints) for number, one in enumerate(told)]
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"calibration.points={path}: {type(error).__name__} {error}; {EXAMPLE}"
        ) from error
    return found


def _touch(number: int, one: dict[str, Any], num_joints: int) -> Touch:
    sizes = {"pixel": 2, "camera_m": 3, "q": num_joints, "base_m": 3}
    values = {name: np.asarray(one[name], float) if name in one else None for name in sizes}
    for name, size in sizes.items():
        value = values[name]
        if value is not None and (value.shape != (size,) or not np.isfinite(value).all()):
            raise ValueError(f"point {number}: {name} has {value.size} numbers, expected {size}")
    if (values["camera_m"] is None) == (values["pixel"] is None) or (values["q"] is None) == (
        values["base_m"] is None
    ):
        raise ValueError(f"point {number} needs one of pixel and camera_m, and one of q and base_m")
    if values["pixel"] is not None and "frame" not in one:
        raise ValueError(f"point {number}: in which frame was it clicked?")
    frame = str(one["frame"]) if "frame" in one else None
    return Touch(
        str(one.get("name", f"point {number}")),
        frame,
        values["pixel"],
        values["camera_m"],
        values["q"],
        values["base_m"],
    )


def _cov(sight: np.ndarray, along_m: float, across_m: float) -> np.ndarray:
    along = np.outer(sight, sight)
    return along_m**2 * along + across_m**2 * (np.eye(3) - along)
