"""The stored place of a camera: a YAML file that sources of frames take as `base_from_camera`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl.errors import FrameError
from perception.sources import validation

SCHEMA = 1
Place = str | tuple[tuple[float, ...], ...] | None
"""How a config says where a camera is: a file of `mode=calibrate`, a 4 x 4 transform, or not at
all."""


@dataclass(frozen=True)
class Placed:
    """Where a camera is.

    Attributes:
        base_from_camera: `(4, 4)`, `None` where nobody knows.
        cov: Of a small motion of it in its own coordinates, `(6, 6)`, m and then rad; `None` where
            nobody has told.
    """

    base_from_camera: np.ndarray | None
    cov: np.ndarray | None


def placed(given: Place, where: str) -> Placed:
    """Returns where a camera is as a config gives it.

    Raises:
        FrameError: there is no such file, it is none of ours, the transform is not rigid, or its
            covariance is none.
    """
    if given is None:
        return Placed(None, None)
    if not isinstance(given, str):
        return Placed(validation.check_pose(given, where), None)
    told, where = read(Path(given), where), f"{where}={given}"
    cov = np.asarray(told.get("covariance", np.zeros((6, 6))), float)
    if (
        cov.shape != (6, 6)
        or not np.isfinite(cov).all()
        or np.linalg.eigvalsh((cov + cov.T) / 2).min() < -1e-9
    ):
        raise FrameError(
            f"{where}: covariance: expected a covariance of six numbers, (6, 6); calibrate again"
        )
    return Placed(validation.check_pose(told["T_base_cam"], where), (cov + cov.T) / 2)


def read(path: Path, where: str) -> dict[str, Any]:
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


def point_std_m(cov: np.ndarray, distance_m: float) -> float:
    """Returns how uncertain a point `distance_m` before the camera is in the base frame, by the calibration alone, m.

    Args:
        cov: Of a small motion of the camera in its own frame, `(6, 6)`.
        distance_m: How far before the camera.
    """
    lever = np.concatenate(
        [np.eye(3), distance_m * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])], 1
    )
    return float(np.sqrt(np.trace(lever @ cov @ lever.T)))


def plain(values: np.ndarray | Sequence[float], digits: int = 9) -> list[Any]:
    """Returns an array as lists of rounded numbers, for YAML."""
    return np.round(np.asarray(values, float), digits).tolist()
