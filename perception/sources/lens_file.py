"""Lens of a camera pair as its maker or its owner wrote it down, and the rectification by it.

Three kinds of files: `camera.yaml` of rectified pictures; the factory's `.conf` of a ZED
(`SN<number>.conf`); and what OpenCV's `stereoCalibrate` gives (`K1 D1 K2 D2 R T` in YAML).
"""

from __future__ import annotations

import configparser
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from brokk_rl.errors import FrameError
from perception.calibrate.transforms import make_transform
from perception.camera import CameraModel
from perception.sources import validation

ZED_SIZES = {
    (2208, 1242): "2K",
    (1920, 1200): "FHD1200",
    (1920, 1080): "FHD",
    (1280, 720): "HD",
    (672, 376): "VGA",
}
"""Names of picture sizes in the sections of a factory file."""
CALIBRATION = ("K1", "D1", "K2", "D2", "R", "T")
"""Matrices of the file of a stereo calibration."""


def read_pair_lens(
    path: Path, content: dict[str, Any] | None, size_px: tuple[int, int]
) -> CameraModel:
    """Return the camera of raw pictures of a size, by a factory file or a stereo calibration.

    Args:
        path: The file.
        content: Its YAML, with `K1 D1 K2 D2 R T`; `None` for a `.conf`.
        size_px: Columns and rows of one picture.

    Raises:
        FrameError: it lacks a value, or belongs to another size.
    """
    if content is None:
        cameras, turn, shift_m = _read_factory_file(path, size_px)
    else:
        cameras, turn, shift_m = _read_stereo_calibration(str(path), content, size_px)
    for matrix, _ in cameras:
        validation.check_matrix_fits(matrix, size_px[::-1], str(path))
    validation.check_number(float(np.linalg.norm(shift_m)), str(path), "baseline_m")
    (one, bent), (other, other_bent) = cameras
    # alpha 0: only pixels that both cameras show.
    first, second, project, project_other, *_ = cv2.stereoRectify(
        one, bent, other, other_bent, size_px, turn, shift_m, alpha=0
    )
    maps = (
        cv2.initUndistortRectifyMap(one, bent, first, project, size_px, cv2.CV_32FC1),
        cv2.initUndistortRectifyMap(
            other, other_bent, second, project_other, size_px, cv2.CV_32FC1
        ),
    )
    baseline_m = float(-project_other[0, 3] / project_other[0, 0])
    if baseline_m <= 0:
        raise FrameError(f"{path}: the second camera lies left of the first; swap them")
    return CameraModel(np.asarray(project)[:, :3], None, baseline_m, size_px, maps=maps)


def _read_stereo_calibration(
    where: str, content: dict[str, Any], size_px: tuple[int, int]
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, np.ndarray]:
    """Return the same as `_read_factory_file`, of what `stereoCalibrate` gives."""
    if missing := [name for name in CALIBRATION if content.get(name) is None]:
        raise FrameError(
            f"{where}: expected {' '.join(CALIBRATION)}, as OpenCV's stereoCalibrate gives them, got no "
            f"{', '.join(missing)}"
        )
    told = validation.parse_size(content.get("size_px"), where)
    validation.check_size(told, size_px[::-1], where, "the pictures")
    cameras = []
    for number in (1, 2):
        camera = f"{where}: camera {number}"
        bent = validation.check_distortion(content[f"D{number}"], camera)
        matrix = validation.check_matrix(content[f"K{number}"], camera)
        cameras.append((matrix, np.zeros(0) if bent is None else bent))
    turn = validation.parse_numbers(content["R"], (3, 3), f"{where}: R")
    shift_m = validation.parse_numbers(content["T"], None, f"{where}: T").ravel()
    shift_m = validation.parse_numbers(shift_m, (3,), f"{where}: T")
    validation.check_pose(make_transform(turn, shift_m), where, "R with T")
    return cameras, turn, shift_m


def _read_factory_file(
    path: Path, size_px: tuple[int, int]
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, np.ndarray]:
    """Return matrix and distortion of both cameras, and turn and shift from left to right, m."""
    if size_px not in ZED_SIZES:
        known = ", ".join(f"{width} x {height}" for width, height in ZED_SIZES)
        raise FrameError(
            f"{path}: pictures of {size_px[0]} x {size_px[1]} px are none of a ZED ({known})"
        )
    name = ZED_SIZES[size_px]
    file = configparser.ConfigParser()
    try:
        file.read_string(path.read_text())
        cameras = []
        for side in ("LEFT", "RIGHT"):
            part = file[f"{side}_CAM_{name}"]
            fx, fy, cx, cy = (float(part[key]) for key in ("fx", "fy", "cx", "cy"))
            bent = [float(part.get(key, "0")) for key in ("k1", "k2", "p1", "p2", "k3")]
            cameras.append((np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(bent)))
        both = file["STEREO"]
        turn = np.array([float(both[f"{key}_{name}"]) for key in ("RX", "CV", "RZ")])
        shift_mm = [float(both["Baseline"]), float(both.get("TY", "0")), float(both.get("TZ", "0"))]
    except (OSError, configparser.Error, KeyError, ValueError) as error:
        raise FrameError(
            f"{path}: no factory file of a ZED for {name} ({error}); expected sections LEFT_CAM_{name}, "
            f"RIGHT_CAM_{name} and STEREO"
        ) from error
    # The file holds the place of the right camera; OpenCV wants the motion of points into it.
    return cameras, np.asarray(cv2.Rodrigues(turn)[0]), -np.array(shift_mm) / 1000.0
