"""Pictures of recordings and their findings."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

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
        commands = axis.twinx()
        axis.set_zorder(commands.get_zorder() + 1)
        axis.patch.set_visible(False)
        commands.step(t_s, recording.u[:, j], where="post", color="0.62", linewidth=0.8)
        commands.set_ylim(-1.15, 1.15)
        commands.set_yticks([-1, 0, 1])
        commands.tick_params(labelsize=8, colors="0.45")
        axis.plot(t_s, recording.q[:, j], color="black", linewidth=1.1)
        axis.set_ylabel(f"{joint.name} [{joint.unit}]")
        low, high = axis.get_ylim()
        for limit in (joint.lower.value, joint.upper.value):
            if low - 0.2 * (high - low) < limit < high + 0.2 * (high - low):
                axis.axhline(limit, color="0.3", linewidth=0.7, linestyle=":")
        for finding in inspection.findings:
            if finding.joint in (joint.name, None):
                width_s = max(finding.duration_s, THINNEST * span_s)
                commands.axvspan(
                    finding.t_s, finding.t_s + width_s, color=FINDING, alpha=0.35, linewidth=0
                )
        own = {f"u_{joint.name}", f"q_{joint.name}_{joint.unit}", "t_s"}
        for breach in breaches:
            if breach.row is not None and breach.column in own and np.isfinite(t_s[breach.row]):
                commands.axvline(t_s[breach.row], color=BREACH, linewidth=1.0)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(begin_s, begin_s + span_s)
    name = recording.path.name if recording.path else "recording"
    title = (
        "measured position (black), command in [-1, 1] (grey), findings (shaded), breaches (red)"
    )
    figure.suptitle(f"{name}: {title}", fontsize=11)
    save_figure(figure, path)
