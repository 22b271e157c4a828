"""Validation of frames and calibrations; a refusal names the expected and the given value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl.errors import FrameError

_NUM_DISTORTION = (0, 4, 5, 8, 12, 14)
_FIELD_RATIO = (0.25, 12.0)
"""Range of focal length over width: from a fisheye of 127 degrees to a telescope of 5."""
_ASPECT = (0.8, 1.25)
_CENTER = 0.2
"""Largest distance of the principal point from the middle, as a part of the picture's size: 0.08 in
the Middlebury pairs of 2014, 0.03 in cameras for machines, 0.25 with a matrix of twice the size."""
_SCALED = (0.06, 0.05)
"""Departure of both coordinates of the principal point from the middle, relative, and their largest
difference, from which the matrix is one of pictures of another size: that of a ZED at HD2K with
pictures of HD1080 departs by 0.15, alike in both."""
_FARTHEST_M = 200.0
"""Median depth beyond which the unit must be mm."""
_FARTHEST_CAMERA_M, _SLANT = 50.0, 0.7
"""Largest distance of a camera from the base; sine of the angle by which a camera may roll, or look
up: 45 degrees."""
_RIGID = 1e-3
"""Largest departure of a rotation from orthonormality: of matrices written with three digits."""

_LARGEST_OFFSET_PX = 10.0
"""Uncertainty of a disparity from which a pair is not calibrated at all."""
USUAL_GAMMA = 2.2
"""Exponent of the tone curve of cameras and files that do not state it: that of sRGB, about."""
_LARGEST_GAMMA = 4.0


NUMBERS = {
    "baseline_m": (1e-3, 3.0, "0.001 to 3 m; is it in mm, or negative?"),
    "disparity_std_px": (0.0, _LARGEST_OFFSET_PX, f"0 to {_LARGEST_OFFSET_PX:g} px"),
    "gamma": (1.0, _LARGEST_GAMMA, f"1 (linear) to {_LARGEST_GAMMA:g}; most have {USUAL_GAMMA:g}"),
}
"""Least and largest value of each number of a camera, and both in words."""


def check_matrix(value: Any, where: str) -> np.ndarray:
    """Return a camera matrix, `(3, 3)`, or raises a `FrameError` where it is none."""
    found = parse_numbers(value, (3, 3), f"{where}: K")
    across_px, down_px = found[0, 0], found[1, 1]
    is_positive = across_px > 0 and down_px > 0
    if not is_positive or not _ASPECT[0] <= across_px / down_px <= _ASPECT[1]:
        told = f"K has focal lengths {across_px:g} and {down_px:g} px"
        raise FrameError(f"{where}: {told}, expected more than 0 and about equal")
    if (
        np.abs(found[[1, 2, 2], [0, 0, 1]]).max() > 1e-9
        or abs(found[2, 2] - 1.0) > 1e-9
        or abs(found[0, 1]) > 0.1 * found[0, 0]
    ):
        raise FrameError(
            f"{where}: K is no camera matrix, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {found.tolist()}"
        )
    return found


def check_matrix_fits(camera_matrix: np.ndarray, shape: tuple[int, ...], where: str) -> None:
    """Refuse a camera matrix that cannot be that of a picture of this shape."""
    height, width = shape[:2]
    ratio = camera_matrix[0, 0] / width
    if not _FIELD_RATIO[0] <= ratio <= _FIELD_RATIO[1]:
        raise FrameError(
            f"{where}: a focal length of {camera_matrix[0, 0]:g} px is absurd for a picture {width} px wide, expected "
            f"{_FIELD_RATIO[0] * width:g} to {_FIELD_RATIO[1] * width:g}; was K made for another resolution?"
        )
    beyond = camera_matrix[:2, 2] / ((width - 1) / 2, (height - 1) / 2)
    for name, center, size in (
        ("cx", camera_matrix[0, 2], width),
        ("cy", camera_matrix[1, 2], height),
    ):
        if abs(center - (size - 1) / 2) > _CENTER * size:
            raise FrameError(
                f"{where}: K has {name} {center:g} px, expected about {(size - 1) / 2:g} in a picture of "
                f"{width} x {height} px; was K made for pictures of another resolution, or turned ones?"
            )
    if np.abs(beyond - 1.0).min() > _SCALED[0] and abs(beyond[0] / beyond[1] - 1.0) < _SCALED[1]:
        made_for = np.rint(2.0 * camera_matrix[:2, 2] + 1.0).astype(int)
        raise FrameError(
            f"{where}: K has cx {camera_matrix[0, 2]:g} and cy {camera_matrix[1, 2]:g} px, the middle of "
            f"pictures of {made_for[0]} x {made_for[1]} px, but these have {width} x {height}; take the "
            "matrix of their resolution, or scale K"
        )


def parse_size(value: Any, where: str) -> tuple[int, int] | None:
    """Return columns and rows of the pictures of a camera, `None` where they are not told."""
    if value is None:
        return None
    found = parse_numbers(value, (2,), f"{where}: size_px")
    if (found < 1).any() or (found != np.rint(found)).any():
        raise FrameError(f"{where}: size_px is {value}, expected [columns, rows] of the pictures")
    return int(found[0]), int(found[1])


def check_size(
    told_px: tuple[int, int] | None, shape: tuple[int, ...], where: str, picture: str
) -> None:
    """Refuse a picture of another size than that for which the camera matrix was told."""
    height, width = shape[:2]
    if told_px is None or told_px == (width, height):
        return
    remedy = "take the matrix of their resolution, or scale K and size_px"
    if told_px == (height, width):
        remedy = "the pictures are turned: turn them back, or K with them"
    raise FrameError(
        f"{picture}: {width} x {height} px, but the camera matrix K of {where} is that of pictures of "
        f"{told_px[0]} x {told_px[1]} px; {remedy}"
    )


def check_distortion(value: Any, where: str) -> np.ndarray | None:
    """Return distortion coefficients, `None` where all of them are 0."""
    found = np.asarray(
        parse_numbers([] if value is None else value, None, f"{where}: dist")
    ).reshape(-1)
    if len(found) not in _NUM_DISTORTION:
        raise FrameError(f"{where}: dist has {len(found)} numbers, expected {_NUM_DISTORTION}")
    if np.abs(found).max(initial=0.0) > 100:
        raise FrameError(f"{where}: dist is absurd, {found.tolist()}")
    return found if np.any(found) else None


def check_pose(value: Any, where: str, name: str = "T_base_cam") -> np.ndarray:
    """Return a pose, `(4, 4)`, or raises a `FrameError` where it is none."""
    found = parse_numbers(value, (4, 4), f"{where}: {name}")
    turn = found[:3, :3]
    if (
        np.abs(found[3] - [0, 0, 0, 1]).max() > 1e-9
        or np.abs(turn @ turn.T - np.eye(3)).max() > _RIGID
        or np.linalg.det(turn) < 0
    ):
        raise FrameError(f"{where}: {name} is no rotation with a shift in m and the row 0 0 0 1")
    return found


def check_upright(base_from_camera: np.ndarray, where: str) -> None:
    """Refuse a pose by which the picture stands on its side or head, or shows the sky.

    The base's z axis points up, the camera's y axis down and its z axis ahead. Poses of other
    conventions, inverse ones, and shifts in mm look like that. A pose without a turn says nothing.
    """
    turn, shift_m = base_from_camera[:3, :3], base_from_camera[:3, 3]
    if np.linalg.norm(shift_m) > _FARTHEST_CAMERA_M:
        raise FrameError(
            f"{where}: T_base_cam puts the camera {np.linalg.norm(shift_m):.0f} m away, expected up to "
            f"{_FARTHEST_CAMERA_M:g} m; is the shift in mm?"
        )
    right, down, ahead = turn[2]
    if np.allclose(turn, np.eye(3)):
        return
    if abs(right) > _SLANT or ahead > _SLANT or down > _SLANT:
        raise FrameError(
            f"{where}: by T_base_cam the picture's right, lower and far side rise by {right:.2f}, {down:.2f} "
            f"and {ahead:.2f} per unit, expected about 0, and not above {_SLANT:g}; it must turn camera "
            "coordinates (x right, y down, z ahead) into those of the base (z up): is it the inverse, "
            "or of another convention?"
        )


def check_number(value: Any, where: str, name: str) -> float:
    """Return a number of a camera (`NUMBERS`), or raises a `FrameError` where it is none."""
    found = float(parse_numbers(value, (), f"{where}: {name}"))
    least, largest, expected = NUMBERS[name]
    if not least <= found <= largest:
        raise FrameError(f"{where}: {name} is {found:g}, expected {expected}")
    return found


def check_disparity_error(value: Any, where: str) -> tuple[float, float, float]:
    """Return constant and slopes of a disparity's error, px, or raises a `FrameError`."""
    found = parse_numbers(value, (3,), f"{where}: disparity.error_px")
    if np.abs(found).max() > _LARGEST_OFFSET_PX:
        raise FrameError(
            f"{where}: disparity.error_px is {found.tolist()}, expected up to "
            f"{_LARGEST_OFFSET_PX:g} px"
        )
    return float(found[0]), float(found[1]), float(found[2])


