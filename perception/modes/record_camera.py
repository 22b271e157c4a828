"""`brokk mode=record_camera`: frames of any camera, as files that the other modes read."""

from __future__ import annotations

import itertools
import logging
from dataclasses import replace
from pathlib import Path

from brokk_rl.errors import FrameError
from brokk_rl.session import Session
from brokk_rl.spec import Count, spec
from perception import dataset
from perception.camera import CameraModel, RawFrame, read_camera, read_pair_lens, write_camera
from perception.sources import validation
from perception.sources.recorded import ExportedPictures, RosLog, SourceCapture, StereoVideo

log = logging.getLogger(__name__)

FOLDER = "frames"


@spec
class RecordCamera:
    """Write frames of any camera, rectified, with the camera's numbers.

    Attributes:
        session: Folder to write into.
        capture: The pictures.
        lens: `camera.yaml` of rectified pictures; for raw pairs a ZED's factory `.conf`, or YAML of
            OpenCV's `stereoCalibrate` (`K1 D1 K2 D2 R T`); `null` where the capture tells it.
        every: One in so many frames is kept.
        count: Frames that are kept at most; `null` for all, which a device has no end of.
    """

    session: Session
    capture: SourceCapture | StereoVideo | ExportedPictures | RosLog
    lens: str | None
    every: Count
    count: Count | None

    def run(self) -> None:
        """Write `frames/<number>.*` and `frames/camera.yaml`.

        Raises:
            FrameError: the camera file or a picture cannot be used, or there is none.
            StorageError: a file could not be written.
        """
        folder = self.session.folder / FOLDER
        kept, camera = 0, None
        last = None if self.count is None else self.count * self.every
        for frame in itertools.islice(self.capture.read(), 0, last, self.every):
            if camera is None:
                camera = self._find_camera(frame)
                # Where it stands is another matter: that of `mode=calibrate`.
                write_camera(folder, replace(camera, base_from_camera=None))
            self._write(folder / f"{kept:05d}", frame, camera)
            kept += 1
        if not kept:
            raise FrameError("record_camera: the camera gave no picture")
        log.info("%d frames: %s", kept, folder)

    def _find_camera(self, frame: RawFrame) -> CameraModel:
        """Return the camera of the pictures, by `lens` or as it tells itself."""
        if self.lens is None:
            if frame.camera is None:
                raise FrameError(
                    f"{frame.name}: the camera does not tell its lens; expected lens=camera.yaml, or "
                    "the factory file of the camera"
                )
            return frame.camera
        path = Path(self.lens)
        size_px = frame.color.shape[1], frame.color.shape[0]
        content = None
        if path.suffix != ".conf":
            content = validation.read_mapping(path, "the numbers of a lens")
        if content is None or "K1" in content:
            return read_pair_lens(path, content, size_px)
        camera = read_camera(path)
        camera.check_picture(frame.color, self.lens, frame.name)
        is_pair = frame.right is not None
        if is_pair and (camera.baseline_m is None or camera.distortion is not None):
            raise FrameError(
                f"{self.lens}: a pair needs baseline_m and rectified pictures (dist 0); take the lens "
                "of both raw cameras (K1 D1 K2 D2 R T), or capture.layout=single"
            )
        return replace(camera, size_px=size_px)

    def _write(self, stem: Path, frame: RawFrame, camera: CameraModel) -> None:
        """Write a frame, rectified."""
        pictures = [frame.color]
        if frame.right is not None:
            what = "the right picture"
            validation.check_same_size(frame.color, frame.right, frame.name, what)
            pictures.append(frame.right)
        if frame.depth_m is not None:
            validation.check_same_size(frame.color, frame.depth_m, frame.name, "depth")
            if camera.maps:
                raise FrameError(
                    f"{frame.name}: depth belongs to the raw picture, which is rectified; record "
                    "rectified pictures, or without depth"
                )
        color, *right = camera.rectify(pictures, frame.name)
        dataset.write_frame(stem, color, frame.depth_m, right[0] if right else None)
