"""Camera extrinsics in a YAML file: written by `mode=calibrate`, read by sources of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl import record
from brokk_rl.errors import FrameError
from brokk_rl.machine import Machine
from perception.calibrate import evaluation
from perception.sources import validation

SCHEMA = 1
"""Version of the file's layout."""
MIN_EIGENVALUE = -1e-9
"""A covariance may have eigenvalues as low as this, m^2 or rad^2, by rounding."""
CameraPlacement = str | tuple[tuple[float, ...], ...] | None
"""Camera pose in a config: a file of `mode=calibrate`, a 4 x 4 transform, or `None` (unknown)."""


@dataclass(frozen=True)
class CameraExtrinsics:
    """Pose of a camera and its uncertainty.

    Attributes:
        base_from_camera: `(4, 4)`, `None` where it is not known.
        cov: Of a small motion of it in its own coordinates, `(6, 6)`, m and then rad; `None` where
            it is not known.
        disparity_error_px: Known error of the pair's disparity, see `brokk_rl.signals.Frame`.
        disparity_std_px: Its standard deviation; `None` where it was not measured.
    """

    base_from_camera: np.ndarray | None
    cov: np.ndarray | None
    disparity_error_px: tuple[float, float, float] = (0.0, 0.0, 0.0)
    disparity_std_px: float | None = None


def load_extrinsics(given: CameraPlacement, where: str) -> CameraExtrinsics:
    """Return the camera's pose as a config gives it.

    Raises:
        FrameError: the file cannot be read or is of another kind, the transform is not rigid, or
            the covariance is not one.
    """
    if given is None:
        return CameraExtrinsics(None, None)
    if not isinstance(given, str):
        return CameraExtrinsics(validation.check_pose(given, where), None)
    content, where = read_calibration(Path(given), where), f"{where}={given}"
    told = content.get("covariance", np.zeros((6, 6)))
    cov = validation.parse_numbers(told, (6, 6), f"{where}: covariance")
    cov = (cov + cov.T) / 2
    if np.linalg.eigvalsh(cov).min() < MIN_EIGENVALUE:
        raise FrameError(f"{where}: covariance: expected one of six numbers; calibrate again")
    place = validation.check_pose(content["T_base_cam"], where)
    disparity = content.get("disparity")
    if disparity is None:
        return CameraExtrinsics(place, cov)
    error_px = validation.check_disparity_error(disparity.get("error_px"), where)
    std_px = validation.check_number(disparity.get("std_px"), where, "disparity_std_px")
    return CameraExtrinsics(place, cov, error_px, std_px)


def read_calibration(path: Path, where: str) -> dict[str, Any]:
    """Return the content of a file of `mode=calibrate`.

    Raises:
        FrameError: it cannot be read, is of another kind, or is not to be trusted.
    """
    expected = "calibration.yaml of `brokk mode=calibrate`"
    content = validation.read_mapping(path, f"{expected} by {where}")
    is_known = content.get("schema") == SCHEMA and "T_base_cam" in content
    for part in ("verdict", "disparity"):
        is_known = is_known and isinstance(content.get(part), dict | None)
    if not is_known:
        raise FrameError(
            f"{where}: {path} is no calibration of schema {SCHEMA}; run mode=calibrate"
        )
    evaluation.check_verdict(content, f"{where}={path}")
    return content


def compute_point_std_m(cov: np.ndarray, distance_m: float) -> float:
    """Return the standard deviation of a point in the base frame, by the calibration alone, m.

    Args:
        cov: Of a small motion of the camera in its own frame, `(6, 6)`.
        distance_m: Distance of the point along the camera's axis.
    """
    lever = np.concatenate(
        [np.eye(3), distance_m * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])], 1
    )
    return float(np.sqrt(np.trace(lever @ cov @ lever.T)))


def build_calibration(
    machine: Machine,
    base_from_camera: np.ndarray,
    cov: np.ndarray,
    residuals: Sequence[dict[str, Any]],
    distance_m: float,
    more: dict[str, Any],
) -> dict[str, Any]:
    """Return the content of `calibration.yaml`.

    Args:
        machine: Whose base it is.
        base_from_camera: The camera, `(4, 4)`.
        cov: Covariance of a small motion of it in its own frame, `(6, 6)`.
        residuals: Of all frames; see `perception.calibrate.evaluation.describe_residual`.
        distance_m: Working distance, at which the uncertainty of a point is stated.
        more: Entries that need no uncertainty.
    """
    used = [one for one in residuals if one["left_out"] is None]
    std = np.sqrt(np.diag(cov))
    point_std_m = round(compute_point_std_m(cov, distance_m), 6)
    return {
        "schema": SCHEMA,
        "kind": "board",
        "created": record.format_now(),
        "machine": machine.name,
        "T_base_cam": base_from_camera.round(9).tolist(),
        # of a small motion of the camera in its own frame: x y z in m, then turns in rad
        "covariance": cov.round(15).tolist(),
        "std_m": std[:3].round(9).tolist(),
        "std_rad": std[3:].round(9).tolist(),
        "point_std_m": {"at_m": round(distance_m, 3), "std_m": point_std_m},
        "residual": {
            "rms_m": _compute_rms([one["away_m"] for one in used]),
            "rms_rad": _compute_rms([one["away_rad"] for one in used]),
        },
        "num_used": len(used),
        "num_left_out": len(residuals) - len(used),
        **more,
        "poses": list(residuals),
    }


def _compute_rms(values: Sequence[float]) -> float:
    return round(float(np.sqrt(np.mean(np.square(values)))), 6)