def convert_color(picture: np.ndarray, where: str) -> np.ndarray:
    """Return a picture as RGB, `(h, w, 3)` uint8; it comes as OpenCV reads it, blue first.

    Infrared and industrial cameras give one channel, of 8 bits or of more in 16: three alike are
    made of it, and of 16 bits the brightest value decides the scale.
    """
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[..., 0]
    if picture.ndim == 2 and picture.dtype == np.uint16:
        bits = max(int(picture.max(initial=0)).bit_length(), 8)
        picture = (picture >> (bits - 8)).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise FrameError(f"{where}: {picture.dtype}, expected 8 bits, or 16 bits of a grey picture")
    if picture.ndim == 2:
        return np.ascontiguousarray(np.repeat(picture[..., None], 3, 2))
    if picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise FrameError(f"{where}: shape {picture.shape}, expected 1, 3 or 4 channels")
    return np.ascontiguousarray(picture[..., 2::-1])


def convert_png_depth(picture: np.ndarray, where: str, unit_m: float = 0.001) -> np.ndarray:
    """Return depth in m, `(h, w)` float32, NaN for 0, of a picture in steps of `unit_m`."""
    if picture.ndim != 2:
        raise FrameError(f"{where}: {picture.shape[2]} channels, expected one of 16 bits (mm)")
    if picture.dtype != np.uint16:
        raise FrameError(f"{where}: {picture.dtype}, expected 16 bits (depth in mm)")
    depth_m = picture.astype(np.float32) / np.float32(1.0 / unit_m)
    return np.where(picture > 0, depth_m, np.float32(np.nan))


