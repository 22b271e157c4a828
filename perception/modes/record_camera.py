"""`brokk mode=record_camera`: frames of any camera, as files that the other modes read."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml

from brokk_rl.errors import FrameError
from brokk_rl.session import Session, write_text
from brokk_rl.spec import Count, spec
from perception import dataset
from perception.calibrate.pair_lens import calibrate_pair, find_board_pair
from perception.label.camera_pose import Charuco
from perception.sources import validation
from perception.sources.folder import read_camera, read_yaml
from perception.sources.lens_file import PairLens, read_pair_lens
from perception.sources.recorded import ExportedPictures, RawFrame, SourceCapture, StereoVideo
from perception.sources.ros_log import RosLog

log = logging.getLogger(__name__)

FOLDER, LENS, BOARD = "frames", "lens.yaml", "board"


@spec
class RecordCamera:
    """Write frames of any camera, rectified, with the camera's numbers.

    Attributes:
        session: Folder to write into.
        capture: The pictures.
        lens: `camera.yaml` of rectified pictures; for raw pairs a ZED's factory `.conf`, or YAML of
            OpenCV's `stereoCalibrate` (`K1 D1 K2 D2 R T`); `board` makes that file of raw pairs that
            show `board`; `null` where the capture tells it.
        board: The printed board.
        every: One in so many frames is kept.
        count: Frames that are kept at most; `null` for all, which a device has no end of.
    """

    session: Session
    capture: SourceCapture | StereoVideo | ExportedPictures | RosLog
    lens: str | None
    board: Charuco
    every: Count
    count: Count | None

    def run(self) -> None:
        """Write `frames/<number>.*` and `frames/camera.yaml`, or `lens.yaml` with `lens: board`.

        Raises:
            FrameError: the camera file or a picture cannot be used, or there is none.
            StorageError: a file could not be written.
        """
        if self.lens == BOARD:
            self._calibrate_lens()
            return
        folder = self.session.folder / FOLDER
        kept = 0
        lens: PairLens | None = None
        for frame in self._read_kept():
            if lens is None:
                lens, extra = self._find_lens(frame)
                distortion = tuple(lens.distortion.ravel())
                place = (lens.matrix, lens.size_px, None, lens.baseline_m, distortion)
                dataset.write_camera(folder, *place, *extra)
            self._write(folder / f"{kept:05d}", frame, lens)
            kept += 1
        if not kept:
            raise FrameError("record_camera: the camera gave no picture")
        log.info("%d frames: %s", kept, folder)

    def _read_kept(self) -> Iterator[RawFrame]:
        """Yield one in `every` frames, `count` of them at most."""
        last = None if self.count is None else self.count * self.every
        return itertools.islice(self.capture.read(), 0, last, self.every)

    def _calibrate_lens(self) -> None:
        """Write the lens of both cameras, by the pairs that show the board."""
        tracker = self.board.build()
        pairs, num_frames, size_px = [], 0, (0, 0)
        for frame in self._read_kept():
            num_frames += 1
            if frame.right is None:
                raise FrameError(f"{frame.name}: lens=board needs pairs, got a single picture")
            size_px = frame.color.shape[1], frame.color.shape[0]
            pair = find_board_pair(tracker, frame.color, frame.right, validation.USUAL_GAMMA)
            if pair is not None:
                pairs.append(pair)
        content = calibrate_pair(pairs, size_px)
        path = self.session.folder / LENS
        write_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
        log.info(
            "%d of %d pairs show the board, corners miss by %.2f px: lens=%s",
            len(pairs), num_frames, content["error_px"], path,
        )  # fmt: skip

    def _find_lens(self, frame: RawFrame) -> tuple[PairLens, tuple[float | None, ...]]:
        """Return the lens of the pictures, and deviation of the disparity and tone curve if told."""
        size_px = frame.color.shape[1], frame.color.shape[0]
        if self.lens is None:
            if frame.lens is None:
                raise FrameError(
                    f"{frame.name}: the camera does not tell its lens; expected lens=camera.yaml, or "
                    "the factory file of the camera"
                )
            return frame.lens, ()
        path = Path(self.lens)
        content = None if path.suffix == ".conf" else read_yaml(path)
        if content is None or "K1" in content:
            return read_pair_lens(path, content, size_px), ()
        model = read_camera(path)
        where, picture = self.lens, frame.name
        validation.check_size(model.size_px, size_px[1], size_px[0], where, picture)
        validation.check_matrix_fits(model.matrix, size_px[1], size_px[0], where)
        bent = np.zeros(0) if model.distortion is None else model.distortion
        if frame.right is not None and (model.baseline_m is None or model.distortion is not None):
            raise FrameError(
                f"{self.lens}: a pair needs baseline_m and rectified pictures (dist 0); take the lens "
                "of both raw cameras (K1 D1 K2 D2 R T), or capture.layout=single"
            )
        lens = PairLens(model.matrix, bent, model.baseline_m, size_px, ())
        return lens, (model.disparity_std_px, model.gamma)

    def _write(self, stem: Path, frame: RawFrame, lens: PairLens) -> None:
        """Write a frame, rectified."""
        pictures = [frame.color]
        if frame.right is not None:
            what = "the right picture"
            validation.check_same_size(frame.color, frame.right, frame.name, what)
            pictures.append(frame.right)
        if frame.depth_m is not None:
            validation.check_same_size(frame.color, frame.depth_m, frame.name, "depth")
            if lens.maps:
                raise FrameError(
                    f"{frame.name}: depth belongs to the raw picture, which is rectified; record "
                    "rectified pictures, or without depth"
                )
        color, *right = lens.rectify(pictures, frame.name)
        dataset.write_frame(stem, color, frame.depth_m, right[0] if right else None)
