"""Pictures of a camera as its owner has them: its library, a video, a device, or exported files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import FrameError
from brokk_rl.spec import Positive, spec
from perception.sources import validation
from perception.sources.folder import read_picture
from perception.sources.lens_file import PairLens

NUMBER = re.compile(r"(\d+)(?!.*\d)")
"""The last number of a file's name: which frame it belongs to."""


@dataclass(frozen=True)
class RawFrame:
    """Pictures of one moment.

    Attributes:
        name: Where they come from, for messages.
        color: Left or only picture, RGB, `(h, w, 3)` uint8.
        right: Right picture, RGB; `None` where there is none.
        depth_m: Depth along z, `(h, w)` float32, NaN where unknown; `None` where there is none.
        lens: The camera's own lens, which rectifies the pictures; `None` where it tells none.
    """

    name: str
    color: np.ndarray
    right: np.ndarray | None
    depth_m: np.ndarray | None
    lens: PairLens | None = None


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
            number = 0
            while (frame := source.read_latest()) is not None:
                bent = np.zeros(0) if frame.distortion is None else frame.distortion
                size_px = frame.color.shape[1], frame.color.shape[0]
                lens = PairLens(frame.camera_matrix, bent, frame.baseline_m, size_px, ())
                yield RawFrame(f"frame {number}", frame.color, frame.right, frame.depth_m, lens)
                number += 1


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
            number = 0
            while True:
                there, picture = video.read()
                if not there:
                    return
                yield self._cut(f"{self.input}, frame {number}", np.asarray(picture))
                number += 1
        finally:
            video.release()

    def _cut(self, name: str, picture: np.ndarray) -> RawFrame:
        """Return the left and the right part of a picture, blue first, as RGB."""
        color = np.ascontiguousarray(picture[..., ::-1])
        if self.layout == "single":
            return RawFrame(name, color, None, None)
        axis = 1 if self.layout == "side_by_side" else 0
        if color.shape[axis] % 2:
            raise FrameError(
                f"{name}: {color.shape[1]} x {color.shape[0]} px cannot be cut into two equal "
                f"pictures {self.layout}; expected an even number, or capture.layout=single"
            )
        left, right = np.split(color, 2, axis)
        return RawFrame(name, np.ascontiguousarray(left), np.ascontiguousarray(right), None)


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
            parts = {}
            for kind in files:
                if number not in files[kind]:
                    raise FrameError(
                        f"{path}: no partner numbered {number} by capture.{kind}="
                        f"{getattr(self, kind)} in {self.folder}"
                    )
                parts[kind] = files[kind][number]
            right = depth_m = None
            if "right" in parts:
                right = validation.convert_color(read_picture(parts["right"]), str(parts["right"]))
            if "depth" in parts:
                depth_m = self._read_depth(parts["depth"])
            color = validation.convert_color(read_picture(path), str(path))
            yield RawFrame(str(path), color, right, depth_m)

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

    def _read_depth(self, path: Path) -> np.ndarray:
        """Return a depth picture in m, NaN where it is 0."""
        steps = read_picture(path)
        if steps.dtype != np.uint16 or steps.ndim != 2:
            raise FrameError(
                f"{path}: expected a depth picture of 16 bits and one channel, got {steps.dtype} "
                f"of shape {steps.shape}"
            )
        depth_m = steps.astype(np.float32) * np.float32(self.depth_unit_m)
        return np.where(steps > 0, depth_m, np.nan).astype(np.float32)
