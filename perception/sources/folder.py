"""Frames of a folder, in the order of their names."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, Share, spec
from perception import dataset
from perception.calibrate.extrinsics import CameraPlacement, load_extrinsics
from perception.camera import FILE, CameraModel, read_camera
from perception.sources import validation


@spec
class FrameFolder:
    """Replay the frames of a folder; `camera.yaml` holds for all of them.

    Attributes:
        folder: The folder.
        rate_hz: Frame rate; gives frame `k` the time k / rate_hz.
        least_known: Least part of the picture with known depth.
        needs: Required files of a frame. `depth`: depth, or a pair, which is left to who uses the frame.
            `camera`: a picture alone, for boards.
        base_from_camera: Pose of the camera in the base frame: `calibration.yaml` of
            `mode=calibrate`, or `(4, 4)`; `null` takes `T_base_cam` of `camera.yaml`.
    """

    folder: str
    rate_hz: Positive
    least_known: Share
    needs: Literal["depth", "camera"]
    base_from_camera: CameraPlacement

    def build(self) -> FolderSource:
        """Return the source, not yet opened."""
        return FolderSource(self)


def read_picture(path: Path) -> np.ndarray:
    """Return a picture as OpenCV reads it, blue first.

    Raises:
        FrameError: it is missing, truncated, or no picture.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FrameError(f"{path}: no such file") from error
    except OSError as error:
        raise FrameError(f"{path}: cannot be read ({error.strerror})") from error
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if picture is None:
        raise FrameError(f"{path}: {'truncated, damaged or no picture' if data else 'empty'}")
    return np.asarray(picture)


class FolderSource:
    """An open folder; see `brokk_rl.contracts.vision.FrameSource`."""

    def __init__(self, settings: FrameFolder) -> None:
        self._settings, self._place = settings, Path(settings.folder)
        self._stems: list[Path] = []
        self._camera: CameraModel | None = None
        self._next = 0

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self._stems) or len(dataset.list_stems(self._place))

    def __enter__(self) -> FolderSource:
        self._stems, self._next = dataset.list_stems(self._place), 0
        path = self._place / FILE
        extrinsics = load_extrinsics(self._settings.base_from_camera, "source.base_from_camera")
        self._camera = read_camera(path).place(extrinsics)
        if self._camera.base_from_camera is not None:
            validation.check_upright(self._camera.base_from_camera, str(path))
        return self

    def __exit__(self, *exc: Any) -> None:
        self._stems = []

    def read_latest(self) -> Frame | None:
        """Return the next frame, `None` after the last.

        Raises:
            FrameError: it cannot be used; the next call goes on with the one after it.
        """
        if self._next >= len(self._stems):
            return None
        stem, number = self._stems[self._next], self._next
        self._next += 1
        return self._read(stem, number / self._settings.rate_hz)

    def _read(self, stem: Path, t_s: float) -> Frame:
        left_path = stem.with_name(stem.name + dataset.COLOR)
        right_path = stem.with_name(stem.name + dataset.RIGHT)
        color = validation.convert_color(read_picture(left_path), str(left_path))
        camera = self._camera
        if camera is None:
            raise FrameError(f"{self._place}: not open; use it in a `with` block")
        camera.check_picture(color, str(self._place / FILE), str(left_path))
        right = None
        if right_path.exists():
            right = validation.convert_color(read_picture(right_path), str(right_path))
            validation.check_same_size(color, right, str(right_path), "the right picture")
        depth_m = self._read_depth(stem, color, right is not None, camera)
        return camera.build_frame(color, depth_m, t_s, right, str(stem))

    def _read_depth(
        self, stem: Path, color: np.ndarray, is_pair: bool, camera: CameraModel
    ) -> np.ndarray:
        """Return the stored depth of a frame, NaN where there is none."""
        stored = stem.with_name(stem.name + dataset.DEPTH)
        millimetres = stem.with_name(stem.name + dataset.DEPTH_MM)
        least = self._settings.least_known
        if stored.exists() or millimetres.exists():
            where = stored if stored.exists() else millimetres
            if stored.exists():
                values = _load_array(stored)
            else:
                values = validation.convert_png_depth(read_picture(where), str(where))
            found = validation.check_depth(values, str(where), least)
            validation.check_same_size(color, found, str(where), "depth")
            return found
        if self._settings.needs == "depth" and not is_pair:
            raise FrameError(
                f"{stem}: no depth; expected {stored.name}, {millimetres.name}, or "
                f"{stem.name}{dataset.RIGHT} to match with"
            )
        is_rectified = camera.baseline_m is not None and camera.distortion is None
        if self._settings.needs == "depth" and not is_rectified:
            raise FrameError(
                f"{stem}: depth of a pair needs baseline_m and a rectified camera (dist 0) in "
                f"{FILE}"
            )
        return np.full(color.shape[:2], np.nan, np.float32)


def _load_array(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FrameError(f"{path}: truncated or no array ({error})") from error
