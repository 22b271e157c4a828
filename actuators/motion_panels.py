"""Pictures of measured and simulated motion: a row of windows for each joint, its commands below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brokk_rl.machine import Machine
from brokk_rl.plot import GREY, RED, add_legend, draw_grid, make_figure, remove_frame

ROW_INCHES, WIDTH_INCHES = 2.75, 12.0
"""Height of a joint and width of the picture; chosen by hand."""
TRACK_INCHES, TRACK_WIDTH_INCHES = 1.7, 15.0
"""The same of the tracks over a whole recording; chosen by hand."""
LETTER = 0.0045
"""Width of a letter of a name, as a part of the time axis."""
LEAST_SPAN = 0.02
"""Least height of an axis, of the joint's travel. Chosen by hand: less is noise of the encoder."""


@dataclass(frozen=True)
class MotionWindow:
    """A window of one joint.

    Attributes:
        title: Text above.
        t_s: Time, `(T,)`.
        measured: Measured positions, `(T,)`.
        u: Commands, `(T,)`.
        paths: Time, positions and style of each simulated path, the one in front last.
        foremost: Positions that the axis shows whole beside the measured ones; others may leave it.
    """

    title: str
    t_s: np.ndarray
    measured: np.ndarray
    u: np.ndarray
    paths: Sequence[tuple[np.ndarray, np.ndarray, dict[str, Any]]]
    foremost: np.ndarray


def draw_motion_panels(
    rows: Mapping[int, Sequence[MotionWindow]], machine: Machine, widths: Sequence[float]
) -> Figure:
    """Draw the windows of some joints, by number of the joint; `widths`: of the columns, relative."""
    # Laid out by hand, which is much faster than any layout engine with so many axes.
    height = ROW_INCHES * len(rows) + 0.6
    figure = Figure(figsize=(WIDTH_INCHES, height))
    grid = figure.add_gridspec(
        len(rows), len(widths), left=0.075, right=0.99, bottom=0.5 / height, top=1.0 - 0.65 / height, wspace=0.17,
        hspace=0.3, width_ratios=widths,
    )  # fmt: skip
    for line, (number, windows) in enumerate(rows.items()):
        joint, lower, upper = machine.joints[number], machine.lower[number], machine.upper[number]
        for column, window in enumerate(windows):
            cell = grid[line, column].subgridspec(2, 1, height_ratios=[3.2, 1.0], hspace=0.1)
            above = figure.add_subplot(cell[0])
            below = figure.add_subplot(cell[1], sharex=above)
            above.plot(window.t_s, window.measured, color="black", lw=1.7, label="measured")
            for t_s, path, style in window.paths:
                above.plot(t_s, path, **style)
            shown = np.concatenate([window.measured, window.foremost])
            middle = 0.5 * float(np.nanmax(shown) + np.nanmin(shown))
            half = max(
                0.62 * float(np.nanmax(shown) - np.nanmin(shown)),
                0.5 * LEAST_SPAN * (upper - lower),
            )
            above.set_ylim(middle - half, middle + half)
            for stop in (lower, upper):
                if abs(stop - middle) < half:
                    above.axhline(stop, color=RED, lw=1.0, ls=":")
            above.set_title(window.title, fontsize=8.5, loc="left")
            above.tick_params(labelbottom=False)
            below.fill_between(window.t_s, window.u, step="post", color=GREY, alpha=0.5, lw=0)
            below.axhline(0.0, color=GREY, lw=0.5)
            below.set(ylim=(-1.05, 1.05), yticks=[-1, 0, 1], xlim=(window.t_s[0], window.t_s[-1]))
            if column == 0:
                above.set_ylabel(f"{joint.name} [{joint.unit}]")
                below.set_ylabel("u", rotation=0, va="center")
            if line == len(rows) - 1:
                below.set_xlabel("time [s]")
            for axis in (above, below):
                remove_frame(axis)
    add_legend(figure, figure.axes[0])
    return figure


@dataclass(frozen=True)
class Shade:
    """A stretch of time that is shaded.

    Attributes:
        joint: Number of the joint; `None` for all.
        begin_s: Begin.
        end_s: End.
        color: Color of it.
        name: Text above the first joint, where it finds room.
    """

    joint: int | None
    begin_s: float
    end_s: float
    color: str
    name: str = ""


def draw_joint_tracks(
    machine: Machine, t_s: np.ndarray, q: np.ndarray, u: np.ndarray, shades: Sequence[Shade]
) -> tuple[Figure, list[Axes]]:
    """Draw command (full is half the height), position and stops of each joint over time.

    Args:
        machine: Limits and homes.
        t_s: Time, `(T,)`; NaN where it is not known.
        q: Positions, `(T, J)`.
        u: Commands, `(T, J)`.
        shades: Shaded stretches.
    """
    figure = make_figure(TRACK_WIDTH_INCHES, 1.1 + TRACK_INCHES * machine.num_joints)
    axes = [*figure.subplots(machine.num_joints, 1, sharex=True, squeeze=False)[:, 0]]
    for j, axis in enumerate(axes):
        lower, upper, home = machine.lower[j], machine.upper[j], machine.home[j]
        middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        # An exclusive joint never moves with others.
        color = RED if machine.is_exclusive[j] else GREY
        label = "command (full: to the stops; red: never with others)"
        command = middle + half * u[:, j]
        axis.fill_between(t_s, middle, command, step="post", color=color, alpha=0.6, label=label)
        axis.plot(t_s, q[:, j], color="black", linewidth=1.1, label="position")
        axis.axhline(lower, color=RED, linewidth=0.9, linestyle="--", label="stop")
        axis.axhline(upper, color=RED, linewidth=0.9, linestyle="--")
        axis.set_ylim(middle - 1.12 * half, middle + 1.12 * half)
        labels = [f"{lower:.2f}", f"home {home:.2f}", f"{upper:.2f}"]
        axis.set_yticks([lower, home, upper], labels, fontsize=8)
        axis.set_ylabel(f"{machine.joint_names[j]}\n{machine.joints[j].unit}")
        for one in shades:
            if one.joint in (None, j):
                axis.axvspan(one.begin_s, one.end_s, color=one.color, alpha=0.3, linewidth=0)
        draw_grid(axis, "x")
    begin_s, span_s = np.nanmin(t_s), max(np.nanmax(t_s) - np.nanmin(t_s), 1e-9)
    for one in shades:
        if one.end_s - one.begin_s > LETTER * span_s * len(one.name):
            place = 0.5 * (one.begin_s + one.end_s), 1.02
            form: Any = {"xycoords": ("data", "axes fraction"), "ha": "center", "fontsize": 8}
            axes[0].annotate(one.name, place, **form)
    axes[-1].set_xlabel("time, s")
    axes[-1].set_xlim(begin_s, begin_s + span_s)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=3, frameon=False, fontsize=9)
    return figure, axes
