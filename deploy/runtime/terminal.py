"""Levers and safety in the terminal, for a desk without the operator's page.

A process of its own: a terminal that is not read blocks it, and nothing else.
"""

from __future__ import annotations

import math
import time

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from deploy.guidance import LeverPositions, convert_to_positions
from deploy.runtime.operator_state import LoopSnapshot
from deploy.runtime.process import Stop
from deploy.runtime.shm_layout import LoopMemory

REFRESH_S = 0.1
"""Between two pictures, as fast as a person can read them."""
BAR_WIDTH = 10
"""Characters of a lever bar from neutral to full."""
LARGEST_AGE_S = 9.999
"""Age above which the terminal shows no more digits."""


def run(stop: Stop, full_rad: np.ndarray, memory: LoopMemory) -> None:
    """Show the state until asked to stop.

    Args:
        stop: Returns whether to stop.
        full_rad: Angles of the four axes at full deflection, `(4,)`.
        memory: Source of the state.
    """
    # On stderr: stdout belongs to the command's result.
    with Live(console=Console(stderr=True), auto_refresh=False) as live:
        while not stop():
            live.update(build_table(memory.read_snapshot(), full_rad), refresh=True)
            time.sleep(REFRESH_S)


def build_table(snapshot: LoopSnapshot, full_rad: np.ndarray) -> Table:
    """Return levers and safety as a table, for a desk without the operator's page.

    Args:
        snapshot: State and advice.
        full_rad: Angles of the four axes at full deflection, `(4,)`.
    """
    # The terminal's table is a stand-in; see `deploy.page` for the real one.
    grid = Table.grid(padding=(0, 2))
    state, advice = snapshot.state, snapshot.advice
    own = state.levers if state else None
    proposed = None
    if advice is not None:
        proposed = convert_to_positions(advice.lever_rad, full_rad, advice.button_right)
    for name in ("left_theta", "left_psi", "right_theta", "right_psi"):
        grid.add_row(
            name.replace("_", " "),
            _draw_bar(getattr(proposed, name, 0.0), "green"),
            _draw_bar(getattr(own, name, 0.0), "blue"),
        )
    grid.add_row("right button", _draw_button(proposed, "green"), _draw_button(own, "blue"))
    reason = "no policy yet" if advice is None else advice.reason.value
    safety = "bus process silent"
    if state is not None and snapshot.alive:
        safety = f"{state.guard.name.lower()}, {state.trip.value}"
    grid.add_row("advice", reason, f"safety: {safety}")
    if state is not None:
        joints = "  ".join(f"{q:+.3f}" for q in state.q)
        # An age of many digits would make the columns jump.
        age_s = min(snapshot.t_s - state.q_t_s, LARGEST_AGE_S)
        grid.add_row("joints", joints, f"{1e3 * age_s:.0f} ms old")
    return grid


def _draw_bar(part: float, color: str) -> Text:
    """Draw a bar from the middle to `part` of full, in [-1, 1]."""
    # NaN is a lever that is not known; it is drawn in neutral.
    shown = max(-1.0, min(1.0, part)) if math.isfinite(part) else 0.0
    filled = round(shown * BAR_WIDTH)
    cells = [" "] * (2 * BAR_WIDTH + 1)
    low, high = sorted((BAR_WIDTH, BAR_WIDTH + filled))
    cells[low : high + 1] = ["█"] * (high - low + 1)
    cells[BAR_WIDTH] = "│" if filled == 0 else "█"
    return Text("".join(cells), style=color)


def _draw_button(levers: LeverPositions | None, color: str) -> Text:
    held = levers is not None and levers.button_right
    return Text("■ held" if held else "□", style=color if held else "")
