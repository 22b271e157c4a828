"""RealSense cameras through `pyrealsense2`, which is imported when the camera is opened."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.spec import spec
from perception.calibrate.extrinsics import CameraPlacement, load_extrinsics
from perception.camera import CameraModel, RawFrame
from perception.sources import validation
from perception.sources.live import Freshness, LiveSource, import_library


@spec
class RealSense:
    """Read a RealSense camera: colour, and depth aligned to it, without hole filling.

    Attributes:
        serial: Serial number of the camera; `null` for the only one.
        width: Pixels.
        height: Pixels.
        rate_hz: Pictures a second.
        base_from_camera: Pose of the colour camera in the base frame: `calibration.yaml` of
            `mode=calibrate`, or `(4, 4)`; `null` where unknown.
        fresh: Limits of age and waiting time.
    """

    serial: str | None
    width: int
    height: int
    rate_hz: int
    base_from_camera: CameraPlacement
    fresh: Freshness

    def build(self) -> LiveSource:
        """Return the source, not yet opened."""
        place = load_extrinsics(self.base_from_camera, "source.base_from_camera")
        return LiveSource(RealSenseDevice(self), "RealSense camera", self.fresh, place)


class RealSenseDevice:
    """The camera's library as a `perception.sources.live.CameraDevice`."""

    has_ended = False

    def __init__(self, settings: RealSense) -> None:
        self._settings = settings
        self._pipeline: Any = None
        self._started = False

    def open(self) -> CameraModel:
        """Open the camera.

        Raises:
            FrameError: there is no library, no camera, or it cannot run as configured.
        """
        missing = "RealSense camera: the Python package `pyrealsense2` is not installed"
        self._rs = rs = import_library("pyrealsense2", missing)
        settings, config = self._settings, rs.config()
        if settings.serial is not None:
            config.enable_device(settings.serial)
        size = (settings.width, settings.height)
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, settings.rate_hz)
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, settings.rate_hz)
        self._pipeline, self._align = rs.pipeline(), rs.align(rs.stream.color)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise FrameError(
                f"RealSense camera: cannot be opened at {size[0]} x {size[1]}, {settings.rate_hz} Hz "
                f"({error})"
            ) from error
        self._started = True
        self._scale_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
        lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        matrix = np.array([[lens.fx, 0.0, lens.ppx], [0.0, lens.fy, lens.ppy], [0.0, 0.0, 1.0]])
        coefficients = np.array(lens.coeffs, float)
        if lens.model == rs.distortion.inverse_brown_conrady and coefficients.any():
            coefficients = invert_distortion(coefficients, matrix, size)
        bent = validation.check_distortion(coefficients.tolist(), "RealSense camera")
        return CameraModel(matrix, bent)

    def capture(self, timeout_s: float) -> RawFrame | None:
        """Return the next capture, `None` when there is none in time."""
        try:
            taken = self._pipeline.wait_for_frames(max(1, int(1000 * timeout_s)))
            frames = self._align.process(taken)
        except RuntimeError:  # the library's way to say that time is up
            return None
        depth, color = frames.get_depth_frame(), frames.get_color_frame()
        if not depth or not color:
            return None
        # copies: the library reuses its memory
        values = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(self._scale_m)
        # Without its global time the library stamps by the camera's own clock, whose offset is
        # unknown: the time of arrival serves then.
        own_clock = color.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock
        t_s = time.time() if own_clock else float(color.get_timestamp()) * 1e-3
        return RawFrame(np.array(color.get_data(), np.uint8), None, values, t_s)

    def now_s(self) -> float:
        """Return the host's time: captures are stamped by it."""
        return time.time()

    def close(self) -> None:
        """Close the camera."""
        if self._started:
            self._started = False
            self._pipeline.stop()


def invert_distortion(inverse: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return OpenCV's coefficients `k1 k2 p1 p2 k3` of a lens given by the inverse ones, `(5,)`.

    OpenCV's polynomial maps rays to pixels, RealSense's inverse one of the same form pixels to
    rays. Fitted by least squares on a grid over the picture.

    Args:
        inverse: Coefficients of the inverse.
        matrix: Camera matrix.
        size: Width and height of the picture, px.
    """
    columns, rows = np.meshgrid(np.linspace(0, size[0] - 1, 24), np.linspace(0, size[1] - 1, 16))
    pixels = np.stack([columns.ravel(), rows.ravel()])
    seen = (pixels - matrix[:2, 2:]) / np.diag(matrix)[:2, None]
    ray = seen + _tabulate_distortion(seen) @ inverse
    table = _tabulate_distortion(ray)
    return np.linalg.lstsq(table.reshape(-1, 5), (seen - ray).ravel(), rcond=None)[0]


def _tabulate_distortion(point: np.ndarray) -> np.ndarray:
    """Return the displacement of points `(2, M)` at z = 1 per coefficient, `(2, M, 5)`."""
    x, y = point
    r2 = x * x + y * y
    along_x = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], -1)
    along_y = np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], -1)
    return np.stack([along_x, along_y])
