"""`brokk mode=calibrate`: finds where the camera is in the base frame, how sure that is, and which poses are missing."""

from __future__ import annotations

import logging
from typing import Any, Protocol

import yaml
from rich.console import Console
from rich.table import Table

from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

FILE = "calibration.yaml"


class Calibration(Protocol):
    """A way to find the camera: a spec in `conf/calibration`."""

    def calibrate(self, machine: Machine) -> dict[str, Any]:
        """Returns what `calibration.yaml` says; see `perception.calibrate.extrinsics`."""
        ...


@spec
class Calibrate:
    """Finds the camera's place in the base frame.

    Attributes:
        session: Folder to write into.
        machine: Whose base it is.
        calibration: How.
    """

    session: Session
    machine: Machine
    calibration: Calibration

    def run(self) -> float:
        """Writes `calibration.yaml`, which sources of frames take as `base_from_camera`.

        Returns:
            How uncertain a point is at the distance of the work, by the calibration alone, m.

        Raises:
            FrameError: what was recorded does not tell where the camera is; the message says what
                is missing.
        """
        told = self.calibration.calibrate(self.machine)
        path = self.session.folder / FILE
        write_text(path, yaml.safe_dump(told, sort_keys=False, default_flow_style=None, width=132))
        _show(told)
        if "T_base_cam" in told:
            log.info("perception/source=zed source.base_from_camera=%s", path)
        return float(told["point_std_m"]["std_m"])


def _show(told: dict[str, Any]) -> None:
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    frame = "base" if "T_base_cam" in told else "link"
    place = ", ".join(f"{row[3]:.4f}" for row in told[f"T_{frame}_cam"][:3])
    table.add_row(f"camera in the {frame} frame", f"({place}) m")
    work = told["point_std_m"]
    table.add_row(f"uncertainty at {work['at_m']:g} m", f"±{1000 * work['std_m']:.1f} mm")
    residual = told["residual"]
    turn = "" if residual["rms_rad"] is None else f", {residual['rms_rad']:.4f} rad"
    table.add_row("residual", f"{1000 * residual['rms_m']:.1f} mm{turn}")
    table.add_row("poses", f"{told['num_used']} used, {told['num_left_out']} left out")
    for one in told["poses"]:
        if one["left_out"]:
            table.add_row("  left out", f"{one['name']}: {one['left_out']}")
    for name, zero in (told.get("joint_zeros") or {}).items():
        if abs(zero["mean"]) > 2 * zero["std"]:
            table.add_row(f"zero of {name}", f"{zero['mean']:+.4f} ± {zero['std']:.4f} rad")
    if clock := told.get("clock"):
        trust = "" if clock["trusted"] else ", too little motion to believe it"
        table.add_row(
            "camera's clock",
            f"{clock['offset_s']:+.3f} s (correlation {clock['correlation']:.2f}{trust})",
        )
    for one in told["missing"]:
        table.add_row("missing", one)
    Console().print(table)
