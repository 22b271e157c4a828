"""A plan as it would be played: its picture, and the segments that find no time."""

from collections.abc import Iterable
from itertools import cycle, pairwise
from pathlib import Path

import numpy as np

from actuators.excite.player import DONE, INSIDE, PLAY, Sample, measure_tool_speed
from actuators.excite.schedule import ExcitationPlan
from actuators.motion_panels import Shade, draw_joint_tracks
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, GREY, ORANGE, OTHERS, save_figure

CUT = 0.2
"""Part of a program that may be missing at the end of a run without a warning."""


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
    """Draw the first run as PNG: segments, commands and predicted positions.

    Args:
        plan: Gives names.
        track: The prediction.
        machine: Limits.
        path: Where to write.
    """
    shades = _list_shades(plan, track)
    q, u = track.q[:, 0], track.u[:, 0]
    figure, _ = draw_joint_tracks(machine, track.t_s, q, u, shades)
    title = f"{machine.name}: {', '.join(plan.names)}; {plan.run_s / 60.0:g} minutes"
    if len(plan.runs) > 1:
        title += f", the first of {len(plan.runs)} runs, each with draws of its own"
    title += ". Predicted by a nominal machine"
    if machine.has_bodies:
        speed_m_s = measure_tool_speed(machine, q, np.gradient(q, machine.period_s, axis=0))
        title += f", tool at {speed_m_s.max():.2f} m/s at most"
    figure.suptitle(f"{title}.", x=0.01, ha="left", fontsize=12)
    save_figure(figure, path)


def _list_shades(plan: ExcitationPlan, track: PlanTrack) -> list[Shade]:
    """Return the segments of the first run by the colours of their excitations; ways between them are white."""
    colors = dict(zip(plan.names, cycle((BLUE, ORANGE, *OTHERS))))
    phase, segment, last = track.phase[:, 0], track.segment[:, 0], len(track.t_s) - 1
    changes = np.diff(segment * 2 + (phase >= PLAY))  # ways and programs
    found = []
    for begin, end in pairwise([0, *(np.flatnonzero(changes) + 1).tolist(), len(phase)]):
        if PLAY <= phase[begin] < DONE:
            name = plan.runs[0][segment[begin]].name
            color = colors.get(name.split("_")[0], GREY)
            times_s = (float(track.t_s[begin]), float(track.t_s[min(end, last)]))
            found.append(Shade(None, *times_s, color, name.replace("_", " ")))
    return found
