"""Pictures of measured and simulated motion: a row of windows for each joint, its commands below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brokk_rl.machine import Machine
from brokk_rl.plot import GREY, RED, add_legend, remove_frame

ROW_INCHES, WIDTH_INCHES = 2.75, 12.0
"""Height of a joint and width of the picture; chosen by hand."""
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


def draw_joint_track(
    axis: Axes, times: np.ndarray, q: np.ndarray, u: np.ndarray, machine: Machine, joint: int
) -> None:
    """Draw command (full is half the height), position and stops of one joint, each `(T,)`."""
    lower, upper, home = machine.lower[joint], machine.upper[joint], machine.home[joint]
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    # An exclusive joint never moves with others.
    color = RED if machine.is_exclusive[joint] else GREY
    label = "command (full: to the stops; red: never with others)"
    axis.fill_between(
        times, middle, middle + half * u, step="post", color=color, alpha=0.6, label=label
    )
    axis.plot(times, q, color="black", linewidth=1.1, label="position")
    axis.axhline(lower, color=RED, linewidth=0.9, linestyle="--", label="stop")
    axis.axhline(upper, color=RED, linewidth=0.9, linestyle="--")
    axis.set_ylim(middle - 1.12 * half, middle + 1.12 * half)
    labels = [f"{lower:.2f}", f"home {home:.2f}", f"{upper:.2f}"]
    axis.set_yticks([lower, home, upper], labels, fontsize=8)
    axis.set_ylabel(f"{machine.joint_names[joint]}\n{machine.joints[joint].unit}")
