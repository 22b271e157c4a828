"""Settings of the video beside the loop: the spec in `conf/video`, and its kinds of cameras."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Count, Positive, spec
from deploy.video.sources import OpenedDevice, TestPattern, VideoSource

SOCKET = "video"
"""Name of the socket between page and video process, in a folder that only its owner may enter."""


class VideoCamera(Protocol):
    """A spec of one camera."""

    def build(self) -> VideoSource:
        """Return the open camera.

        Raises:
            FrameError: there is no such camera.
        """
        ...


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

    def build(self) -> VideoSource:
        """See `VideoCamera`."""
        return OpenedDevice(self.device, self.container, self.options)


@spec
class PatternCamera:
    """A moving test picture that carries the time of its making, for desks and benchmarks.

    Attributes:
        width_px: Of the picture.
        height_px: Of the picture.
        rate_hz: Pictures a second.
    """

    width_px: Count
    height_px: Count
    rate_hz: Positive

    def build(self) -> VideoSource:
        """See `VideoCamera`."""
        return TestPattern(self.width_px, self.height_px, self.rate_hz)


@spec
class VideoSettings:
    """Live video on the operator's page.

    Attributes:
        cameras: Cameras by their names on the page.
        viewers: Pages that can watch at once; each one is encoded for by itself.
    """

    cameras: dict[str, VideoCamera]
    viewers: Count

    def check(self) -> None:
        if not self.cameras:
            raise ConfigError("cameras: expected one or more")

    def require_packages(self) -> None:
        """Check before any process starts that the video process can.

        Raises:
            ModuleNotFoundError: the extra `video` is not installed.
        """
        if find_spec("aiortc") is None:
            raise ModuleNotFoundError("video needs aiortc", name="aiortc")


@dataclass(frozen=True)
class VideoProcessConfig:
    """Settings of a video process.

    Attributes:
        video: The cameras.
        folder: Holds the socket; only its owner may enter.
    """

    video: VideoSettings
    folder: str
