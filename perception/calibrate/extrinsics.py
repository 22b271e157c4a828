"""The stored place of a camera: a YAML file that sources of frames take as `base_from_camera`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl import record
from brokk_rl.errors import FrameError
from brokk_rl.machine import Machine
from perception.sources import validation

# --- from result: What a calibration says, and how it is stored.

SCHEMA = 1
CameraPlacement = str | tuple[tuple[float, ...], ...] | None
"""How a config says where a camera is: a file of `mode=calibrate`, a 4 x 4 transform, or not at
all."""


@dataclass(frozen=True)
class CameraExtrinsics:
    """Where a camera is.

    Attributes:
        base_from_camera: `(4, 4)`, `None` where nobody knows.
        cov: Of a small motion of it in its own coordinates, `(6, 6)`, m and then rad; `None` where
            nobody has told.
    """

    base_from_camera: np.ndarray | None
    cov: np.ndarray | None


def load_extrinsics(given: CameraPlacement, where: str) -> CameraExtrinsics:
    """Returns where a camera is as a config gives it.

    Raises:
        FrameError: there is no such file, it is none of ours, the transform is not rigid, or its
            covariance is none.
    """
    if given is None:
        return CameraExtrinsics(None, None)
    if not isinstance(given, str):
        return CameraExtrinsics(validation.check_pose(given, where), None)
    told, where = read_calibration(Path(given), where), f"{where}={given}"
    cov = np.asarray(told.get("covariance", np.zeros((6, 6))), float)
    if (
        cov.shape != (6, 6)
        or not np.isfinite(cov).all()
        or np.linalg.eigvalsh((cov + cov.T) / 2).min() < -1e-9
    ):
        raise FrameError(
            f"{where}: covariance: expected a covariance of six numbers, (6, 6); calibrate again"
        )
    return CameraExtrinsics(validation.check_pose(told["T_base_cam"], where), (cov + cov.T) / 2)


def read_calibration(path: Path, where: str) -> dict[str, Any]:
    """Returns what stands in a file of `mode=calibrate`.

    Raises:
        FrameError: it cannot be read, or is none.
    """
    try:
        told = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise FrameError(
            f"{where}: {path} cannot be read ({error}); expected calibration.yaml of `brokk mode=calibrate`"
        ) from error
    if not isinstance(told, dict) or told.get("schema") != SCHEMA or "T_base_cam" not in told:
        raise FrameError(
            f"{where}: {path} is no calibration of schema {SCHEMA}; `brokk mode=calibrate` writes one"
        )
    return told


def compute_point_std_m(cov: np.ndarray, distance_m: float) -> float:
    """Returns how uncertain a point `distance_m` before the camera is in the base frame, by the calibration alone, m.

    Args:
        cov: Of a small motion of the camera in its own frame, `(6, 6)`.
        distance_m: How far before the camera.
    """
    lever = np.concatenate(
        [np.eye(3), distance_m * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])], 1
    )
    return float(np.sqrt(np.trace(lever @ cov @ lever.T)))


def round_to_lists(values: np.ndarray | Sequence[float], digits: int = 9) -> list[Any]:
    """Returns an array as lists of rounded numbers, for YAML."""
    return np.round(np.asarray(values, float), digits).tolist()


@dataclass(frozen=True)
class PoseResidual:
    """One pose or point: its name, how far off it is (m, rad or `None`), and why it was left out, `None` if it was not."""

    name: str
    away_m: float | None
    away_rad: float | None
    left_out: str | None

    def plain(self) -> dict[str, Any]:
        """Returns it as plain data."""
        rounded = {key: None if value is None else round(value, 6) for key, value in
                   (("away_m", self.away_m), ("away_rad", self.away_rad))}  # fmt: skip
        return {"name": self.name, **rounded, "left_out": self.left_out}


def build_calibration(
    kind: str,
    machine: Machine,
    base_from_camera: np.ndarray,
    cov: np.ndarray,
    judged: Sequence[PoseResidual],
    distance_m: float,
    more: dict[str, Any],
) -> dict[str, Any]:
    """Returns what `calibration.yaml` says.

    Args:
        kind: `board` or `touched`.
        machine: Whose base it is.
        base_from_camera: The camera, `(4, 4)`.
        cov: Covariance of a small motion of it in its own frame, `(6, 6)`.
        judged: Poses or points.
        distance_m: How far away the camera's work is: there its uncertainty is told.
        more: What the kind has to say besides.
    """
    used = [one for one in judged if one.left_out is None]

    def rms(values: Sequence[float | None]) -> float | None:
        there = [value for value in values if value is not None]
        return round(float(np.sqrt(np.mean(np.square(there)))), 6) if there else None

    return {
        "schema": SCHEMA,
        "kind": kind,
        "created": record.format_now(),
        "machine": machine.name,
        "T_base_cam": round_to_lists(base_from_camera),
        "covariance": round_to_lists(
            cov, 15
        ),  # of a small motion of the camera in its own frame: x y z in m, then turns in rad
        "std_m": round_to_lists(np.sqrt(np.diag(cov)[:3])),
        "std_rad": round_to_lists(np.sqrt(np.diag(cov)[3:6])),
        "point_std_m": {
            "at_m": round(distance_m, 3),
            "std_m": round(compute_point_std_m(cov, distance_m), 6),
        },
        "residual": {
            "rms_m": rms([one.away_m for one in used]),
            "rms_rad": rms([one.away_rad for one in used]),
        },
        "num_used": len(used),
        "num_left_out": len(judged) - len(used),
        **more,
        "poses": [one.plain() for one in judged],
    }
