"""Live cameras: fresh frames only, a time limit, and depth without invented values."""

from __future__ import annotations

import importlib
import time
from typing import Any, Protocol

import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, Share, spec
from perception.calibrate.extrinsics import CameraExtrinsics
from perception.camera import CameraModel, RawFrame
from perception.sources import validation


class CameraDevice(Protocol):
    """A camera's own library, behind three methods."""

    def open(self) -> CameraModel:
        """Open the camera; raises a `FrameError` when that fails."""
        ...

    def capture(self, timeout_s: float) -> RawFrame | None:
        """Wait for a new frame, with depth; `None` when there is none within the time."""
        ...

    @property
    def has_ended(self) -> bool:
        """True once no capture will come any more: a recording is at its end."""
        ...

    def now_s(self) -> float:
        """Return the time on the clock by which captures are stamped."""
        ...

    def close(self) -> None:
        """Close the camera; may be called twice."""


@spec
class Freshness:
    """Limits of frames to act on.

    Attributes:
        timeout_s: Longest wait of `read_latest` for a frame.
        max_age_s: Largest age of a frame; older ones are dropped.
        least_known: Least part of the picture with known depth.
    """

    timeout_s: Positive
    max_age_s: Positive
    least_known: Share


def import_library(name: str, missing: str) -> Any:
    """Return a camera's own library.

    Raises:
        FrameError: it is not installed, in the words of `missing`.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise FrameError(missing) from error


class LiveSource:
    """An open camera; see `brokk_rl.contracts.vision.FrameSource`. Each frame is returned once.

    Args:
        device: Library of the camera.
        name: Name of the camera in messages.
        fresh: Limits of age and waiting time.
        place: Pose of the camera and error of its disparity, as far as they are known.
    """

    num_frames = None

    def __init__(
        self, device: CameraDevice, name: str, fresh: Freshness, place: CameraExtrinsics
    ) -> None:
        self._device, self._name, self._fresh = device, name, fresh
        self._place = place
        self._camera: CameraModel | None = None
        self._last_s = -np.inf

    def __enter__(self) -> LiveSource:
        try:
            self._camera = self._device.open().place(self._place)
            validation.check_matrix(self._camera.matrix, self._name)
        except BaseException:
            self._device.close()
            raise
        return self

    def __exit__(self, *exc: Any) -> None:
        self._camera = None
        self._device.close()

    def read_latest(self) -> Frame | None:
        """Return the newest fresh frame not returned yet, waiting for it; `None` after a recording.

        Raises:
            FrameError: no such frame came in time, or it cannot be used.
        """
        if self._camera is None:
            raise FrameError(f"{self._name}: not open; use it in a `with` block")
        left, oldest_s = self._fresh.timeout_s, None
        until = time.monotonic() + left
        while left > 0:
            capture = self._device.capture(left)
            if capture is None and self._device.has_ended:
                return None
            if capture is not None and capture.t_s > self._last_s:
                age_s = self._device.now_s() - capture.t_s
                if age_s <= self._fresh.max_age_s:
                    self._last_s = capture.t_s
                    return self._build_frame(capture, self._camera)
                oldest_s = max(age_s, oldest_s or 0.0)
            left = until - time.monotonic()
        stale = ""
        if oldest_s is not None:
            allowed = f"{self._fresh.max_age_s:g} allowed"
            stale = f"; the frames that came were up to {oldest_s:.2f} s old, {allowed}"
        raise FrameError(
            f"{self._name}: no new frame for {self._fresh.timeout_s:g} s{stale}. Is it plugged in?"
        )

    def _build_frame(self, raw: RawFrame, camera: CameraModel) -> Frame:
        assert raw.depth_m is not None
        validation.check_same_size(raw.color, raw.depth_m, self._name, "depth")
        camera.check_picture(raw.color, self._name, self._name)
        depth_m = validation.check_depth(raw.depth_m, self._name, self._fresh.least_known)
        return camera.build_frame(raw.color, depth_m, raw.t_s, raw.right)
