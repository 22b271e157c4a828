"""Regime of each sample.

A joint answers its command a dead time later, so the label uses the command of that time.
Axes: `T` rows, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from actuators.recordings.split import COMMANDED
from actuators.scales import scale_time
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

REGIMES = (
    "at rest",
    "just after stops",
    "near an end stop",
    "after a reversal",
    "at starts",
    "at small commands",
    "while several joints move",
    "at larger commands, alone",
)
"""The first that fits is a sample's only one: at rest (or just come to rest), else commanded
near an end of its travel, else shortly after a change of direction (whatever time it rested in
between), else shortly after rest, else by a small command, else together with other joints, else
alone."""
TRANSIENT_S = 0.6
"""Length of a transient on the reference of `actuators.scales`, s: lag, play and ringing are over after
it; chosen by hand."""
NEAR_STOP = 0.05
"""Share of the travel near an end stop; chosen by hand."""
CREEP_COMMAND = 0.3
"""Largest command of a creeping joint; chosen by hand: a usual dead band takes half of it."""


def label_recordings(recordings: Sequence[Recording], machine: Machine) -> list[np.ndarray]:
    """Return the number of the regime of each sample, for each recording `(T, J)`.

    Args:
        recordings: The recordings.
        machine: Gives limits, period and dead time.
    """
    found = []
    for one in recordings:
        acting = shift_by_dead_time(one.u, machine.dead_time_s, 1.0 / one.rate_hz)
        found.append(label_regimes(acting, one.q, machine, one.rate_hz))
    return found


def shift_by_dead_time(u: np.ndarray, dead_time_s: float, period_s: float) -> np.ndarray:
    """Return the command that moved each joint before each row, `(T, J)`."""
    found = np.zeros(u.shape)
    back = round(dead_time_s / period_s) + 1  # row k - 1 is in force until row k is measured
    found[back:] = u[: max(0, len(u) - back)]
    return found


def label_regimes(
    acting: np.ndarray, q: np.ndarray, machine: Machine, rate_hz: float
) -> np.ndarray:
    """Return the number of the regime of each sample, `(T, J)`."""
    shortly = round(scale_time(machine, TRANSIENT_S) * rate_hz)
    moving = np.abs(acting) > COMMANDED
    sign = np.where(moving, np.sign(acting), 0.0)
    before = np.concatenate([sign[:1], sign[:-1]])
    newest = _hold_last_sign(sign)
    since_change = _count_rows_since(
        (sign != 0) & (np.concatenate([newest[:1], newest[:-1]]) == -sign)
    )
    since_rest = _count_rows_since((sign != 0) & (before == 0))
    since_stop = _count_rows_since((sign == 0) & (before != 0))
    margin = NEAR_STOP * (machine.upper - machine.lower)
    others = moving.sum(1, keepdims=True) - moving > 0
    conditions = [
        ~moving & (since_stop >= shortly),
        ~moving,
        (q < machine.lower + margin) | (q > machine.upper - margin),
        since_change < shortly,
        since_rest < shortly,
        np.abs(acting) < CREEP_COMMAND,
        others,
    ]
    return np.select(conditions, range(len(conditions)), len(conditions))


def _hold_last_sign(sign: np.ndarray) -> np.ndarray:
    """Return the newest sign that is not 0 at each row, `(T, J)`; 0 before the first."""
    place = np.maximum.accumulate(np.where(sign != 0, np.arange(len(sign))[:, None], 0), 0)
    return np.take_along_axis(sign, place, 0)


def _count_rows_since(event: np.ndarray) -> np.ndarray:
    """Return the rows since the newest event at each row, `(T, J)`; very many before the first."""
    rows = np.arange(len(event))[:, None]
    return rows - np.maximum.accumulate(np.where(event, rows, -(10**9)), 0)
