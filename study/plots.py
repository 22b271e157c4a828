"""The pictures of a study: the paper's two (tool paths, radar), and each person.

Guided is always blue and solid, unguided orange and dotted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brokk_rl.plot import BLUE, GREEN, GREY, ORANGE, RED, add_legend, make_figure, remove_frame
from brokk_rl.statistics import compute_student_interval
from study import tlx
from study.analysis import Analysis, MeasuredTrial
from study.measures import MEASURES

LOOK = {"guided": (BLUE, "-"), "unguided": (ORANGE, ":")}
COLUMNS = 3
"""Panels beside each other."""


def draw_paths(found: Analysis) -> Figure:
    """Draw the tool's paths from above and from the side, a panel a hole; a star is where a trial begins, a sphere the hole."""
    drawn = []
    for trial in found.trials:
        if trial.counts and len(trial.tip_in_base_m):
            drawn.append(trial)
    holes = sorted({_name_hole(trial) for trial in drawn})
    figure = make_figure(3.6 * max(1, len(holes)), 6.8)
    for column, name in enumerate(holes):
        here = []
        for trial in drawn:
            if _name_hole(trial) == name:
                here.append(trial)
        for row, (title, horizontal, vertical) in enumerate(
            (("from above", 0, 1), ("from the side", None, 2))
        ):
            axis = figure.add_subplot(2, len(holes), row * len(holes) + column + 1)
            _draw_condition_paths(axis, here, horizontal, vertical)
            axis.set_title(f"hole {name}, {title}", fontsize=9)
            axis.set_xlabel("distance from the slew axis, m" if horizontal is None else "x, m")
            if not column:
                axis.set_ylabel("height, m" if vertical == 2 else "y, m")
    if figure.axes:
        add_legend(figure, figure.axes[0])
    return figure


def draw_radar(found: Analysis) -> Figure:
    """Draw the mean of each NASA-TLX scale, with and without guidance, with Student's intervals."""
    figure = make_figure(6.2, 5.6)
    axis = figure.add_subplot(projection="polar")
    angles = np.linspace(0, 2 * math.pi, len(tlx.SCALES), endpoint=False)
    # The two conditions are drawn slightly apart, so that their intervals do not hide each other.
    for shift, condition in ((-0.02, "guided"), (0.02, "unguided")):
        values = [found.loads[scale][condition] for scale in tlx.SCALES]
        means = np.array(
            [np.nanmean(value) if not np.isnan(value).all() else math.nan for value in values]
        )
        halves = np.array([_compute_half_width(value) for value in values])
        colour, line = LOOK[condition]
        # Closed by repeating the first point.
        closed = np.append(angles, angles[0]) + shift
        axis.plot(
            closed, np.append(means, means[0]), line, color=colour, label=condition, linewidth=2
        )
        axis.errorbar(
            angles + shift, means, halves, fmt="o", color=colour, markersize=4, elinewidth=1
        )
    axis.set_xticks(
        angles, [title.replace(" (", "\n(") for title in tlx.SCALES.values()], fontsize=9
    )
    axis.tick_params(axis="x", pad=16)
    # The full scale, so that small differences look small.
    axis.set_ylim(0, 100)
    axis.set_yticks([20, 40, 60, 80], ["20", "40", "60", "80"], fontsize=7, color=GREY)
    add_legend(figure, axis)
    return figure


def draw_pairs(found: Analysis, names: Sequence[str]) -> Figure:
    """Draw one line a participant from unguided to guided, a panel a measure; means with intervals beside."""
    rows = -(-len(names) // COLUMNS)
    figure = make_figure(3.6 * COLUMNS, 2.9 * rows + 0.5)
    for number, name in enumerate(names):
        axis = figure.add_subplot(rows, COLUMNS, number + 1)
        values = (
            found.loads[name.removeprefix("tlx_")] if name.startswith("tlx_") else found.means[name]
        )
        both = np.stack((values["unguided"], values["guided"]))
        for first, colour, label in ((True, GREEN, "guided first"), (False, RED, "unguided first")):
            mine = both[:, found.guided_first == first]
            axis.plot([0, 1], mine, "-o", color=colour, markersize=3, linewidth=0.9, alpha=0.7)
            # An empty line gives the legend its entry, however many participants there are.
            axis.plot([], [], "-o", color=colour, markersize=3, label=label)
        for place, value in ((-0.15, both[0]), (1.15, both[1])):
            if not np.isnan(value).all():
                axis.errorbar(
                    [place],
                    [np.nanmean(value)],
                    [[_compute_half_width(value)], [_compute_half_width(value)]],
                    fmt="s",
                    color="black",
                    markersize=5,
                    capsize=3,
                )
        axis.set_xticks([0, 1], ["unguided", "guided"])
        axis.set_xlim(-0.35, 1.35)
        title = get_title(name)
        if (effect := found.effects.get(name)) and effect.p is not None:
            title += "\np < 0.001" if effect.p < 0.001 else f"\np = {effect.p:.3f}"
        axis.set_title(title, fontsize=9)
        remove_frame(axis)
    if figure.axes:
        add_legend(figure, figure.axes[0])
    return figure


def get_title(name: str) -> str:
    """Return the title of a measure or scale."""
    if name.startswith("tlx_"):
        scale = name.removeprefix("tlx_")
        return f"TLX: {tlx.SCALES.get(scale, scale)}"
    each = next(each for each in MEASURES if each.name == name)
    return each.title + (f", {each.unit}" if each.unit else "")


def _draw_condition_paths(
    axis: Axes, trials: Sequence[MeasuredTrial], horizontal: int | None, vertical: int
) -> None:
    labelled = set()
    for trial in trials:
        tip = trial.tip_in_base_m
        x = np.hypot(tip[:, 0], tip[:, 1]) if horizontal is None else tip[:, horizontal]
        colour, line = LOOK[trial.facts["condition"]]
        # One entry in the legend for each condition.
        label = None if trial.facts["condition"] in labelled else trial.facts["condition"]
        labelled.add(trial.facts["condition"])
        axis.plot(x, tip[:, vertical], line, color=colour, linewidth=0.9, alpha=0.75, label=label)
        axis.plot(x[:1], tip[:1, vertical], "*", color=colour, markersize=8)
    center = np.array(trials[0].facts["hole"]["center_in_base_m"])
    at = math.hypot(center[0], center[1]) if horizontal is None else center[horizontal]
    axis.plot([at], [center[vertical]], "o", color="black", markersize=9)
    axis.set_aspect("equal", adjustable="datalim")
    remove_frame(axis)


def _name_hole(trial: MeasuredTrial) -> str:
    return str(trial.facts["hole"].get("name", "?"))


def _compute_half_width(values: np.ndarray) -> float:
    """Return half of Student's 95 % interval, 0 for a single value."""
    known = values[~np.isnan(values)]
    interval = compute_student_interval(known.tolist())
    return (interval[1] - interval[0]) / 2 if interval else 0.0
