"""Pictures of an identification: predictions, error over horizon, regimes, dead time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, NullFormatter

from actuators.identify.dead_time import DeadTimeEstimate
from actuators.identify.scores import REGIMES, TAILS, FreeRunScores
from actuators.recordings.split import COMMANDED
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, GREY, ORANGE, OTHERS, add_legend, make_joint_panels, remove_frame

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
    steps = cut.measured.shape[1]
    t_s = machine.period_s * np.arange(1, steps + 1)
    # Inches. Laid out by hand, which is much faster than any layout engine with so many axes.
    height = 2.75 * machine.num_joints + 0.5
    figure = Figure(figsize=(12.0, height))
    rows = figure.add_gridspec(
        machine.num_joints,
        3,
        left=0.075,
        right=0.99,
        bottom=0.45 / height,
        top=1.0 - 0.6 / height,
        wspace=0.17,
        hspace=0.28,
    )
    colour = assign_colours(list(scores.predicted), model)
    for j, joint in enumerate(machine.joints):
        chosen = _select_windows(scores, model, j)
        for column, (title, window) in enumerate(chosen.items()):
            grid = rows[j, column].subgridspec(2, 1, height_ratios=[3.2, 1.0], hspace=0.12)
            above = figure.add_subplot(grid[0])
            below = figure.add_subplot(grid[1], sharex=above)
            measured = cut.measured[window, :, j]
            for name, path in scores.predicted.items():
                if name != model:
                    above.plot(
                        t_s,
                        np.where(np.isfinite(measured), path[window, :, j], np.nan),
                        color=colour[name],
                        lw=1.0,
                        ls="--",
                        label=name,
                    )
            above.plot(t_s, measured, color="black", lw=1.8, label="measured")
            above.plot(
                t_s,
                np.where(np.isfinite(measured), scores.predicted[model][window, :, j], np.nan),
                color=BLUE,
                lw=1.6,
                label=model,
            )
            _frame_axis(above, measured, scores.predicted[model][window, :, j], machine, j)
            above.tick_params(labelbottom=False)
            run = str(cut.run[window]).rsplit("/", 1)[-1].removesuffix(".parquet")
            above.set_title(f"{title}: {run}", fontsize=8.5, loc="left")
            u = cut.u[window, cut.num_before - 1 :, j]
            below.fill_between(
                t_s - machine.period_s, u, step="post", color="#555555", alpha=0.35, lw=0
            )
            below.set_ylim(-1.05, 1.05)
            below.set_yticks([-1, 0, 1])
            below.axhline(0.0, color="#555555", lw=0.5)
            below.set_xlim(0.0, t_s[-1])
            if column == 0:
                above.set_ylabel(f"{joint.name} [{joint.unit}]")
                below.set_ylabel("u", rotation=0, va="center")
            if j == machine.num_joints - 1:
                below.set_xlabel("time of the free run [s]")
            for axis in (above, below):
                remove_frame(axis)
    add_legend(figure, figure.axes[0])
    return figure


def draw_error_over_horizon(scores: FreeRunScores, model: str) -> Figure:
    """Draw the error of all models over the time of the free run, with 95 % bands."""
    machine = scores.machine
    figure, axes = make_joint_panels(machine, "xy")
    colour = assign_colours(list(scores.predicted), model)
    t_s = machine.period_s * np.arange(1, scores.cut.measured.shape[1] + 1)
    for j, (axis, joint) in enumerate(zip(axes, machine.joints, strict=True)):
        for name in sorted(scores.predicted, key=lambda name: name == model):
            rmse, again = (
                100.0 * values[..., j] / scores.travel[j] for values in scores.rmse(name)
            )
            axis.plot(t_s, rmse, color=colour[name], lw=2.0 if name == model else 1.3, label=name)
            if np.isfinite(again).any():
                with np.errstate(invalid="ignore"):
                    low, high = np.nanpercentile(again[:, np.isfinite(again).any(0)], TAILS, axis=0)
                axis.fill_between(
                    t_s[np.isfinite(again).any(0)], low, high, color=colour[name], alpha=0.2, lw=0
                )
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_title(joint.name, loc="left", fontsize=10)
        axis.set_xticks([t for t in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0) if t <= t_s[-1]])
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
        axis.set_xlim(t_s[0], t_s[-1])
        axis.grid(which="major", alpha=0.3)
        remove_frame(axis)
    figure.supxlabel("time of the free run [s]; the left end is the one-step error", fontsize=10)
    figure.supylabel("RMSE [% of travel]", fontsize=10)
    add_legend(figure, axes[0])
    return figure


def draw_regimes(
    table: Mapping[str, Any], machine: Machine, model: str, names: Sequence[str]
) -> Figure:
    """Draw how fast each model drifts in each regime, one panel a joint."""
    figure, axes = make_joint_panels(machine, "x")
    colour = assign_colours(names, model)
    travel = machine.upper - machine.lower
    for j, (axis, joint) in enumerate(zip(axes, machine.joints, strict=True)):
        rows = table[joint.name]
        for y, regime in enumerate(REGIMES):
            if regime not in rows:
                continue
            for number, name in enumerate(sorted(names, key=lambda name: name == model)):
                cell = rows[regime]["models"][name]
                value = 100.0 * cell["drift_per_s"] / travel[j]
                shift = 0.5 * ((number + 0.5) / len(names) - 0.5)
                if value <= 0:
                    continue
                size = 6.5 if name == model else 4.5
                axis.plot(
                    value,
                    y + shift,
                    "o",
                    color=colour[name],
                    ms=size,
                    label=name if regime == _find_first_regime(rows) else None,
                )
                if cell["ci95"]:
                    low, high = (max(100.0 * bound / travel[j], 1e-4) for bound in cell["ci95"])
                    axis.plot([low, high], [y + shift] * 2, color=colour[name], lw=1.4)
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set_yticks(
            range(len(REGIMES)),
            [
                f"{name} ({100 * rows[name]['time']:.0f} %)" if name in rows else f"{name} (0 %)"
                for name in REGIMES
            ],
        )
        axis.tick_params(axis="y", labelsize=8)
        axis.set_ylim(len(REGIMES) - 0.5, -0.5)
        axis.grid(axis="x", which="major", alpha=0.3)
        axis.set_title(joint.name, loc="left", fontsize=10)
        remove_frame(axis)
    figure.supxlabel(
        "drift: RMS of the error added within a second [% of travel]; in brackets the part of the time",
        fontsize=10,
    )
    add_legend(figure, axes[0])
    return figure


def draw_dead_times(delays: Mapping[str, DeadTimeEstimate | None], machine: Machine) -> Figure:
    """Draw the unexplained variance over the delay, one panel a joint, with intervals."""
    figure, axes = make_joint_panels(machine, "xy")
    history_s = machine.num_history * machine.period_s
    for axis, (joint, delay) in zip(axes, delays.items(), strict=True):
        axis.set_title(joint, loc="left", fontsize=10)
        remove_frame(axis)
        if delay is None:
            axis.text(0.5, 0.5, "hardly commanded", transform=axis.transAxes, ha="center")
            continue
        axis.plot(delay.tried_s, 100.0 * delay.left, color=BLUE, lw=1.8)
        axis.axvspan(*delay.ci95_s, color=BLUE, alpha=0.25, lw=0, label="95 % interval")
        axis.axvline(
            machine.dead_time_s, color="black", lw=1.0, ls="--", label="the machine's dead_time_s"
        )
        if history_s < delay.tried_s[-1]:
            axis.axvspan(
                history_s,
                delay.tried_s[-1],
                color="#999999",
                alpha=0.25,
                lw=0,
                label="beyond the history",
            )
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
        axis.set_xlim(0.0, delay.tried_s[-1])
        axis.grid(alpha=0.3)
        text = f"{delay.value_s:.2f} s" if delay.is_found else "not found"
        axis.set_title(f"{joint}: {text}", loc="left", fontsize=10)
    figure.supxlabel("delay [s]", fontsize=10)
    figure.supylabel("variance of the motion left unexplained [%]", fontsize=10)
    drawn = [axis for axis, delay in zip(axes, delays.values(), strict=True) if delay is not None]
    if drawn:
        add_legend(figure, drawn[0])
    return figure


def _select_windows(scores: FreeRunScores, model: str, joint: int) -> dict[str, int]:
    measured, u = (
        scores.cut.measured[..., joint],
        scores.cut.u[:, scores.cut.num_before - 1 :, joint],
    )
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


def _frame_axis(
    axis: Axes, measured: np.ndarray, predicted: np.ndarray, machine: Machine, joint: int
) -> None:
    """Bound the axis by measurement and model: a diverging rival does not flatten them."""
    shown = np.concatenate(
        [measured[np.isfinite(measured)], predicted[: np.isfinite(measured).sum()]]
    )
    travel = float(machine.upper[joint] - machine.lower[joint])
    middle, half = (
        (shown.max() + shown.min()) / 2.0,
        max(float(np.ptp(shown)) * 0.62, 0.01 * travel),
    )
    axis.set_ylim(middle - half, middle + half)
    for limit in (machine.lower[joint], machine.upper[joint]):
        if abs(limit - middle) < half:
            axis.axhline(limit, color="#b3261e", lw=1.0, ls=":")


def _find_first_regime(rows: Mapping[str, Any]) -> str:
    return next(name for name in REGIMES if name in rows)
