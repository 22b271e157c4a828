"""`brokk mode=record_camera`: frames of any stereo camera, as files that the other modes read."""

from __future__ import annotations

import logging
from pathlib import Path

from brokk_rl.errors import FrameError
from brokk_rl.session import Session
from brokk_rl.spec import Count, spec
from perception import dataset
from perception.sources import validation
from perception.sources.folder import CameraModel, read_camera
from perception.sources.recorded import ExportedPictures, RawFrame, StereoVideo

log = logging.getLogger(__name__)

FOLDER = "frames"


@spec
class RecordCamera:
    """Write frames of a video, a device or exported files, with the camera's numbers.

    Attributes:
        session: Folder to write into.
        capture: The pictures, of a rectified pair.
        lens: `camera.yaml` of the camera: `K`, `dist`, `baseline_m`.
        every: One in so many frames is kept.
        count: Frames that are kept at most; `null` for all, which a device has no end of.
    """

    session: Session
    capture: StereoVideo | ExportedPictures
    lens: str
    every: Count
    count: Count | None

    def run(self) -> None:
        """Write `frames/<number>.*` and `frames/camera.yaml`.

        Raises:
            FrameError: the camera file or a picture cannot be used, or there is none.
            StorageError: a file could not be written.
        """
        model = read_camera(Path(self.lens))
        folder = self.session.folder / FOLDER
        kept = 0
        for number, frame in enumerate(self.capture.read()):
            if number % self.every:
                continue
            self._check_frame(frame, model)
            if kept == 0:
                distortion = () if model.distortion is None else tuple(model.distortion.ravel())
                dataset.write_camera(
                    folder,
                    model.matrix,
                    frame.color.shape[1::-1],
                    model.base_from_camera,
                    model.baseline_m,
                    distortion,
                    model.disparity_std_px,
                    model.gamma,
                )
            dataset.write_frame(folder / f"{kept:05d}", frame.color, frame.depth_m, frame.right)
            kept += 1
            if kept == self.count:
                break
        if not kept:
            raise FrameError("record_camera: the camera gave no picture")
        log.info("%d frames: %s", kept, folder)

    def _check_frame(self, frame: RawFrame, model: CameraModel) -> None:
        """Refuse pictures that do not fit the camera's numbers."""
        height, width = frame.color.shape[:2]
        validation.check_size(model.size_px, height, width, self.lens, frame.name)
        validation.check_matrix_fits(model.matrix, height, width, self.lens)
        if frame.right is not None:
            validation.check_same_size(frame.color, frame.right, frame.name, "the right picture")
            if model.baseline_m is None or model.distortion is not None:
                raise FrameError(
                    f"{self.lens}: a pair needs baseline_m and rectified pictures (dist 0); "
                    "export rectified pictures, or record with capture.layout=single"
                )
        if frame.depth_m is not None:
            validation.check_same_size(frame.color, frame.depth_m, frame.name, "depth")
