"""Calibration from points that the tool's tip touched and a person clicked in a frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import yaml
from annotated_types import Ge
from scipy.stats import chi2

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception.calibrate import arm, transforms, verdict
from perception.calibrate.extrinsics import PoseResidual, build_calibration
from perception.calibrate.hand_eye import STUDENT_T_FREEDOM
from perception.robust_fit import fit_linear

EXAMPLE = """expected YAML such as
  points:
    # where the tip touches, and the joint positions then
    - {frame: "00003", pixel: [812, 440], q: [0.1, -0.9, 0.6, 0.8, 0.7]}
    # or both ends, measured
    - {camera_m: [0.2, 0.1, 2.3], base_m: [2.6, 0.3, 0.4]}"""
MIN_POINTS = 4
"""Points that can be fitted: three decide, a fourth contradicts."""
MIN_POINTS_JUDGED = 6
"""Points that have to agree for a verdict: three decide, three contradict; chosen by hand."""
NUM_TRIPLES = 300
"""Random triples that are tried; with half of the points wrong, all fail once in 10^17."""
MEDIAN_DISTANCE = float(chi2.ppf(0.5, 3))
"""Median squared distance of a right point, three degrees of freedom."""
MAX_DISTANCE = float(chi2.ppf(0.999, 3))
"""Squared distance beyond which a point is called wrong; one right point in a thousand is."""
MAX_STEPS = 60
"""Gauss-Newton steps; a bound, chosen by hand (Student's weights converge linearly)."""
MIN_PIXELS = 12
"""Pixels with depth that a plane needs; chosen by hand."""
PIXELS_PER_SAMPLE = 10.0
"""Neighbours share a matcher's window: some ten pixels are as good as one; chosen by hand."""
ASSUMED_FOCAL_PX = 1000.0
"""Focal length that turns a click's error into metres where no frame tells the camera's own.

Chosen by hand; not searched. A ZED 2i at 1080p has 1056 px (`rig=zed_2i_1080p`).
"""


@dataclass(frozen=True)
class PointPairs:
    """`N` points, each known twice.

    Attributes:
        in_camera_m: As seen, `(N, 3)`.
        in_base_m: The tool's tip there, `(N, 3)`.
        cov_m2: Covariance of each as seen, `(N, 3, 3)` in the camera's frame.
    """

    in_camera_m: np.ndarray
    in_base_m: np.ndarray
    cov_m2: np.ndarray

    def part(self, chosen: np.ndarray) -> PointPairs:
        """Return the chosen points."""
        return PointPairs(self.in_camera_m[chosen], self.in_base_m[chosen], self.cov_m2[chosen])

    def away_m(self, camera: np.ndarray) -> np.ndarray:
        """Return the residuals of a camera at `camera`, `(4, 4)`: `(N, 3)` in the base frame."""
        return self.in_base_m - (self.in_camera_m @ camera[:3, :3].T + camera[:3, 3])

    def solve_kabsch(self) -> np.ndarray:
        """Return the camera's pose of least squared distances, `(4, 4)` (Kabsch, 1976)."""
        seen, touched = self.in_camera_m.mean(0), self.in_base_m.mean(0)
        turn = transforms.find_nearest_rotation(
            (self.in_base_m - touched).T @ (self.in_camera_m - seen)
        )
        return transforms.make_transform(turn, touched - turn @ seen)


@dataclass(frozen=True)
class PointFit:
    """Result of a fit.

    Attributes:
        base_from_camera: The camera, `(4, 4)`.
        cov: Covariance of a small motion of it in its own frame, `(6, 6)`.
        factor: The tip's uncertainty over the assumed one, 1 or more.
        away_m: Residual of each point, `(N, 3)` in the base frame.
        used: Points that were used in the end, `(N,)` bool.
    """

    base_from_camera: np.ndarray
    cov: np.ndarray
    factor: float
    away_m: np.ndarray
    used: np.ndarray


def fit_camera_to_points(points: PointPairs, tip_std_m: float) -> PointFit | None:
    """Return the camera's pose; `None` where there are too few points to contradict each other.

    Args:
        points: The points.
        tip_std_m: Standard deviation of the tip in each direction.
    """
    count = len(points.in_camera_m)
    if count < MIN_POINTS:
        return None
    generator = np.random.default_rng(0)
    groups = [np.arange(count)]
    groups += [generator.choice(count, 3, replace=False) for _ in range(NUM_TRIPLES)]
    cameras = [points.part(group).solve_kabsch() for group in groups]
    medians = [np.median(np.linalg.norm(points.away_m(one), axis=1)) for one in cameras]
    camera = cameras[int(np.argmin(medians))]
    # half of the points may be wrong: the median tells how exact the others are
    distance = _build_normal_equations(points, camera, tip_std_m, None).distance
    std_m = tip_std_m * np.sqrt(max(1.0, np.median(distance) / MEDIAN_DISTANCE))
    camera = _refine_pose(points, camera, std_m, None)
    used = _build_normal_equations(points, camera, std_m, None).distance <= MAX_DISTANCE
    used = used if used.sum() >= MIN_POINTS else np.ones(count, bool)
    good, full = points.part(used), np.ones(int(used.sum()))
    camera = _refine_pose(good, camera, std_m, full)
    equations = _build_normal_equations(good, camera, std_m, full)
    freedom = max(3.0 * used.sum() - 6.0, 1.0)
    excess = max(1.0, float(equations.distance.sum()) / freedom)
    cov = excess * np.linalg.pinv(equations.normal, hermitian=True)
    factor = float(std_m / tip_std_m * np.sqrt(excess))
    return PointFit(camera, cov, factor, points.away_m(camera), used)


def compute_width_m(in_base_m: np.ndarray) -> float:
    """Return the standard deviation of points, `(N, 3)`, across the line that fits them best, m.

    With 0 the camera could still turn about that line.
    """
    singular = np.linalg.svd(in_base_m - in_base_m.mean(0), compute_uv=False)
    return float(singular[1] / np.sqrt(len(in_base_m)))


@dataclass(frozen=True)
class _NormalEquations:
    """Normal equations of a small motion of the camera.

    Attributes:
        distance: Squared Mahalanobis distance of each point, `(N,)`.
        normal: `(6, 6)`.
        gradient: `(6,)`.
    """

    distance: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray


def _build_normal_equations(
    points: PointPairs, camera: np.ndarray, tip_std_m: float, fixed: np.ndarray | None
) -> _NormalEquations:
    """Return them with `fixed` weights, `(N,)`, or with those of Student's t."""
    away = points.away_m(camera) @ camera[:3, :3]  # in the camera's frame
    information = np.linalg.inv(points.cov_m2 + tip_std_m**2 * np.eye(3))
    distance = np.einsum("ni,nij,nj->n", away, information, away)
    weight = fixed
    if weight is None:
        weight = (STUDENT_T_FREEDOM + 3) / (STUDENT_T_FREEDOM + distance)
    shift = np.broadcast_to(-np.eye(3), (len(away), 3, 3))
    slopes = np.concatenate([shift, transforms.build_cross_matrices(points.in_camera_m)], 2)
    weighted = np.swapaxes(slopes, 1, 2) @ (weight[:, None, None] * information)
    normal = (weighted @ slopes).sum(0)
    return _NormalEquations(distance, normal, (weighted @ away[..., None]).sum(0)[:, 0])


def _refine_pose(
    points: PointPairs, camera: np.ndarray, tip_std_m: float, fixed: np.ndarray | None
) -> np.ndarray:
    for _ in range(MAX_STEPS):
        equations = _build_normal_equations(points, camera, tip_std_m, fixed)
        step = -np.linalg.lstsq(equations.normal, equations.gradient, rcond=1e-12)[0]
        camera = transforms.apply_motion(camera, step)
        if np.abs(step).max() < 1e-10:
            break
    return camera


@dataclass(frozen=True)
class TouchedPoint:
    """A point as the file gives it; a missing value is `None`.

    Attributes:
        name: For messages.
        frame: Stem of the frame that was clicked in.
        pixel: Where, `(2,)`.
        camera_m: Camera coordinates instead, `(3,)`.
        q: Joint positions, `(J,)`.
        base_m: Base coordinates instead, `(3,)`.
    """

    name: str
    frame: str | None
    pixel: np.ndarray | None
    camera_m: np.ndarray | None
    q: np.ndarray | None
    base_m: np.ndarray | None


@spec
class TouchCalibration:
    """Points touched with the tip of the tool; six or more, well apart, need no board.

    Attributes:
        source: The frames that were clicked in; not opened where the file gives camera coordinates.
        points: YAML file; see `EXAMPLE`.
        tip_std_m: Standard deviation of the tip in each direction, from joints and geometry.
        click_px: Standard deviation of a click, also where the file gives camera coordinates.
        noise_per_m: Standard deviation of inverse depth, 1/m; a plane through the window averages
            it.
        window_px: Depth is read from a plane through a window that reaches this far from the click.
        least_width_m: Least standard deviation of the points across the line that fits them best.
        work_m: Working distance, at which the uncertainty of a point is stated.
        temperature_c: Of the day, for the record; `null` where it was not measured.
    """

    source: FrameSourceSpec
    points: str
    tip_std_m: Positive
    click_px: Positive
    noise_per_m: Positive
    window_px: Annotated[int, Ge(2)]
    least_width_m: Positive
    work_m: Positive
    temperature_c: float | None

    def calibrate(self, machine: Machine) -> dict[str, Any]:
        """Return the content of `calibration.yaml`.

        Raises:
            ConfigError: the file of points cannot be read.
            FrameError: the points do not determine the camera; the message names the lack.
        """
        names, points, refused = self._collect_pairs(machine)
        fit = fit_camera_to_points(points, self.tip_std_m) if names else None
        if fit is None:
            reasons = "; ".join(str(one.left_out) for one in refused[:3])
            why = f" Left out: {reasons}" if refused else ""
            raise FrameError(
                f"calibration: {len(names)} points can be used, {MIN_POINTS} are needed at least, "
                f"8 are good.{why}"
            )
        width_m = compute_width_m(points.in_base_m[fit.used])
        if width_m < self.least_width_m:
            raise FrameError(
                f"calibration: the points lie within {width_m:.3f} m of a line, "
                f"{self.least_width_m:g} m are needed: touch some beside it, and some higher or "
                "lower"
            )
        residuals = []
        for k, name in enumerate(names):
            away_m = float(np.linalg.norm(fit.away_m[k]))
            reason = None if fit.used[k] else f"{1000 * away_m:.0f} mm off while the others agree"
            residuals.append(PoseResidual(name, away_m, None, reason))
        more = {
            "temperature_c": self.temperature_c,
            "arm_factor": round(fit.factor, 3),
            "width_m": round(width_m, 4),
            "missing": [],
            "verdict": self._judge(fit),
        }
        camera, all_residuals = fit.base_from_camera, [*residuals, *refused]
        return build_calibration(
            "touched", machine, camera, fit.cov, all_residuals, self.work_m, more
        )

    def _judge(self, fit: PointFit) -> dict[str, Any]:
        """Return the verdict; see `verdict`."""
        alone = verdict.judge_fit(
            int(fit.used.sum()), len(fit.used), fit.factor, {}, [], MIN_POINTS_JUDGED
        )
        otherwise = (
            "look at the pixels, at the joint positions of each touch and at the machine's axes"
        )
        return verdict.add_explanation(alone, None, otherwise).to_dict()

    def _collect_pairs(self, machine: Machine) -> tuple[list[str], PointPairs, list[PoseResidual]]:
        """Return names and coordinates of the points that can be used, and those that cannot."""
        touches = read_touched_points(Path(self.points), machine.num_joints)
        frames = self._read_frames({one.frame for one in touches if one.frame is not None})
        # all points are of one camera, so any frame tells its focal length
        focal_px = ASSUMED_FOCAL_PX
        for frame in frames.values():
            focal_px = float(frame.camera_matrix[0, 0])
        names, seen, touched, covs, refused = [], [], [], [], []
        for one in touches:
            try:
                point, cov = self._locate(one, frames, focal_px)
            except FrameError as error:
                refused.append(PoseResidual(one.name, None, None, str(error)))
                continue
            names.append(one.name)
            seen.append(point)
            covs.append(cov)
            tip = one.base_m
            if one.q is not None:
                tip = arm.compute_link_poses(machine, one.q[None]).tip_in_base_m[0]
            touched.append(tip)
        return names, PointPairs(np.array(seen), np.array(touched), np.array(covs)), refused

    def _read_frames(self, wanted: set[str]) -> dict[str, Frame]:
        found: dict[str, Frame] = {}
        if not wanted:
            return found
        with self.source.build() as source:
            while True:
                try:
                    frame = source.read_latest()
                except FrameError:
                    continue  # `_locate` reports it if it was clicked in
                if frame is None:
                    return found
                if Path(frame.name).name in wanted:
                    found[Path(frame.name).name] = frame

    def _locate(
        self, one: TouchedPoint, frames: dict[str, Frame], focal_px: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a point in camera coordinates, and its covariance.

        Args:
            one: The point.
            frames: Frames that were clicked in, by stem.
            focal_px: Focal length for points that are given in camera coordinates.
        """
        if one.camera_m is not None:
            z = float(one.camera_m[2])
            ray = one.camera_m / np.linalg.norm(one.camera_m)
            along_m, across_m = self.noise_per_m * z**2, self.click_px * z / focal_px
            return one.camera_m, _build_point_cov(ray, along_m, across_m)
        frame = frames.get(str(one.frame))
        if frame is None or one.pixel is None:
            raise FrameError(f"there is no frame '{one.frame}' that can be used")
        point, along_m = fit_point_depth(frame, one.pixel, self.window_px, self.noise_per_m)
        across_m = self.click_px * point[2] / float(frame.camera_matrix[0, 0])
        return point, _build_point_cov(point / np.linalg.norm(point), along_m, across_m)


def fit_point_depth(
    frame: Frame, pixel: np.ndarray, window_px: int, noise_per_m: float
) -> tuple[np.ndarray, float]:
    """Return the point behind a pixel, `(3,)` m, and its standard deviation along z.

    The depth is that of a plane through the window around the pixel.

    Raises:
        FrameError: too little depth is known there.
    """
    height, width = frame.depth_m.shape
    rows, columns = np.mgrid[
        max(0, round(pixel[1]) - window_px) : min(height, round(pixel[1]) + window_px + 1),
        max(0, round(pixel[0]) - window_px) : min(width, round(pixel[0]) + window_px + 1),
    ].reshape(2, -1)
    known = np.isfinite(frame.depth_m[rows, columns])
    if known.sum() < MIN_PIXELS:
        raise FrameError(
            f"{frame.name}: depth is known at {known.sum()} pixels around {pixel.tolist()}, "
            f"{MIN_PIXELS} are needed"
        )
    rows, columns = rows[known], columns[known]
    # a plane is linear in inverse depth
    inverse = 1.0 / frame.depth_m[rows, columns].astype(float)
    table = np.stack([columns - pixel[0], rows - pixel[1], np.ones(len(rows))], 1)
    plane, _ = fit_linear(table, inverse, 1e-6)
    z = 1.0 / plane[2]
    variance = np.linalg.pinv(table.T @ table)[2, 2]
    flat = cv2.undistortPoints(
        pixel.reshape(1, 1, 2).astype(float),
        np.asarray(frame.camera_matrix, float),
        frame.distortion,
    )
    std_m = z**2 * noise_per_m * np.sqrt(min(1.0, PIXELS_PER_SAMPLE * variance))
    return z * np.array([*flat.ravel(), 1.0]), float(std_m)


def read_touched_points(path: Path, num_joints: int) -> list[TouchedPoint]:
    """Return the points of a file.

    Raises:
        ConfigError: it cannot be read, or a point lacks one of its ends; shows the expected form.
    """
    try:
        entries = yaml.safe_load(path.read_text())["points"]
        return [_parse_point(number, one, num_joints) for number, one in enumerate(entries)]
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"calibration.points={path}: {type(error).__name__} {error}; {EXAMPLE}"
        ) from error


def _parse_point(number: int, entry: dict[str, Any], num_joints: int) -> TouchedPoint:
    sizes = {"pixel": 2, "camera_m": 3, "q": num_joints, "base_m": 3}
    values: dict[str, np.ndarray | None] = dict.fromkeys(sizes)
    for name in sizes.keys() & entry.keys():
        values[name] = np.asarray(entry[name], float)
    for name, size in sizes.items():
        value = values[name]
        if value is not None and (value.shape != (size,) or not np.isfinite(value).all()):
            raise ValueError(f"point {number}: {name} has {value.size} numbers, expected {size}")
    has_camera_end = (values["camera_m"] is None) != (values["pixel"] is None)
    has_base_end = (values["q"] is None) != (values["base_m"] is None)
    if not (has_camera_end and has_base_end):
        raise ValueError(f"point {number} needs one of pixel and camera_m, and one of q and base_m")
    if values["pixel"] is not None and "frame" not in entry:
        raise ValueError(f"point {number}: in which frame was it clicked?")
    frame = str(entry["frame"]) if "frame" in entry else None
    return TouchedPoint(name=str(entry.get("name", f"point {number}")), frame=frame, **values)


def _build_point_cov(ray: np.ndarray, along_m: float, across_m: float) -> np.ndarray:
    """Return the covariance of a point, `(3, 3)`, by its errors along and across a unit ray."""
    along = np.outer(ray, ray)
    return along_m**2 * along + across_m**2 * (np.eye(3) - along)
