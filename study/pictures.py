"""The pictures of a study: the tool's paths, as in the paper, and each person.

Guided is always blue and solid, unguided orange and dotted.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# The stubs of pandas and SciPy name more types than are returned here.

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brokk_rl.plot import BLUE, GREEN, ORANGE, RED, add_legend, make_figure, remove_frame
from brokk_rl.statistics import compute_student_interval
from study.analysis import TITLES, Analysis

LOOK = {"guided": (BLUE, "-"), "unguided": (ORANGE, ":")}
VIEWS = {
    "from above": ("x, m", "y, m"),
    "from the side": ("distance from the slew axis, m", "height, m"),
}
"""Labels of the axes of each view of the paths."""
COLUMNS = 3
"""Panels beside each other."""


def draw_paths(found: Analysis) -> Figure:
    """Draw the tool's paths from above and from the side, a column a hole; a star is where a trial begins, a dot the hole."""
    holes = found.data.design.holes
    drawn = found.trials[found.trials.counts]
    figure = make_figure(3.6 * len(holes), 6.8)
    panels = figure.subplots(2, len(holes), squeeze=False)
    for column, (name, hole) in enumerate(holes.items()):
        for axis, view in zip(panels[:, column], VIEWS, strict=True):
            for _, trial in drawn[drawn.hole == name].iterrows():
                colour, line = LOOK[trial.condition]
                x, y = _project(trial.tip_in_base_m, view)
                axis.plot(x, y, line, color=colour, linewidth=0.9, alpha=0.75)
                axis.plot(x[:1], y[:1], "*", color=colour, markersize=8)
            axis.plot(*_project(np.array([hole.center_in_base_m]), view), "ko", markersize=9)
            axis.set(title=f"hole {name}, {view}", xlabel=VIEWS[view][0], ylabel=VIEWS[view][1])
            axis.set_aspect("equal", adjustable="datalim")
            remove_frame(axis)
    for condition, (colour, line) in LOOK.items():
        # An empty line gives the legend its entry, however many trials there are.
        panels[0, 0].plot([], [], line, color=colour, label=condition)
    add_legend(figure, panels[0, 0])
    return figure


def _project(tip_in_base_m: np.ndarray, view: str) -> tuple[np.ndarray, np.ndarray]:
    x, y, z = tip_in_base_m.T
    return (x, y) if view == "from above" else (np.hypot(x, y), z)


def draw_pairs(found: Analysis, names: Sequence[str]) -> Figure:
    """Draw one line a participant from unguided to guided, a panel a measure; means with intervals beside."""
    rows = -(-len(names) // COLUMNS)
    figure = make_figure(3.6 * COLUMNS, 2.9 * rows + 0.5)
    is_guided_first = (found.means.condition == "guided") == (found.means.period == 1)
    for number, name in enumerate(names, 1):
        axis = figure.add_subplot(rows, COLUMNS, number)
        for first, colour, label in ((True, GREEN, "guided first"), (False, RED, "unguided first")):
            wide = found.means[is_guided_first == first].pivot(
                index="condition", columns="participant", values=name
            )
            lines = wide.reindex(["unguided", "guided"]).to_numpy(float)
            axis.plot([0, 1], lines, "-o", color=colour, markersize=3, linewidth=0.9, alpha=0.7)
            axis.plot([], [], "-o", color=colour, markersize=3, label=label)
        for place, condition in ((-0.15, "unguided"), (1.15, "guided")):
            _draw_mean(axis, place, found.means[name][found.means.condition == condition], "black")
        axis.set_xticks([0, 1], ["unguided", "guided"])
        axis.set_xlim(-0.35, 1.35)
        p = found.effects[name].p
        axis.set_title(TITLES[name] + ("" if p is None else f"\np = {p:.2g}"), fontsize=9)
        remove_frame(axis)
    add_legend(figure, figure.axes[0])
    return figure


def _draw_mean(axis: Axes, place: float, values: pd.Series, colour: str) -> None:
    """Draw a mean with Student's interval; nothing for no values, no interval for one."""
    known = values.dropna().tolist()
    if known:
        low, high = compute_student_interval(known) or (known[0], known[0])
        half = (high - low) / 2
        axis.errorbar(
            [place], [np.mean(known)], half, fmt="s", color=colour, markersize=4, capsize=3
        )
