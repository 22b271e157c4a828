"""Figures of a diagnosis: black is the measurement, red the simulator as it was, blue the one with the effects."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from actuators.motion_panels import MotionWindow, draw_motion_panels
from actuators.recordings.recording_checks import name_recording
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, RED
from diagnosis.answer import Outcome

MAX_JOINTS = 3
"""Joints whose paths are drawn."""


def draw_paths(outcome: Outcome, machine: Machine) -> Figure:
    """Draw measured and simulated positions of the joints with the largest gaps."""
    before = outcome.before
    error = np.sqrt(np.nanmean(before.error**2, 1))  # (W, J)
    joints = outcome.answer.where.joints
    foremost = [-joints[name]["share"] if joints else 0.0 for name in machine.joint_names]
    rows = {}
    for joint in np.argsort(foremost, kind="stable")[:MAX_JOINTS].tolist():
        worst = np.argsort(-np.nan_to_num(error[:, joint]))
        whole = np.flatnonzero(before.source == before.source[worst[0]])
        rows[joint] = [
            _show_windows(outcome, joint, "a whole recording", whole),
            _show_windows(outcome, joint, "worst window", worst[:1]),
        ]
    return draw_motion_panels(rows, machine, (1.9, 1.0))


def _show_windows(outcome: Outcome, joint: int, title: str, windows: np.ndarray) -> MotionWindow:
    """Return some windows of one recording on one time axis."""
    before = outcome.before
    recording = before.recordings[int(before.source[windows[0]])]
    steps, count = before.simulated.shape[1], recording.num_samples
    first = int(before.row[windows].min())
    last = min(int(before.row[windows].max()) + steps, count)
    paths = []
    for runs, colour, label in (
        (before, RED, "simulated before"),
        (outcome.after, BLUE, "simulated after"),
    ):
        if runs is None:
            continue
        for number, window in enumerate(windows):
            begin = int(before.row[window])
            end = min(begin + steps, count)
            style = {"color": colour, "lw": 1.3, "label": None if number else label}
            paths.append(
                (recording.t_s[begin:end], runs.simulated[window, : end - begin, joint], style)
            )
    shown = slice(first, last)
    return MotionWindow(
        title=f"{title}: {name_recording(recording)}",
        t_s=recording.t_s[shown],
        measured=recording.q[shown, joint],
        u=recording.u[shown, joint],
        paths=paths,
        foremost=np.concatenate([path for _, path, _ in paths]),
    )
