"""Pictures of cameras as they come.

A camera may block; a thread of its own reads each one and keeps only the newest picture.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

from brokk_rl.errors import FrameError
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

CLOCK_HZ = 90_000
"""Clock of video in RTP (RFC 3551)."""
RETRY_S = 1.0
"""Between attempts to open or read a camera that fails. Chosen by hand."""


@spec
class DeviceCamera:
    """A camera that FFmpeg opens: a device of this computer, or the address of an IP camera.

    Attributes:
        device: Path or address: `/dev/video0`, `rtsp://…`.
        container: Name that FFmpeg has for the kind of input, as `v4l2`; `null`: by the address.
        options: Further options of FFmpeg: `{video_size: 1280x720, framerate: "15"}`.
    """

    device: str
    container: str | None
    options: dict[str, str]


def read_pictures(camera: DeviceCamera) -> Iterator[tuple[Any, float]]:
    """Yield each `av.VideoFrame` of a camera, and the monotonic time at which it was taken.

    Raises:
        FrameError: it cannot be opened, or delivers nothing more.
    """
    import av  # pyright: ignore[reportMissingImports]

    # Without buffers: an old picture is worse than none.
    options = {"fflags": "nobuffer", "rtsp_transport": "tcp"} | camera.options
    device, ending = camera.device, ""
    try:
        with av.open(device, format=camera.container, options=options, timeout=5.0) as container:
            for frame in container.decode(video=0):
                yield frame.reformat(format="yuv420p"), time.monotonic()
    except (av.FFmpegError, ValueError) as error:
        ending = f" ({error})"
    raise FrameError(f"video: expected pictures of {device}, got none or no more{ending}")


class CameraReader:
    """Thread that reads one camera and keeps its newest picture.

    Args:
        name: Of the camera.
        camera: The camera; it is opened again after a loss.

    Attributes:
        number: Pictures so far.
    """

    def __init__(self, name: str, camera: DeviceCamera) -> None:
        self.name, self.number = name, 0
        self._camera, self._newest, self._told = camera, None, ""
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
                for newest in read_pictures(self._camera):
                    self._newest = newest
                    self.number += 1
                    self._told = ""
            except FrameError as error:
                if str(error) != self._told:
                    log.warning("%s: %s; trying again", self.name, error)
                    self._told = str(error)
                time.sleep(RETRY_S)
