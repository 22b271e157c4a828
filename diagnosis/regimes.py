"""Regime, direction and load of each sample, so that every sample has one label of each kind.

A joint answers its command a dead time later, so the label uses the command of that time.
Axes: `T` rows, `J` joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from actuators.recordings.split import COMMANDED
from actuators.scales import scale_time
from brokk_rl.gravity import Gravity
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

REGIMES = (
    "hold",
    "stop",
    "near an end stop",
    "after a reversal",
    "start",
    "creep",
    "several joints at once",
    "cruise",
)
"""The first that fits is a sample's only one: at rest (just come to rest: `stop`), else commanded
near an end of its travel, else shortly after a change of direction (whatever time it rested in
between), else shortly after rest, else by a small command, else together with other joints, else
alone."""
DIRECTIONS = ("not commanded", "extending", "retracting")
LOADS = ("not commanded", "level", "lifting", "lowering")
"""Against gravity, with it, or with less than `LEVEL` of the joint's largest load."""
TRANSIENT_S = 0.6
"""Length of a transient on the reference of `actuators.scales`, s: lag, play and ringing are over after
it; chosen by hand."""
NEAR_STOP = 0.05
"""Share of the travel near an end stop; chosen by hand."""
CREEP_COMMAND = 0.3
"""Largest command of a creeping joint; chosen by hand: a usual dead band takes half of it."""
LEVEL_LOAD = 0.1
"""Share of the largest load below which a joint counts as level; chosen by hand."""


@dataclass(frozen=True)
class SampleGrouping:
    """Labels of all samples by one criterion.

    Attributes:
        name: The criterion.
        categories: Their names.
        label: Number of the category of each sample, for each recording `(T, J)`.
    """

    name: str
    categories: tuple[str, ...]
    label: list[np.ndarray]


def group_samples(
    recordings: list[Recording], machine: Machine, dead_time_s: np.ndarray
) -> list[SampleGrouping]:
    """Return regime, direction and, where the masses are known, load of all samples.

    Args:
        recordings: The recordings.
        machine: Gives limits, period and masses.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
    """
    acting = [
        shift_by_dead_time(recording.u, dead_time_s, 1.0 / recording.rate_hz)
        for recording in recordings
    ]
    found = [
        SampleGrouping(
            "regime",
            REGIMES,
            [
                label_regimes(u, r.q, machine, r.rate_hz)
                for u, r in zip(acting, recordings, strict=True)
            ],
        ),
        SampleGrouping("direction", DIRECTIONS, [label_directions(u) for u in acting]),
    ]
    if machine.has_bodies:
        found.append(
            SampleGrouping(
                "load",
                LOADS,
                [label_loads(u, r.q, machine) for u, r in zip(acting, recordings, strict=True)],
            )
        )
    return found


def shift_by_dead_time(u: np.ndarray, dead_time_s: np.ndarray, period_s: float) -> np.ndarray:
    """Return the command that moved each joint before each row, `(T, J)`."""
    found = np.zeros(u.shape)
    for j, delay_s in enumerate(dead_time_s):
        back = round(float(delay_s) / period_s) + 1  # row k - 1 is in force until row k is measured
        found[back:, j] = u[: max(0, len(u) - back), j]
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


def label_directions(acting: np.ndarray) -> np.ndarray:
    """Return the number of the direction of each sample, `(T, J)`."""
    return np.where(np.abs(acting) <= COMMANDED, 0, np.where(acting > 0, 1, 2))


def label_loads(acting: np.ndarray, q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the number of the kind of load of each sample, `(T, J)`."""
    load = (
        Gravity(machine, torch.device("cpu")).load(torch.as_tensor(q, dtype=torch.float32)).numpy()
    )
    largest = np.maximum(np.abs(load).max(0), 1e-9)
    pushed = load * np.sign(acting)
    kind = np.where(np.abs(load) < LEVEL_LOAD * largest, 1, np.where(pushed < 0, 2, 3))
    # a joint about the vertical carries nothing: its tiny load is rounding
    kind = np.where(largest < 1e-3 * largest.max(), 1, kind)
    return np.where(np.abs(acting) <= COMMANDED, 0, kind)


def _hold_last_sign(sign: np.ndarray) -> np.ndarray:
    """Return the newest sign that is not 0 at each row, `(T, J)`; 0 before the first."""
    place = np.maximum.accumulate(np.where(sign != 0, np.arange(len(sign))[:, None], 0), 0)
    return np.take_along_axis(sign, place, 0)


def _count_rows_since(event: np.ndarray) -> np.ndarray:
    """Return the rows since the newest event at each row, `(T, J)`; very many before the first."""
    rows = np.arange(len(event))[:, None]
    return rows - np.maximum.accumulate(np.where(event, rows, -(10**9)), 0)
