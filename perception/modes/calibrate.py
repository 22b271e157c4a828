"""`brokk mode=calibrate`: estimates the camera's pose in the base frame and its uncertainty."""

from __future__ import annotations

import logging
from typing import Any

import yaml

from brokk_rl.console_table import print_table
from brokk_rl.errors import FrameError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_text
from brokk_rl.spec import spec
from perception.calibrate.board import BoardCalibration
from perception.calibrate.evaluation import GOOD

log = logging.getLogger(__name__)

FILE = "calibration.yaml"
ZERO_SIGMAS = 2.0
"""A joint's zero is shown where it is this many standard deviations off."""


@spec
class Calibrate:
    """Estimates the camera's pose in the base frame.

    Attributes:
        session: Folder to write into.
        machine: Whose base it is.
        calibration: The frames of a board, and the joint positions there.
    """

    session: Session
    machine: Machine
    calibration: BoardCalibration

    def run(self) -> float:
        """Write `calibration.yaml`, which sources of frames take as `base_from_camera`.

        Returns:
            Standard deviation of a point at the working distance, by the calibration alone, m.

        Raises:
            FrameError: the recorded data do not determine the camera, or the verdict is not `good`;
                the message says why. The file is written with its verdict.
            ConfigError, RecordingError: an input cannot be read.
            StorageError: the file cannot be written.
        """
        content = self.calibration.calibrate(self.machine)
        path = self.session.folder / FILE
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=132)
        write_text(path, text)
        _show(content)
        verdict = content["verdict"]
        if verdict["status"] != GOOD:
            raise FrameError(
                f"calibration: {verdict['status']}: {'; '.join(verdict['reasons'])}. "
                f"{path} holds the residuals"
            )
        log.info("perception/source=zed source.base_from_camera=%s", path)
        return float(content["point_std_m"]["std_m"])


def _show(content: dict[str, Any]) -> None:
    rows: list[tuple[str, str]] = []
    place = ", ".join(f"{row[3]:.4f}" for row in content["T_base_cam"][:3])
    rows.append(("verdict", content["verdict"]["status"]))
    rows.append(("camera in the base frame", f"({place}) m"))
    work = content["point_std_m"]
    rows.append((f"uncertainty at {work['at_m']:g} m", f"±{1000 * work['std_m']:.1f} mm"))
    residual = content["residual"]
    rows.append(("residual", f"{1000 * residual['rms_m']:.1f} mm, {residual['rms_rad']:.4f} rad"))
    rows.append(("poses", f"{content['num_used']} used, {content['num_left_out']} left out"))
    for one in content["poses"]:
        if one["left_out"]:
            rows.append(("  left out", f"{one['name']}: {one['left_out']}"))
    for name, zero in (content.get("joint_zeros") or {}).items():
        if abs(zero["mean"]) > ZERO_SIGMAS * zero["std"]:
            rows.append((f"zero of {name}", f"{zero['mean']:+.4f} ± {zero['std']:.4f} rad"))
    if disparity := content.get("disparity"):
        error_px = disparity["error_px"][0]
        rows.append(("error of the disparity", f"{error_px:+.3f} ± {disparity['std_px']:.3f} px"))
    if clock := content.get("clock"):
        trust = "" if clock["trusted"] else ", not trusted: too little motion"
        offset = f"{clock['offset_s']:+.3f} s (correlation {clock['correlation']:.2f}{trust})"
        rows.append(("camera's clock", offset))
    for one in content["missing"]:
        rows.append(("missing", one))
    print_table((), rows)
