"""Pictures of an identification: predictions, and error over horizon."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, NullFormatter

from actuators.identify.scores import TAILS, FreeRunScores
from actuators.recordings.split import COMMANDED
from brokk_rl.plot import (
    BLUE,
    GREY,
    ORANGE,
    OTHERS,
    RED,
    add_legend,
    draw_grid,
    make_joint_panels,
    remove_frame,
)

COLOURS = {"hold": GREY, "arx": ORANGE}


def assign_colours(names: Sequence[str], model: str) -> dict[str, str]:
    """Return the colour of each model: the same in all pictures."""
    others = iter(OTHERS * len(names))
    return {name: BLUE if name == model else COLOURS.get(name) or next(others) for name in names}


def draw_prediction(scores: FreeRunScores, model: str) -> Figure:
    """Draw measured and predicted positions over commands: three windows per joint.

    Typical: the window of median error among those in which the joint is commanded; liveliest: of
    the longest way; worst: of the largest error of the model (the paper's figure 2).
    """
    cut, machine = scores.cut, scores.machine
    t_s = machine.period_s * np.arange(1, cut.measured.shape[1] + 1)
    # Inches. Laid out by hand, which is much faster than any layout engine with so many axes.
    height = 2.75 * machine.num_joints + 0.5
    figure = Figure(figsize=(12.0, height))
    rows = figure.add_gridspec(
        machine.num_joints, 3, left=0.075, right=0.99, bottom=0.45 / height, top=1.0 - 0.6 / height,
        wspace=0.17, hspace=0.28,
    )  # fmt: skip
    for j, joint in enumerate(machine.joints):
        for column, (title, window) in enumerate(_select_windows(scores, model, j).items()):
            grid = rows[j, column].subgridspec(2, 1, height_ratios=[3.2, 1.0], hspace=0.12)
            above = figure.add_subplot(grid[0])
            below = figure.add_subplot(grid[1], sharex=above)
            _draw_paths(above, scores, model, window, j)
            run = str(cut.run[window]).rsplit("/", 1)[-1].removesuffix(".parquet")
            above.set_title(f"{title}: {run}", fontsize=8.5, loc="left")
            above.tick_params(labelbottom=False)
            u = cut.u[window, cut.num_before - 1 :, j]
            below.fill_between(t_s - machine.period_s, u, step="post", color=GREY, alpha=0.5, lw=0)
            below.axhline(0.0, color=GREY, lw=0.5)
            below.set(ylim=(-1.05, 1.05), yticks=[-1, 0, 1], xlim=(0.0, t_s[-1]))
            if column == 0:
                above.set_ylabel(f"{joint.name} [{joint.unit}]")
                below.set_ylabel("u", rotation=0, va="center")
            if j == machine.num_joints - 1:
                below.set_xlabel("time of the free run [s]")
            remove_frame(above)
            remove_frame(below)
    add_legend(figure, figure.axes[0])
    return figure


def _draw_paths(axis: Axes, scores: FreeRunScores, model: str, window: int, joint: int) -> None:
    """Draw the paths of a window; the axis is bound by measurement and model, whatever rivals do."""
    machine, measured = scores.machine, scores.cut.measured[window, :, joint]
    t_s = machine.period_s * np.arange(1, len(measured) + 1)
    given = np.isfinite(measured)
    colour = assign_colours(list(scores.predicted), model)
    axis.plot(t_s, measured, color="black", lw=1.8, label="measured", zorder=3)
    for name, path in scores.predicted.items():
        shown = np.where(given, path[window, :, joint], np.nan)
        is_mine = name == model
        style = {"lw": 1.6, "zorder": 4} if is_mine else {"lw": 1.0, "ls": "--"}
        axis.plot(t_s, shown, color=colour[name], label=name, **style)
    shown = np.concatenate([measured[given], scores.predicted[model][window, : given.sum(), joint]])
    lower, upper = float(machine.lower[joint]), float(machine.upper[joint])
    middle = (shown.max() + shown.min()) / 2.0
    half = max(float(np.ptp(shown)) * 0.62, 0.01 * (upper - lower))
    axis.set_ylim(middle - half, middle + half)
    for limit in (lower, upper):
        if abs(limit - middle) < half:
            axis.axhline(limit, color=RED, lw=1.0, ls=":")


def draw_error_over_horizon(scores: FreeRunScores, model: str) -> Figure:
    """Draw the error of all models over the time of the free run, with 95 % bands."""
    machine = scores.machine
    figure, axes = make_joint_panels(machine, "xy")
    colour = assign_colours(list(scores.predicted), model)
    t_s = machine.period_s * np.arange(1, scores.cut.measured.shape[1] + 1)
    for j, (axis, joint) in enumerate(zip(axes, machine.joints, strict=True)):
        for name in sorted(scores.predicted, key=lambda name: name == model):
            rmse, again = (100.0 * one[..., j] / scores.travel[j] for one in scores.rmse(name))
            axis.plot(t_s, rmse, color=colour[name], lw=2.0 if name == model else 1.3, label=name)
            told = np.isfinite(again).any(0)
            if told.any():
                low, high = np.nanpercentile(again[:, told], TAILS, axis=0)
                axis.fill_between(t_s[told], low, high, color=colour[name], alpha=0.2, lw=0)
        axis.set_title(joint.name, loc="left", fontsize=10)
        _set_log_scale(axis, "x")
        _set_log_scale(axis, "y")
        axis.set_xticks([t for t in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0) if t <= t_s[-1]])
        axis.set_xlim(t_s[0], t_s[-1])
        draw_grid(axis)
    figure.supxlabel("time of the free run [s]; the left end is the one-step error", fontsize=10)
    figure.supylabel("RMSE [% of travel]", fontsize=10)
    add_legend(figure, axes[0])
    return figure


def _set_log_scale(axis: Axes, direction: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with plain numbers at its ticks."""
    scale = axis.xaxis if direction == "x" else axis.yaxis
    axis.set(**{f"{direction}scale": "log"})
    scale.set_major_formatter("{x:g}")
    minor = NullFormatter() if direction == "x" else LogFormatter(minor_thresholds=(1.0, 0.4))
    scale.set_minor_formatter(minor)


def _select_windows(scores: FreeRunScores, model: str, joint: int) -> dict[str, int]:
    measured = scores.cut.measured[..., joint]
    u = scores.cut.u[:, scores.cut.num_before - 1 :, joint]
    length = np.isfinite(measured).sum(1)
    whole = length == length.max()
    moving = whole & (np.abs(u) > COMMANDED).any(1)
    among = np.flatnonzero(moving if moving.any() else whole)
    error = np.sqrt(np.nanmean(scores.error[model][among, :, joint] ** 2, 1))
    way = np.nansum(np.abs(np.diff(measured[among], axis=1)), 1)
    typical = np.argsort(error, kind="stable")[len(error) // 2]
    return {
        "typical": int(among[typical]),
        "liveliest": int(among[way.argmax()]),
        "worst": int(among[error.argmax()]),
    }
