"""Pictures of recordings and their findings."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from actuators.motion_panels import draw_joint_track
from actuators.recordings.inspection import Inspection
from brokk_rl.machine import Machine
from brokk_rl.plot import make_figure, save_figure
from brokk_rl.record import Breach, Recording

FINDING, BREACH = "#e69f00", "#b00020"
THINNEST = 0.002
"""A finding is drawn at least this wide, as a part of the picture, so that a single row can be
seen."""


def draw_recording(
    path: Path,
    recording: Recording,
    machine: Machine,
    inspection: Inspection,
    breaches: Sequence[Breach],
) -> None:
    """Draw commands, positions, findings (shaded) and breaches (lines) as PNG."""
    count = machine.num_joints
    figure = make_figure(14, 1.1 + 1.7 * count)
    axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    t_s = recording.t_s
    begin_s, span_s = float(np.nanmin(t_s)), max(float(np.nanmax(t_s) - np.nanmin(t_s)), 1e-9)
    for j, (joint, axis) in enumerate(zip(machine.joints, axes, strict=True)):
        draw_joint_track(axis, t_s, recording.q[:, j], recording.u[:, j], machine, j)
        for finding in inspection.findings:
            if finding.joint in (joint.name, None):
                width_s = max(finding.duration_s, THINNEST * span_s)
                axis.axvspan(
                    finding.t_s, finding.t_s + width_s, color=FINDING, alpha=0.35, linewidth=0
                )
        own = {f"u_{joint.name}", f"q_{joint.name}_{joint.unit}", "t_s"}
        for breach in breaches:
            if breach.row is not None and breach.column in own and np.isfinite(t_s[breach.row]):
                axis.axvline(t_s[breach.row], color=BREACH, linewidth=1.0)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(begin_s, begin_s + span_s)
    name = recording.path.name if recording.path else "recording"
    title = "measured position (black), command (filled), findings (shaded), breaches (lines)"
    figure.suptitle(f"{name}: {title}", fontsize=11)
    save_figure(figure, path)
