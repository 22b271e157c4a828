"""A camera: all that a user of its pictures has to know, as `camera.yaml` tells it."""

from __future__ import annotations

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
