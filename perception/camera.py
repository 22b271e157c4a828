"""A camera: all that a user of its pictures has to know, as `camera.yaml` or a file of its lens tells.

Lenses of raw pairs come from the factory's `.conf` of a ZED (`SN<number>.conf`), or from what OpenCV's
`stereoCalibrate` gives (`K1 D1 K2 D2 R T` in YAML).
"""

from __future__ import annotations

import configparser
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from brokk_rl.contracts.vision import HolePose
from brokk_rl.errors import FrameError
from brokk_rl.session import write_text
from brokk_rl.signals import Frame
from perception.calibrate.extrinsics import CameraExtrinsics
from perception.calibrate.transforms import make_transform
from perception.segment.window import Window
from perception.sources import validation
from perception.stereo import correct_depth

FILE = "camera.yaml"
EXPECTED = "a mapping with K, size_px, dist, baseline_m and T_base_cam"


@dataclass(frozen=True)
class CameraModel:
    """One camera, or a pair of which it is the left one; see `brokk_rl.signals.Frame`.

    Attributes:
        matrix: Camera matrix, `(3, 3)`.
        distortion: Coefficients of the lens; `None` for rectified pictures.
        baseline_m: Distance of the pair; `None` for one camera.
        size_px: Columns and rows of the pictures; `None` for unknown.
        base_from_camera: Pose in the base frame, `(4, 4)`.
        cov: Covariance of that pose, `(6, 6)`.
        disparity_std_px: Standard deviation of the error of the pair's disparity.
        disparity_error_px: The part of it that is known.
        gamma: Exponent of the tone curve.
        maps: Of `cv2.remap` for the left picture, and for the right one, which rectify raw pictures:
            all else is told of those after it. Empty where the pictures need none.
    """

    matrix: np.ndarray
    distortion: np.ndarray | None = None
    baseline_m: float | None = None
    size_px: tuple[int, int] | None = None
    base_from_camera: np.ndarray | None = None
    cov: np.ndarray | None = None
    disparity_std_px: float | None = None
    disparity_error_px: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gamma: float = validation.USUAL_GAMMA
    maps: tuple[Any, ...] = ()

    def place(self, extrinsics: CameraExtrinsics) -> CameraModel:
        """Return the camera with what a calibration knows of it better."""
        known = {name: one for name, one in vars(extrinsics).items() if one is not None}
        return replace(self, **known)

    def crop(self, part: Window) -> CameraModel:
        """Return the camera of a part of the pictures."""
        size_px = part.width, part.height
        return replace(self, matrix=part.crop_matrix(self.matrix), size_px=size_px)

    def check_picture(self, picture: np.ndarray, where: str, name: str) -> None:
        """Refuse a picture `(h, w, 3)` named `name` that cannot be one of this camera, told by `where`."""
        validation.check_size(self.size_px, picture.shape, where, name)
        validation.check_matrix_fits(self.matrix, picture.shape, where)

    def rectify(self, pictures: list[np.ndarray], where: str) -> list[np.ndarray]:
        """Return pictures `(h, w, 3)`, the left one first, with equal rows.

        Raises:
            FrameError: they have another size than the lens was told for.
        """
        for picture in pictures:
            validation.check_size(self.size_px, picture.shape, "the lens", where)
        if not self.maps:
            return pictures
        straight = []
        for picture, (x, y) in zip(pictures, self.maps, strict=False):
            straight.append(np.asarray(cv2.remap(picture, x, y, cv2.INTER_CUBIC), np.uint8))
        return straight

    def build_frame(
        self,
        color: np.ndarray,
        depth_m: np.ndarray,
        t_s: float,
        right: np.ndarray | None = None,
        name: str = "",
        depth_shrink: int = 1,
    ) -> Frame:
        """Return a frame of this camera; its depth is freed of the known error of the disparity."""
        error_px = self.disparity_error_px
        return Frame(
            color=color,
            depth_m=correct_depth(depth_m, self.matrix, self.baseline_m, error_px),
            camera_matrix=self.matrix,
            base_from_camera=self.base_from_camera,
            t_s=t_s,
            distortion=self.distortion,
            right=right,
            baseline_m=self.baseline_m,
            name=name,
            camera_cov=self.cov,
            disparity_std_px=self.disparity_std_px,
            disparity_error_px=error_px,
            gamma=self.gamma,
            depth_shrink=depth_shrink,
        )


