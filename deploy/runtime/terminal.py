"""The loop in a terminal: levers and safety as text, for a desk without the operator's page."""

from __future__ import annotations

import math

from rich.table import Table
from rich.text import Text

from deploy.guidance import Levers
from deploy.runtime.operator_state import View

WIDTH = 10
"""Characters from neutral to full."""


def table(view: View, full_rad: tuple[float, ...]) -> Table:
    """Returns the view as a table; `full_rad` are the angles of the four axes at full deflection."""
    grid = Table.grid(padding=(0, 2))
    own = view.machine.levers if view.machine else None
    proposed = view.advice.levers.parts(full_rad) if view.advice else None
    for name in ("left_theta", "left_psi", "right_theta", "right_psi"):
        grid.add_row(
            name.replace("_", " "),
            _bar(getattr(proposed, name, 0.0), "green"),
            _bar(getattr(own, name, 0.0), "blue"),
        )
    grid.add_row("right button", _button(proposed, "green"), _button(own, "blue"))
    advice = "no policy yet" if view.advice is None else view.advice.reason
    safety = view.safety
    state = (
        "bus process silent"
        if safety is None or not view.alive
        else f"{safety.state.lower()}, {safety.trip}"
    )
    grid.add_row("advice", advice, f"safety: {state}")
    if view.machine is not None:
        grid.add_row(
            "joints",
            "  ".join(f"{q:+.3f}" for q in view.machine.q),
            f"{1e3 * min(view.machine.q_age_s, 9.999):.0f} ms old",
        )
    return grid


def _bar(part: float, color: str) -> Text:
    """Draws -1 … 1 about the middle."""
    cells, filled = (
        [" "] * (2 * WIDTH + 1),
        round(max(-1.0, min(1.0, part if math.isfinite(part) else 0.0)) * WIDTH),
    )
    low, high = sorted((WIDTH, WIDTH + filled))
    cells[low : high + 1] = ["█"] * (high - low + 1)
    cells[WIDTH] = "│" if filled == 0 else "█"
    return Text("".join(cells), style=color)


def _button(levers: Levers | None, color: str) -> Text:
    held = levers is not None and levers.button_right
    return Text("■ held" if held else "□", style=color if held else "")
