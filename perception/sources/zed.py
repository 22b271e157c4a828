"""ZED stereo cameras through their SDK (`pyzed`), which is imported when the camera is opened."""

from __future__ import annotations

import time
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.spec import Positive, spec
from perception.calibrate.extrinsics import CameraPlacement, load_extrinsics
from perception.camera import CameraModel, RawFrame
from perception.sources import validation
from perception.sources.live import Freshness, LiveSource, import_library

_RETRY_S = 0.005
"""Pause between two attempts to grab a frame."""


@spec
class Zed:
    """Read a ZED camera: rectified left picture and its depth, both from the SDK.

    Attributes:
        serial: Serial number of the camera; `null` for the only one.
        recording: SVO file to replay instead of a camera, `null` for none.
        resolution: The SDK's name; at `HD1080` depth is half as uncertain as at `HD720`.
        rate_hz: Pictures a second.
        depth_mode: The SDK's name of the matcher.
        sensing: `standard` leaves unseen depth unknown. `fill` invents it and is refused.
        confidence: Least confidence of depth, percent of the SDK's scale.
        nearest_m: Range of depth.
        farthest_m: Range of depth.
        base_from_camera: Pose of the left camera in the base frame: `calibration.yaml` of
            `mode=calibrate`, or `(4, 4)`; `null` where unknown.
        fresh: Limits of age and waiting time.
    """

    serial: int | None
    recording: str | None
    resolution: Literal["HD2K", "HD1080", "HD720", "VGA"]
    rate_hz: int
    depth_mode: Literal["NEURAL_PLUS", "NEURAL", "NEURAL_LIGHT", "ULTRA", "QUALITY", "PERFORMANCE"]
    sensing: Literal["standard", "fill"]
    confidence: Annotated[int, Interval(ge=1, le=100)]
    nearest_m: Positive
    farthest_m: float
    base_from_camera: CameraPlacement
    fresh: Freshness

    def check(self) -> None:
        if self.sensing == "fill":
            raise ConfigError("sensing: 'fill' invents depth, also across boreholes; use standard")
        if self.nearest_m >= self.farthest_m:
            raise ConfigError(f"nearest_m: {self.nearest_m} is not < farthest_m={self.farthest_m}")

    def build(self) -> LiveSource:
        """Return the source, not yet opened."""
        place = load_extrinsics(self.base_from_camera, "source.base_from_camera")
        return LiveSource(ZedDevice(self), "ZED camera", self.fresh, place)


class ZedDevice:
    """The camera's SDK as a `perception.sources.live.CameraDevice`."""

    def __init__(self, settings: Zed) -> None:
        self._settings = settings
        self._sl: Any = None
        self._camera: Any = None
        self.has_ended = False

    def open(self) -> CameraModel:
        """Open the camera.

        Raises:
            FrameError: there is no SDK, no camera, or it cannot run as configured.
        """
        sl = import_library(
            "pyzed.sl",
            "ZED camera: the Python package `pyzed` is not installed; it comes with the ZED SDK "
            "(get_python_api.py). Recorded frames replay without it: perception/source=folder",
        )
        settings, init = self._settings, sl.InitParameters()
        init.camera_resolution = getattr(sl.RESOLUTION, settings.resolution)
        init.camera_fps = settings.rate_hz
        init.depth_mode = getattr(sl.DEPTH_MODE, settings.depth_mode, None)
        if init.depth_mode is None:
            raise FrameError(f"source.depth_mode: choose another, {settings.depth_mode} is unknown")
        init.coordinate_units = sl.UNIT.METER
        init.coordinate_system = sl.COORDINATE_SYSTEM.IMAGE  # x right, y down, z forward
        init.depth_minimum_distance = settings.nearest_m
        init.depth_maximum_distance = settings.farthest_m
        if settings.serial is not None:
            init.set_from_serial_number(settings.serial)
        if settings.recording is not None:
            init.set_from_svo_file(settings.recording)
        self._sl, self._camera = sl, sl.Camera()
        if (status := self._camera.open(init)) != sl.ERROR_CODE.SUCCESS:
            raise FrameError(
                f"ZED camera: cannot be opened ({status}). Is it plugged in, and free of other "
                "programs?"
            )
        self._picture, self._right, self._depth = sl.Mat(), sl.Mat(), sl.Mat()
        self._runtime = sl.RuntimeParameters()
        self._runtime.confidence_threshold = settings.confidence
        self._runtime.enable_fill_mode = False
        # As SDK 4 has it; there is no SDK 3 for Python 3.11.
        configuration = self._camera.get_camera_information().camera_configuration
        calibration = configuration.calibration_parameters
        # Rectified pictures: the distortion in it is that of the raw ones.
        left = calibration.left_cam
        matrix = np.array([[left.fx, 0.0, left.cx], [0.0, left.fy, left.cy], [0.0, 0.0, 1.0]])
        return CameraModel(matrix, None, abs(float(calibration.get_camera_baseline())))

    def capture(self, timeout_s: float) -> RawFrame | None:
        """Return the next capture, `None` when there is none in time or the recording has ended."""
        sl, until = self._sl, time.monotonic() + timeout_s
        while (status := self._camera.grab(self._runtime)) != sl.ERROR_CODE.SUCCESS:
            is_recording = self._settings.recording is not None
            self.has_ended = is_recording and status == sl.ERROR_CODE.END_OF_SVOFILE_REACHED
            if self.has_ended or time.monotonic() > until:
                return None
            time.sleep(_RETRY_S)
        self._camera.retrieve_image(self._picture, sl.VIEW.LEFT)
        self._camera.retrieve_image(self._right, sl.VIEW.RIGHT)
        self._camera.retrieve_measure(self._depth, sl.MEASURE.DEPTH)
        t_s = self._camera.get_timestamp(sl.TIME_REFERENCE.IMAGE).get_nanoseconds() * 1e-9
        color = validation.convert_color(np.asarray(self._picture.get_data()), "ZED camera")
        right = validation.convert_color(np.asarray(self._right.get_data()), "ZED camera")
        # A copy, since the SDK reuses its memory.
        return RawFrame(color, right, np.array(self._depth.get_data(), np.float32), t_s)

    def now_s(self) -> float:
        """Return the time on the SDK's clock; that of a recording stands at its pictures."""
        clocks = self._sl.TIME_REFERENCE
        clock = clocks.IMAGE if self._settings.recording else clocks.CURRENT
        return self._camera.get_timestamp(clock).get_nanoseconds() * 1e-9

    def close(self) -> None:
        """Close the camera."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.close()
