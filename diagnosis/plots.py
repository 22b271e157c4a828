"""Figures of a diagnosis.

Black is the measurement, red the simulator as it was, blue the simulator with the effects, grey the
floor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from actuators.recordings.recording_checks import name_recording
from actuators.recordings.split import COMMANDED
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, GREY, RED, add_legend, remove_frame
from diagnosis.answer import Outcome

BEFORE, AFTER, FLOOR = RED, BLUE, GREY
IDLE = "#c3cbd3"
MAX_JOINTS = 3
"""Joints whose paths are drawn."""


def draw_paths(outcome: Outcome, machine: Machine) -> Figure:
    """Draw measured and simulated positions of the joints with the largest gaps."""
    before = outcome.before
    error = np.sqrt(np.nanmean(before.error**2, 1))  # (W, J)
    located = outcome.answer.where.joints
    foremost = [-located[name].share if name in located else 0.0 for name in machine.joint_names]
    shown = np.argsort(foremost, kind="stable")[: min(MAX_JOINTS, machine.num_joints)]
    height = 2.6 * len(shown) + 0.6
    figure = Figure(figsize=(12.0, height))
    rows = figure.add_gridspec(
        len(shown), 3, left=0.075, right=0.99, bottom=0.5 / height, top=1.0 - 0.65 / height, wspace=0.16, hspace=0.34,
        width_ratios=[1.9, 1.0, 1.0],
    )  # fmt: skip
    for line, joint in enumerate(shown):
        worst = np.argsort(-np.nan_to_num(error[:, joint]))
        second = next(
            (w for w in worst[1:] if before.source[w] != before.source[worst[0]]),
            worst[min(1, len(worst) - 1)],
        )
        whole = np.flatnonzero(before.source == before.source[worst[0]])
        for column, (title, windows) in enumerate(
            (
                ("a whole recording", whole),
                ("worst window", worst[:1]),
                ("elsewhere", np.array([second])),
            )
        ):
            grid = rows[line, column].subgridspec(2, 1, height_ratios=[3.2, 1.0], hspace=0.1)
            above = figure.add_subplot(grid[0])
            below = figure.add_subplot(grid[1], sharex=above)
            _draw_path(above, below, outcome, windows, int(joint), machine)
            above.set_title(
                f"{title}: {name_recording(before.recordings[int(before.source[windows[0]])])}",
                fontsize=8.5,
                loc="left",
            )
            if column == 0:
                above.set_ylabel(f"{machine.joints[joint].name} [{machine.joints[joint].unit}]")
                below.set_ylabel("u", rotation=0, va="center")
            if line == len(shown) - 1:
                below.set_xlabel("time [s]")
    add_legend(figure, figure.axes[0])
    return figure


def _draw_path(
    above: Axes,
    below: Axes,
    outcome: Outcome,
    windows: Sequence[int] | np.ndarray,
    joint: int,
    machine: Machine,
) -> None:
    before, after = outcome.before, outcome.after
    recording = before.recordings[int(before.source[windows[0]])]
    steps = before.simulated.shape[1]
    first, last = (
        int(before.row[windows].min()),
        int(min(before.row[windows].max() + steps, recording.num_samples)),
    )
    t_s = recording.t_s[first:last]
    above.plot(t_s, recording.q[first:last, joint], color="black", lw=1.6, label="measured")
    for runs, colour, label in (
        (before, BEFORE, "simulated before"),
        (after, AFTER, "simulated after"),
    ):
        if runs is None:
            continue
        for number, window in enumerate(windows):
            begin = int(before.row[window])
            end = min(begin + steps, recording.num_samples)
            above.plot(
                recording.t_s[begin:end],
                runs.simulated[window, : end - begin, joint],
                color=colour,
                lw=1.3,
                label=None if number else label,
            )
    if len(windows) > 1:
        for window in windows:
            above.axvline(float(recording.t_s[before.row[window]]), color="#bbbbbb", lw=0.4)
    u = recording.u[first:last, joint]
    below.fill_between(
        t_s,
        u,
        step="post",
        color="#555555",
        alpha=0.4 if (np.abs(u) > COMMANDED).any() else 0.1,
        lw=0,
    )
    below.set_ylim(-1.05, 1.05)
    below.set_yticks([-1, 0, 1])
    below.axhline(0.0, color="#555555", lw=0.5)
    above.tick_params(labelbottom=False)
    above.set_xlim(t_s[0], t_s[-1])
    span = machine.upper[joint] - machine.lower[joint]
    low, high = above.get_ylim()
    if high - low < 0.02 * span:
        above.set_ylim((low + high - 0.02 * span) / 2.0, (low + high + 0.02 * span) / 2.0)
    for axis in (above, below):
        remove_frame(axis)
