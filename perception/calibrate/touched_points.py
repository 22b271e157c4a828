"""The camera's place from points that the chisel has touched and the camera has seen; needs no board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.stats import chi2

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception.calibrate import arm, transforms
from perception.calibrate.extrinsics import PoseResidual, build_calibration

# --- from by_touch: Calibration from points that the tip of the tool has touched and that
# somebody clicked in a frame.

FREEDOM = 4.0
"""Of Student's t, as in `hand_eye`."""
TRIPLES = 300
OUTSIDE = float(chi2.ppf(0.999, 3))
MIN_POINTS = 4
STEPS = 60


@dataclass(frozen=True)
class PointPairs:
    """`N` points, each known twice.

    Attributes:
        in_camera_m: As seen, `(N, 3)`.
        in_base_m: The tool's tip there, `(N, 3)`.
        cov_m2: Covariance of each as seen, `(N, 3, 3)` in the camera's frame: mostly along the
            sight.
    """

    in_camera_m: np.ndarray
    in_base_m: np.ndarray
    cov_m2: np.ndarray

    def part(self, chosen: np.ndarray) -> PointPairs:
        """Returns the chosen points."""
        return PointPairs(self.in_camera_m[chosen], self.in_base_m[chosen], self.cov_m2[chosen])

    def away_m(self, place: np.ndarray) -> np.ndarray:
        """Returns how far the tip was from where a camera at `place`, `(4, 4)`, sees each point, `(N, 3)` in the base frame."""
        return self.in_base_m - (self.in_camera_m @ place[:3, :3].T + place[:3, 3])

    def kabsch(self) -> np.ndarray:
        """Returns the camera's place, `(4, 4)`, that makes the sum of squared distances least (Kabsch, 1976)."""
        middle, there = self.in_camera_m.mean(0), self.in_base_m.mean(0)
        turn = transforms.find_nearest_rotation(
            (self.in_base_m - there).T @ (self.in_camera_m - middle)
        )
        return transforms.make_transform(turn, there - turn @ middle)


@dataclass(frozen=True)
class PointFit:
    """What came out.

    Attributes:
        base_from_camera: The camera, `(4, 4)`.
        cov: Covariance of a small motion of it in its own frame, `(6, 6)`.
        factor: The tip is this many times less exact than was assumed, 1 or more.
        away_m: How far the tip was from where the camera sees each point, `(N, 3)` in the base
            frame.
        used: Which points were believed in the end, `(N,)` bool.
    """

    base_from_camera: np.ndarray
    cov: np.ndarray
    factor: float
    away_m: np.ndarray
    used: np.ndarray


def fit_camera_to_points(points: PointPairs, tip_std_m: float) -> PointFit | None:
    """Returns the camera's place; `None` where there are too few points to contradict each other.

    Args:
        points: What was touched.
        tip_std_m: Standard deviation of the tip in each direction.
    """
    count = len(points.in_camera_m)
    if count < MIN_POINTS:
        return None
    generator = np.random.default_rng(0)
    groups = [
        np.arange(count),
        *(generator.choice(count, 3, replace=False) for _ in range(TRIPLES)),
    ]
    places = [points.part(group).kabsch() for group in groups]
    place = places[
        int(np.argmin([np.median(np.linalg.norm(points.away_m(one), axis=1)) for one in places]))
    ]
    # half of the points may be wrong: the median says how exact the others are
    distance = _build_normal_equations(points, place, tip_std_m, None)[0]
    std_m = tip_std_m * np.sqrt(max(1.0, np.median(distance) / chi2.ppf(0.5, 3)))
    place = _refine_pose(points, place, std_m, None)
    used = _build_normal_equations(points, place, std_m, None)[0] <= OUTSIDE
    used = used if used.sum() >= MIN_POINTS else np.ones(count, bool)
    good, full = points.part(used), np.ones(int(used.sum()))
    place = _refine_pose(good, place, std_m, full)
    distance, normal, _ = _build_normal_equations(good, place, std_m, full)
    excess = max(1.0, float(distance.sum()) / max(3.0 * used.sum() - 6.0, 1.0))
    cov = excess * np.linalg.pinv(normal, hermitian=True)
    return PointFit(
        place, cov, float(std_m / tip_std_m * np.sqrt(excess)), points.away_m(place), used
    )


def compute_width_m(in_base_m: np.ndarray) -> float:
    """Returns how far points, `(N, 3)`, spread across the line that fits them best, standard deviation; 0 lets them turn."""
    return float(
        np.linalg.svd(in_base_m - in_base_m.mean(0), compute_uv=False)[1] / np.sqrt(len(in_base_m))
    )


