"""Pictures of cameras as they come, and a test picture that carries its own time.

A source may block; a thread of its own reads each one and keeps only the newest picture.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from fractions import Fraction
from typing import Any, Protocol

import numpy as np

from brokk_rl.errors import FrameError

log = logging.getLogger(__name__)

CLOCK_HZ = 90_000
"""Rate of the clock of video in RTP (RFC 6184)."""
RETRY_S = 1.0
"""Between attempts to open or read a camera that fails. Chosen by hand."""
TICK_S = 1e-3
"""Unit of the time in a test picture."""
CODE_BITS, CODE_CHECK = 32, 8
"""Bits of the time in a test picture, and of its check."""
CODE_COLUMNS, CODE_PARTS = 8, 8
"""Blocks of the code in a row, and blocks as parts of the picture's height."""
DARK, LIGHT = 30, 225
"""Grey levels of the code: away from the ends, where the coder cuts."""


class VideoSource(Protocol):
    """An open camera."""

    def read(self) -> tuple[Any, float]:
        """Return the next `av.VideoFrame`, and the monotonic time at which it was taken.

        It may wait as long as it likes.

        Raises:
            FrameError: the camera is lost.
        """
        ...


class TestPattern:
    """Test pictures that carry their own time; the source of a `PatternCamera`."""

    __test__ = False  # no test, whatever pytest makes of the name

    def __init__(self, width_px: int, height_px: int, rate_hz: float) -> None:
        rows, columns = np.mgrid[:height_px, :width_px]
        self._background = ((rows // 8 + columns // 8) % 2 * 40 + 60).astype(np.uint8)
        # Grain is what costs bits in a real picture.
        noise = np.random.default_rng(0).normal(0.0, 8.0, (height_px, 2 * width_px))
        self._noise = noise.astype(np.int16)
        self._period_s, self._number = 1.0 / rate_hz, 0
        self._due_s = time.monotonic()

    def read(self) -> tuple[Any, float]:
        """See `VideoSource`."""
        self._due_s += self._period_s
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        now_s = time.monotonic()
        # After a pause the missed pictures are left out, not made up for.
        self._due_s = max(self._due_s, now_s - self._period_s)
        self._number += 1
        height, width = self._background.shape
        shift = self._number * 37 % width
        picture = self._background + self._noise[:, shift : shift + width]
        left = self._number * 9 % max(1, width - height // 4)
        picture[height // 2 : height // 2 + height // 4, left : left + height // 4] = LIGHT
        grey = picture.clip(0, 255).astype(np.uint8)
        draw_time_code(grey, now_s)
        return _convert_to_frame(np.repeat(grey[..., None], 3, 2)), now_s


def draw_time_code(picture: np.ndarray, t_s: float) -> None:
    """Draw a time as dark and light blocks into the upper left of a grey picture, `(h, w)` uint8."""
    side = picture.shape[0] // CODE_PARTS // 2
    for place, bit in enumerate(list_code_bits(round(t_s / TICK_S) % (1 << CODE_BITS))):
        row, column = divmod(place, CODE_COLUMNS)
        block = picture[side * row : side * (row + 1), side * column : side * (column + 1)]
        block[:] = LIGHT if bit else DARK


def list_code_bits(num_ticks: int) -> list[int]:
    """Return the bits of a time and of its check, the sum of its bytes inverted."""
    check = ~sum(num_ticks.to_bytes(CODE_BITS // 8, "big")) & (1 << CODE_CHECK) - 1
    value = num_ticks << CODE_CHECK | check
    return [value >> place & 1 for place in reversed(range(CODE_BITS + CODE_CHECK))]


class OpenedDevice:
    """Pictures of a video device; the source of a `DeviceCamera`."""

    def __init__(self, device: str, container: str | None, options: dict[str, str]) -> None:
        import av  # pyright: ignore[reportMissingImports]

        # Without buffers: an old picture is worse than none.
        options = {"fflags": "nobuffer", "rtsp_transport": "tcp"} | options
        try:
            self._container = av.open(device, format=container, options=options, timeout=5.0)
        except (av.FFmpegError, ValueError) as error:
            raise FrameError(f"video: cannot open {device}: {error}") from error
        self._device, self._pictures = device, self._container.decode(video=0)

    def read(self) -> tuple[Any, float]:
        """See `VideoSource`."""
        import av  # pyright: ignore[reportMissingImports]

        try:
            frame = next(self._pictures)
        except (av.FFmpegError, StopIteration) as error:
            self._container.close()
            raise FrameError(f"video: {self._device} delivers nothing more: {error}") from error
        return frame.reformat(format="yuv420p"), time.monotonic()


def _convert_to_frame(color: np.ndarray) -> Any:
    import av  # pyright: ignore[reportMissingImports]

    return av.VideoFrame.from_ndarray(color, format="rgb24").reformat(format="yuv420p")


class CameraReader:
    """Thread that reads one camera and keeps its newest picture.

    Args:
        name: Of the camera.
        opener: Returns the open camera; it is called again after a loss.

    Attributes:
        number: Pictures so far.
    """

    def __init__(self, name: str, opener: Callable[[], VideoSource]) -> None:
        self.name, self.number = name, 0
        self._open, self._newest, self._told = opener, None, ""
        threading.Thread(target=self._read_all, name=name, daemon=True).start()

    def read_newest(self) -> tuple[Any, float]:
        """Return the newest picture and its time; only once `number` is more than 0."""
        assert self._newest is not None
        frame, t_s = self._newest
        frame.pts, frame.time_base = round(t_s * CLOCK_HZ), Fraction(1, CLOCK_HZ)
        return frame, t_s

    def _read_all(self) -> None:
        while True:
            try:
                source = self._open()
                while True:
                    self._newest = source.read()
                    self.number += 1
                    self._told = ""
            except FrameError as error:
                if str(error) != self._told:
                    log.warning("%s: %s; trying again", self.name, error)
                    self._told = str(error)
                time.sleep(RETRY_S)