def check_depth(values: np.ndarray, where: str, least_known: float) -> np.ndarray:
    """Return depth in m, `(h, w)` float32, NaN in place of 0, negative and infinite values."""
    if values.ndim != 2:
        raise FrameError(f"{where}: depth of shape {values.shape}, expected (height, width)")
    if not np.issubdtype(values.dtype, np.floating):
        raise FrameError(f"{where}: depth of type {values.dtype}, expected float32 in m")
    with np.errstate(invalid="ignore"):
        found = np.where(np.isfinite(values) & (values > 0), values, np.nan).astype(np.float32)
    known = np.isfinite(found)
    if not known.any() or known.mean() < least_known:
        share = f"{100 * known.mean():.2g} %, expected {100 * least_known:g} % or more"
        raise FrameError(f"{where}: depth is known for {share}")
    if (middle := float(np.median(found[known]))) > _FARTHEST_M:
        raise FrameError(f"{where}: the median depth is {middle:g} m; is it in mm?")
    return found


def check_same_size(one: np.ndarray, other: np.ndarray, where: str, what: str) -> None:
    """Refuse two pictures of one frame that differ in size."""
    if one.shape[:2] != other.shape[:2]:
        raise FrameError(
            f"{where}: {what} has {other.shape[1]} x {other.shape[0]} pixels, the colour picture {one.shape[1]} x {one.shape[0]}; "
            "they must be registered pixel by pixel"
        )


def read_mapping(path: Path, expected: str) -> dict[str, Any]:
    """Return the content of a YAML file, empty where that is no mapping.

    Raises:
        FrameError: it cannot be read; `expected` says what it should hold.
    """
    try:
        told = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise FrameError(f"{path}: cannot be read as YAML ({error}): {expected}") from error
    return told if isinstance(told, dict) else {}


def parse_numbers(value: Any, shape: tuple[int, ...] | None, where: str) -> np.ndarray:
    """Return finite numbers of a shape, any where that is `None`, or raises a `FrameError`."""
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FrameError(f"{where} holds no numbers: {value!r}") from error
    if shape is not None and found.shape != shape:
        raise FrameError(f"{where} has shape {found.shape}, expected {shape}")
    if not np.isfinite(found).all():
        raise FrameError(f"{where} holds values that are no numbers: {found.tolist()}")
    return found
