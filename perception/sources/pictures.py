"""All pictures of a folder, for the detection of ellipses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec

ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"}
BESIDE = (".depth.png", ".right.png", ".mask.png")
"""Endings of files beside the colour picture of a frame."""


@spec
class PictureFolder:
    """Read every picture of a folder, coloured or grey, without depth and camera.

    Attributes:
        folder: The folder, or one picture.
    """

    folder: str

    def build(self) -> PictureSource:
        """Return the source, not yet opened."""
        return PictureSource(Path(self.folder))


class PictureSource:
    """An open folder of pictures; see `brokk_rl.contracts.vision.FrameSource`."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._paths: list[Path] = []
        self._next = 0

    @property
    def num_frames(self) -> int:
        """Number of pictures."""
        return len(self._paths)

    def __enter__(self) -> PictureSource:
        if self._place.is_file():
            self._paths = [self._place]
        else:
            self._paths = sorted(
                path
                for path in (self._place.iterdir() if self._place.is_dir() else ())
                if path.suffix.lower() in ENDINGS
                and not path.name.endswith(BESIDE)
                and path.name[0] != "."
            )
        if not self._paths:
            what = "no pictures" if self._place.is_dir() else "no such folder"
            raise FrameError(
                f"{self._place}: {what}; expected files that end in {', '.join(sorted(ENDINGS))}"
            )
        self._next = 0
        return self

    def __exit__(self, *exc: Any) -> None:
        self._paths = []

    def read_latest(self) -> Frame | None:
        """Return the next picture, `None` after the last.

        Raises:
            FrameError: it cannot be read; the next call goes on with the one after it.
        """
        if self._next >= len(self._paths):
            return None
        path = self._paths[self._next]
        self._next += 1
        try:
            data = np.frombuffer(path.read_bytes(), np.uint8)
        except OSError as error:
            raise FrameError(f"{path}: cannot be read ({error.strerror or error})") from error
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
        if picture is None:
            raise FrameError(f"{path}: {'truncated or no picture' if len(data) else 'empty'}")
        color = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
        height, width = color.shape[:2]
        matrix = np.array(
            [[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]]
        )
        name = str(path.with_name(path.name.removesuffix(".color.png").removesuffix(path.suffix)))
        return Frame(
            color,
            np.full((height, width), np.nan, np.float32),
            matrix,
            None,
            float(self._next - 1),
            name=name,
        )
