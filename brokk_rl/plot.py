"""The one plot style of all pictures: colour-blind-safe palette, figures, legends, files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from brokk_rl.session import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#8c8c8c"
PURPLE = "#cc79a7"
OTHERS = (GREEN, PURPLE, RED, "#56b4e9", "#5b4a9e")
"""Colour-blind-safe palette. Source: Okabe and Ito, Color Universal Design (2008), with a grey."""
DPI = 150
"""Resolution of pictures, dots an inch: sharp in print at page width; chosen by hand."""


def make_figure(width_inches: float, height_inches: float) -> Figure:
    """Return an empty figure whose layout leaves room for labels."""
    from matplotlib.figure import Figure  # this import takes 0.4 s

    return Figure(figsize=(width_inches, height_inches), layout="constrained")


def add_legend(figure: Figure, axis: Axes) -> None:
    """Add above all panels the legend of one of them."""
    handles, labels = axis.get_legend_handles_labels()
    place = "outside upper center" if figure.get_layout_engine() else "upper center"
    figure.legend(handles, labels, loc=place, ncols=len(labels), frameon=False)


def remove_frame(axis: Axes) -> None:
    """Remove the frame at the top and at the right."""
    axis.spines[["top", "right"]].set_visible(False)


def draw_grid(axis: Axes, direction: Literal["x", "y", "both"] = "both") -> None:
    """Draw thin lines at the ticks, and no frame at the top and at the right."""
    axis.grid(axis=direction, linewidth=0.4)
    remove_frame(axis)


def draw_png(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file, in one step.

    Raises:
        StorageError: It could not be written; nothing was left behind.
    """
    write_bytes(path, draw_png(figure))
