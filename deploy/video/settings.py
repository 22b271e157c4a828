"""Settings of the video beside the loop: the spec in `conf/video`."""

from __future__ import annotations

from importlib.util import find_spec

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Count, spec
from deploy.video.sources import DeviceCamera

SOCKET = "video"
"""Name of the socket between page and video process, in a folder that only its owner may enter."""


@spec
class VideoSettings:
    """Live video on the operator's page.

    Attributes:
        cameras: Cameras by their names on the page.
        viewers: Pages that can watch at once; each one is encoded for by itself.
    """

    cameras: dict[str, DeviceCamera]
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
