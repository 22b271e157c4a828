"""Pictures of a camera as its owner has them: its library, a video, a device, or exported files."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import FrameError
from brokk_rl.spec import Positive, spec
from perception.camera import CameraModel, RawFrame
from perception.sources import validation
from perception.sources.folder import read_picture

NUMBER = re.compile(r"(\d+)(?!.*\d)")
"""The last number of a file's name: which frame it belongs to."""


@spec
class SourceCapture:
    """Frames of a camera with a library of its own: an option of `conf/perception/source`.

    Attributes:
        source: The camera, or a recording of it.
    """

    source: FrameSourceSpec

    def read(self) -> Iterator[RawFrame]:
        """Yield frames until a recording ends; a camera has no end.

        Raises:
            FrameError: the camera cannot be opened, or gives no frame in time.
        """
        with self.source.build() as source:
            for number, frame in enumerate(iter(source.read_latest, None)):
                size_px = frame.color.shape[1], frame.color.shape[0]
                lens = (frame.camera_matrix, frame.distortion, frame.baseline_m, size_px)
                pictures = (frame.color, frame.right, frame.depth_m)
                yield RawFrame(*pictures, frame.t_s, f"frame {number}", CameraModel(*lens))


@spec
class StereoVideo:
    """A video file, or a camera that OpenCV opens.

    Attributes:
        input: A file, or the number of a device: 0 is the first camera.
        layout: Where both pictures are in one: side by side as a ZED gives them, one above the
            other, or `single` for a left picture alone.
        rate_hz: Of a device, asked of it; `null` leaves it as it is.
        size_px: Width and height of a device's picture, asked of it; `null` leaves it as it is.
    """

    input: str | int
    layout: Literal["side_by_side", "above", "single"]
    rate_hz: float | None
    size_px: tuple[int, int] | None

    def read(self) -> Iterator[RawFrame]:
        """Yield frames until the video ends; a device has no end.

        Raises:
            FrameError: it cannot be opened, or cannot be cut into two pictures.
        """
        is_device = str(self.input).isdigit()
        if not is_device and not Path(str(self.input)).is_file():
            raise FrameError(
                f"capture.input={self.input}: no such file; expected a video, or the number of a "
                "camera such as 0"
            )
        video = cv2.VideoCapture(int(self.input) if is_device else str(self.input))
        if is_device and self.size_px is not None:
            video.set(cv2.CAP_PROP_FRAME_WIDTH, self.size_px[0])
            video.set(cv2.CAP_PROP_FRAME_HEIGHT, self.size_px[1])
        if is_device and self.rate_hz is not None:
            video.set(cv2.CAP_PROP_FPS, self.rate_hz)
        try:
            if not video.isOpened():
                raise FrameError(
                    f"capture.input={self.input}: OpenCV cannot open it; a camera may be in use, a "
                    "video may need another codec"
                )
            for number in itertools.count():
                there, picture = video.read()
                if not there:
                    return
                yield self._cut(f"{self.input}, frame {number}", np.asarray(picture))
        finally:
            video.release()

    def _cut(self, name: str, picture: np.ndarray) -> RawFrame:
        """Return the left and the right part of a picture, blue first, as RGB."""
        color = np.ascontiguousarray(picture[..., ::-1])
        if self.layout == "single":
            return RawFrame(color, name=name)
        axis = 1 if self.layout == "side_by_side" else 0
        if color.shape[axis] % 2:
            raise FrameError(
                f"{name}: {color.shape[1]} x {color.shape[0]} px cannot be cut into two equal "
                f"pictures {self.layout}; expected an even number, or capture.layout=single"
            )
        left, right = np.split(color, 2, axis)
        return RawFrame(np.ascontiguousarray(left), np.ascontiguousarray(right), name=name)


@spec
class ExportedPictures:
    """Files that a camera's own tools export; those of one frame have the same last number.

    Attributes:
        folder: The folder.
        color: Glob of the left or only pictures.
        right: Glob of the right ones; `null` for none.
        depth: Glob of depth pictures, 16 bits; `null` for none.
        depth_unit_m: A step of the depth picture.
    """

    folder: str
    color: str
    right: str | None
    depth: str | None
    depth_unit_m: Positive

    def read(self) -> Iterator[RawFrame]:
        """Yield frames in the order of their numbers.

        Raises:
            FrameError: there are none, one lacks a partner, or a picture cannot be read.
        """
        files = {}
        for kind, pattern in (("color", self.color), ("right", self.right), ("depth", self.depth)):
            if pattern is not None:
                files[kind] = self._list_files(kind, pattern)
        for number, path in sorted(files["color"].items()):
            parts: dict[str, np.ndarray] = {}
            for kind, some in files.items():
                if number not in some:
                    raise FrameError(
                        f"{path}: no partner numbered {number} by capture.{kind}="
                        f"{getattr(self, kind)} in {self.folder}"
                    )
                picture, where = read_picture(some[number]), str(some[number])
                if kind == "depth":
                    parts[kind] = validation.convert_png_depth(picture, where, self.depth_unit_m)
                else:
                    parts[kind] = validation.convert_color(picture, where)
            yield RawFrame(parts["color"], parts.get("right"), parts.get("depth"), name=str(path))

    def _list_files(self, kind: str, pattern: str) -> dict[int, Path]:
        """Return files by number."""
        found: dict[int, Path] = {}
        for path in sorted(Path(self.folder).glob(pattern)):
            match = NUMBER.search(path.stem)
            if match is None:
                raise FrameError(f"{path}: expected a number in its name, which says its frame")
            number = int(match.group(1))
            if number in found:
                raise FrameError(
                    f"capture.{kind}={pattern}: {found[number].name} and {path.name} have the same "
                    "number; choose a narrower pattern"
                )
            found[number] = path
        if not found:
            raise FrameError(f"capture.{kind}={pattern}: no such file in '{self.folder}'")
        return found