def _build_normal_equations(
    points: PointPairs, place: np.ndarray, tip_std_m: float, fixed: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns squared distances in standard deviations, and the normal equations of a small motion of the camera."""
    away = points.away_m(place) @ place[:3, :3]  # in the camera's frame
    information = np.linalg.inv(points.cov_m2 + tip_std_m**2 * np.eye(3))
    distance = np.einsum("ni,nij,nj->n", away, information, away)
    weight = (FREEDOM + 3) / (FREEDOM + distance) if fixed is None else fixed
    slopes = np.concatenate(
        [
            np.broadcast_to(-np.eye(3), (len(away), 3, 3)),
            transforms.build_cross_matrices(points.in_camera_m),
        ],
        2,
    )
    weighted = np.swapaxes(slopes, 1, 2) @ (weight[:, None, None] * information)
    return distance, (weighted @ slopes).sum(0), (weighted @ away[..., None]).sum(0)[:, 0]


def _refine_pose(
    points: PointPairs, place: np.ndarray, tip_std_m: float, fixed: np.ndarray | None
) -> np.ndarray:
    for _ in range(STEPS):
        _, normal, gradient = _build_normal_equations(points, place, tip_std_m, fixed)
        step = -np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
        place = transforms.apply_motion(place, step)
        if np.abs(step).max() < 1e-10:
            break
    return place


EXAMPLE = """expected YAML such as
  points:
    - {frame: "00003", pixel: [812, 440], q: [0.1, -0.9, 0.6, 0.8, 0.7]}  # where the tip touches, and the joint positions then
    - {camera_m: [0.2, 0.1, 2.3], base_m: [2.6, 0.3, 0.4]}                # or both ends, measured"""
FEWEST_PIXELS = 12
TRIMS = 4


@dataclass(frozen=True)
class TouchedPoint:
    """A point as the file tells it; what is not given is `None`."""

    name: str
    frame: str | None
    pixel: np.ndarray | None
    camera_m: np.ndarray | None
    q: np.ndarray | None
    base_m: np.ndarray | None


@spec
class TouchCalibration:
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
        touches = read_touched_points(Path(self.points), machine.num_joints)
        frames = self._frames({one.frame for one in touches if one.frame is not None})
        names, here, there, covs, refused = [], [], [], [], []
        for one in touches:
            try:
                at, cov = self._seen(one, frames)
            except FrameError as error:
                refused.append(PoseResidual(one.name, None, None, str(error)))
                continue
            names.append(one.name)
            here.append(at)
            covs.append(cov)
            there.append(
                one.base_m
                if one.q is None
                else arm.compute_link_poses(machine, one.q[None]).tip_in_base_m[0]
            )
        found = None
        if names:
            points = PointPairs(np.array(here), np.array(there), np.array(covs))
            found = fit_camera_to_points(points, self.tip_std_m)
        if found is None:
            why = (
                f" Left out: {'; '.join(str(one.left_out) for one in refused[:3])}"
                if refused
                else ""
            )
            raise FrameError(
                f"calibration: {len(names)} points can be used, {MIN_POINTS} are needed at least, 8 are good.{why}"
            )
        width_m = compute_width_m(np.array(there)[found.used])
        if width_m < self.least_width_m:
            raise FrameError(
                f"calibration: the points lie within {width_m:.3f} m of a line, {self.least_width_m:g} m are needed: "
                "touch some beside it, and some higher or lower"
            )
        judged = [
            PoseResidual(
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
        return build_calibration(
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

    def _seen(self, one: TouchedPoint, frames: dict[str, Frame]) -> tuple[np.ndarray, np.ndarray]:
        """Returns a point in camera coordinates, and its covariance."""
        if one.camera_m is not None:
            z, focal_px, sight = (
                float(one.camera_m[2]),
                1000.0,
                one.camera_m / np.linalg.norm(one.camera_m),
            )
            return one.camera_m, _build_point_cov(
                sight, self.noise_per_m * z**2, self.click_px * z / focal_px
            )
        frame = frames.get(str(one.frame))
        if frame is None or one.pixel is None:
            raise FrameError(f"there is no frame '{one.frame}' that can be used")
        point, along_m = fit_point_depth(frame, one.pixel, self.window_px, self.noise_per_m)
        across_m = self.click_px * point[2] / float(frame.camera_matrix[0, 0])
        return point, _build_point_cov(point / np.linalg.norm(point), along_m, across_m)


def fit_point_depth(
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


def read_touched_points(path: Path, num_joints: int) -> list[TouchedPoint]:
    """Returns the points of a file.

    Raises:
        ConfigError: it cannot be read, or a point lacks one of its ends; shows how it should look.
    """
    try:
        told = yaml.safe_load(path.read_text())["points"]
        found = [_parse_point(number, one, num_joints) for number, one in enumerate(told)]
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"calibration.points={path}: {type(error).__name__} {error}; {EXAMPLE}"
        ) from error
    return found


def _parse_point(number: int, one: dict[str, Any], num_joints: int) -> TouchedPoint:
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
    return TouchedPoint(
        str(one.get("name", f"point {number}")),
        frame,
        values["pixel"],
        values["camera_m"],
        values["q"],
        values["base_m"],
    )


def _build_point_cov(sight: np.ndarray, along_m: float, across_m: float) -> np.ndarray:
    along = np.outer(sight, sight)
    return along_m**2 * along + across_m**2 * (np.eye(3) - along)
