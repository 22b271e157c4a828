"""What all pictures of a report share: colours that those who see few can tell apart, one panel a joint, legends, plain frames."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brokk_rl.machine import Machine

BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#8c8c8c"
OTHERS = (GREEN, "#cc79a7", RED, "#56b4e9", "#5b4a9e")
"""Okabe and Ito's colours."""
PANEL_INCHES = (3.9, 2.9)
"""Width and height of a panel, inches."""


def make_joint_panels(machine: Machine, shared: str) -> tuple[Figure, list[Axes]]:
    """Returns a figure with one panel a joint, in rows of three at most, with the same scale along the axes in `shared`."""
    columns = 2 if machine.num_joints in (2, 4) else min(3, machine.num_joints)
    rows = -(-machine.num_joints // columns)
    figure = Figure(
        figsize=(PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows + 0.6), layout="constrained"
    )
    first = figure.add_subplot(rows, columns, 1)
    share = {f"share{side}": first for side in shared}
    return figure, [
        first,
        *(
            figure.add_subplot(rows, columns, number + 1, **share)
            for number in range(1, machine.num_joints)
        ),
    ]


def add_legend(figure: Figure, axis: Axes) -> None:
    """Explains above all panels what is drawn in one of them."""
    handles, labels = axis.get_legend_handles_labels()
    place = "outside upper center" if figure.get_layout_engine() else "upper center"
    figure.legend(handles, labels, loc=place, ncols=len(labels), frameon=False)


def remove_frame(axis: Axes) -> None:
    """Takes the frame away where it says nothing."""
    axis.spines[["top", "right"]].set_visible(False)
