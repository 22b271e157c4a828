"""Coverage: where the field is commanded as the reference was.

A fitted joint knows little about commands, and rates of commands, that the reference lacks. What it errs by there
is no sign of a change, and does not count.
Axes: `T` samples, `J` joints.
"""

from __future__ import annotations

import numpy as np

from diagnosis.engine.side import Side

MARGIN = 0.25
"""Part of the reference's range by which a command or its rate may lie beyond it. Four sealed cases have nothing
beyond, two of a plant from elsewhere up to 3 % of their time; a real arm whose reference hardly moves its elbow has 68 %."""
RATE_S = 0.1
"""Time over which the rate of a command is taken."""
RESPONSE_S = 0.5
"""Time behind the dead time in which a command acts on the motion. Chosen by hand."""


def find_covered(reference: Side, field: Side) -> np.ndarray:
    """Return at which samples the field's joints are commanded as on the reference, `(J, T)` bool."""
    row = np.arange(field.num_samples)
    width = field.count(field.machine.dead_time_s + RESPONSE_S)
    covered = np.ones((field.num_joints, field.num_samples), dtype=bool)
    for known, now in zip(_list_drivers(reference), _list_drivers(field), strict=True):
        low, high = known.min(0), known.max(0)
        room = MARGIN * (high - low)
        beyond = (now < low - room) | (now > high + room)
        newest = np.maximum.accumulate(np.where(beyond.T, row, -width), 1)
        covered &= row - newest >= width
    return covered


def measure_uncovered(field: Side, covered: np.ndarray) -> np.ndarray:
    """Return the part of all motion that lies outside the samples `covered` `(J, T)`, by joint, `(J,)`."""
    step = field.count(RATE_S)
    moved = np.abs(field.q[step:] - field.q[:-step]).T
    return (moved * ~covered[:, step:]).sum(1) / max(float(moved.sum()), 1e-12)


def _list_drivers(side: Side) -> tuple[np.ndarray, np.ndarray]:
    """Return commands and their rates, `(T, J)` each."""
    step = side.count(RATE_S)
    rate = np.zeros_like(side.u)
    rate[step:] = (side.u[step:] - side.u[:-step]) / RATE_S
    for begin in side.starts:
        rate[begin : begin + step] = 0.0
    return side.u, rate
