"""A plan as it would be played: its picture, and the segments that find no time."""

from collections.abc import Iterable, Sequence
from itertools import cycle, pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from actuators.excite.player import DONE, INSIDE, PLAY, Sample, predict_tool_speed
from actuators.excite.schedule import ExcitationPlan
from actuators.motion_panels import draw_joint_track
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, GREY, ORANGE, OTHERS, draw_grid, make_figure, save_figure

INCHES_A_ROW, STRIP_INCHES, WIDTH_INCHES = 1.65, 1.0, 17.0
"""Height of a joint and of the strip of segments, and width of the picture; chosen by hand."""
CUT = 0.2
"""Part of a program that may be missing at the end of a run without a warning."""
LETTER = 0.0075
"""Width of a letter of a segment's name, as a part of the time axis."""


class PlanTrack:
    """All samples of a run as arrays.

    Attributes:
        t_s: Time, `(T,)`.
        q: Positions, `(T, N, J)`.
        u: Commands, `(T, N, J)`.
        phase: Phase of the player, `APPROACH`, `REST`, …, `(T, N)`.
        segment: Number of the segment, `(T, N)`.
        extra: Further measurements of the link, each `(N, T)`.
    """

    def __init__(self, samples: Iterable[Sample]) -> None:
        kept = list(samples)
        self.t_s = np.array([sample.t_s for sample in kept])
        self.q = np.stack([sample.q for sample in kept])
        self.u = np.stack([sample.u for sample in kept])
        self.phase = np.stack([sample.phase for sample in kept])
        self.segment = np.stack([sample.segment for sample in kept])
        self.extra: dict[str, np.ndarray] = {}
        for name in kept[0].extra:
            self.extra[name] = np.stack([sample.extra[name] for sample in kept], 1)


def list_cut_segments(plan: ExcitationPlan, track: PlanTrack) -> list[str]:
    """Return the names of the segments of which more than `CUT` finds no time in some of the runs."""
    found = set()
    for n, segments in enumerate(plan.runs):
        inside = INSIDE[track.phase[:, n]]
        for i, segment in enumerate(segments):
            num_played = np.count_nonzero((track.segment[:, n] == i) & inside)
            if num_played < (1.0 - CUT) * len(segment.u):
                found.add(segment.name)
    return sorted(found)


def draw_plan(plan: ExcitationPlan, track: PlanTrack, machine: Machine, path: Path) -> None:
    """Draw the first run as PNG: segments, commands, predicted positions and, where the geometry is known, tool speed.

    Args:
        plan: Gives names.
        track: The prediction.
        machine: Limits.
        path: Where to write.
    """
    tool_speed_m_s = predict_tool_speed(machine, track.q[:, 0])
    rows = machine.num_joints + (tool_speed_m_s is not None)
    whole = make_figure(WIDTH_INCHES, STRIP_INCHES + INCHES_A_ROW * rows)
    ratios = [0.55, *[1.0] * rows]
    axes = whole.subplots(rows + 1, 1, sharex=True, height_ratios=ratios)
    minutes = track.t_s / 60.0
    for j, axis in enumerate(axes[1 : machine.num_joints + 1]):
        draw_joint_track(axis, minutes, track.q[:, 0, j], track.u[:, 0, j], machine, j)
    if tool_speed_m_s is not None:
        axes[-1].fill_between(minutes, tool_speed_m_s, color=GREY, linewidth=0)
        axes[-1].set_ylabel("tool\nm/s")
    _draw_segments(axes, plan, track, minutes)
    for axis in axes[1:]:
        draw_grid(axis, "x")
    axes[-1].set_xlabel("time, minutes")
    axes[0].set_xlim(0.0, max(plan.run_s / 60.0, float(minutes[-1])))
    title = f"{machine.name}: {', '.join(plan.names)}; {plan.run_s / 60.0:g} minutes"
    if len(plan.runs) > 1:
        title += f", the first of {len(plan.runs)} runs, each with draws of its own"
    whole.suptitle(f"{title}. Predicted by a nominal machine.", x=0.01, ha="left", fontsize=12)
    handles, labels = axes[1].get_legend_handles_labels()
    whole.legend(handles, labels, loc="outside lower left", ncols=12, frameon=False, fontsize=9)
    save_figure(whole, path)


def _draw_segments(
    axes: Sequence[Axes], plan: ExcitationPlan, track: PlanTrack, minutes: np.ndarray
) -> None:
    """Draw the strip of segments on top, with the names that find room, and their colours below."""
    colors = dict(zip(plan.names, cycle((BLUE, ORANGE, *OTHERS))))
    phase, segment = track.phase[:, 0], track.segment[:, 0]
    changes = np.diff(segment * 2 + (phase >= PLAY))  # ways and programs
    for begin, end in pairwise([0, *(np.flatnonzero(changes) + 1).tolist(), len(phase)]):
        if phase[begin] == DONE:
            continue
        name = plan.runs[0][segment[begin]].name
        color = colors.get(name.split("_")[0], GREY)
        if phase[begin] < PLAY:
            name, color = "", "white"
        start, stop = minutes[begin], minutes[min(end, len(minutes) - 1)]
        for axis, alpha in zip(axes, (0.9, *[0.13] * (len(axes) - 1)), strict=True):
            axis.axvspan(start, stop, color=color, alpha=alpha, linewidth=0)
        if stop - start > LETTER * minutes[-1] * len(name):
            place = 0.5 * (start + stop), 0.5
            axes[0].annotate(name.replace("_", " "), place, ha="center", va="center", fontsize=8)
    axes[0].set_yticks([])
    axes[0].set_ylim(0.0, 1.0)
    axes[0].spines[:].set_visible(False)