@dataclass(frozen=True)
class RawFrame:
    """Pictures of one moment, as a camera or its files give them.

    Attributes:
        color: Left or only picture, RGB, `(h, w, 3)` uint8.
        right: Right picture, RGB; `None` where there is none.
        depth_m: Depth along z, `(h, w)` float32; `None` where there is none.
        t_s: Time of the picture.
        name: Where they come from, for messages.
        camera: The camera as it tells itself, which rectifies the pictures; `None` where it does not.
    """

    color: np.ndarray
    right: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    t_s: float = 0.0
    name: str = ""
    camera: CameraModel | None = None


def express_in_camera(
    hole: HolePose, frame: Frame
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return centre and axis of a hole in the camera of a frame, `(3,)`, and the turn into it.

    `None` for a hole in the base frame where the pose of the camera is not known.
    """
    if hole.frame == "camera":
        return hole.center_m, hole.axis, np.eye(3)
    if frame.base_from_camera is None:
        return None
    rotation = frame.base_from_camera[:3, :3].T
    shift = -rotation @ frame.base_from_camera[:3, 3]
    return rotation @ hole.center_m + shift, rotation @ hole.axis, rotation


def read_camera(path: Path) -> CameraModel:
    """Read `camera.yaml`.

    Raises:
        FrameError: it is missing, is no YAML, or holds impossible values.
    """
    told, where = validation.read_mapping(path, EXPECTED), str(path)
    if "K" not in told:
        raise FrameError(f"{path}: K is missing; expected {EXPECTED}")
    numbers = {}
    for name in validation.NUMBERS:
        if told.get(name) is not None:
            numbers[name] = validation.check_number(told[name], where, name)
    pose = told.get("T_base_cam")
    return CameraModel(
        validation.check_matrix(told["K"], where),
        validation.check_distortion(told.get("dist"), where),
        size_px=validation.parse_size(told.get("size_px"), where),
        base_from_camera=None if pose is None else validation.check_pose(pose, where),
        **numbers,
    )


def write_camera(folder: Path, camera: CameraModel) -> None:
    """Write `camera.yaml` into a folder of frames.

    Raises:
        StorageError: it could not be written.
    """
    distortion = np.zeros(0) if camera.distortion is None else camera.distortion
    told: dict[str, Any] = {"K": np.asarray(camera.matrix).tolist()}
    if camera.size_px is not None:
        told["size_px"] = [int(one) for one in camera.size_px]
    told["dist"] = [float(one) for one in np.ravel(distortion)]
    for name in validation.NUMBERS:
        if getattr(camera, name) is not None:
            told[name] = float(getattr(camera, name))
    if camera.base_from_camera is not None:
        told["T_base_cam"] = np.asarray(camera.base_from_camera).tolist()
    write_text(folder / FILE, yaml.safe_dump(told, sort_keys=False, default_flow_style=None))


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
    maps = []
    for lens in ((one, bent, first, project), (other, other_bent, second, project_other)):
        maps.append(cv2.initUndistortRectifyMap(*lens, size_px, cv2.CV_32FC1))
    baseline_m = float(-project_other[0, 3] / project_other[0, 0])
    if baseline_m <= 0:
        raise FrameError(f"{path}: the second camera lies left of the first; swap them")
    return CameraModel(np.asarray(project)[:, :3], None, baseline_m, size_px, maps=tuple(maps))


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
        raise FrameError(f"{path}: {size_px[0]} x {size_px[1]} px are none of a ZED ({known})")
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
