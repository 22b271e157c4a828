"""Pictures of an identification: predictions, and error over horizon."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, NullFormatter

from actuators.identify.scores import TAILS, FreeRunScores
from actuators.motion_panels import MotionWindow, draw_motion_panels
from actuators.recordings.split import COMMANDED
from brokk_rl.plot import BLUE, GREY, ORANGE, OTHERS, add_legend, draw_grid, make_joint_panels

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
    machine = scores.machine
    rows = {}
    for joint in range(machine.num_joints):
        chosen = _select_windows(scores, model, joint)
        rows[joint] = [_show_window(scores, model, joint, *one) for one in chosen.items()]
    return draw_motion_panels(rows, machine, (1.0, 1.0, 1.0))


def _show_window(
    scores: FreeRunScores, model: str, joint: int, title: str, window: int
) -> MotionWindow:
    cut = scores.cut
    measured = cut.measured[window, :, joint]
    given = np.isfinite(measured)
    t_s = scores.machine.period_s * np.arange(1, len(measured) + 1)[given]
    colour = assign_colours(list(scores.predicted), model)
    paths = []
    for name in sorted(scores.predicted, key=lambda name: name == model):
        style = {"color": colour[name], "label": name, "lw": 1.0, "ls": "--"}
        if name == model:
            style |= {"lw": 1.6, "ls": "-"}
        paths.append((t_s, scores.predicted[name][window, given, joint], style))
    run = str(cut.run[window]).rsplit("/", 1)[-1].removesuffix(".parquet")
    u = cut.u[window, cut.num_before - 1 :, joint][given]
    return MotionWindow(f"{title}: {run}", t_s, measured[given], u, paths, paths[-1][1])


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
