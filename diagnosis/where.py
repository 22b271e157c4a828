"""Where a gap lies: in which joints, and in which moments of their motion.

An error of position stays after its cause is over. So the error of a window is taken as the sum of its
increments, `e = Σ_c e_c`, with `e_c` those that arise in the moments `c` of the simulated motion; then
`Σ e_c e` is the part of `c` in the squared error. The parts add up to it, and one below 0 works against the others.
Axes: `W` windows, `K` steps, `J` joints, `C` regimes.
"""

from __future__ import annotations

import numpy as np

from actuators.scales import scale_time
from brokk_rl.machine import Machine
from diagnosis.answer import RegimeGap, Where
from diagnosis.free_runs import WindowedRuns
from diagnosis.measured_changes import MOVING

REGIMES = ("at rest", "after a stop", "after a reversal", "after a start", "in steady motion")
"""A step has the first that fits."""
TRANSIENT_S = 0.6
"""Time between the two directions of motion that make a regime, on the reference of `actuators.scales`: lag, play
and ringing of a hydraulic joint are over after it."""
TINY = np.finfo(float).tiny
"""Smallest divisor: a sum of squares may be 0."""


def locate_gap(runs: WindowedRuns, after: np.ndarray, floor: np.ndarray, machine: Machine) -> Where:
    """Return where the gap lies.

    Args:
        runs: Free runs of the simulator as it was.
        after: Root mean square errors of the repaired simulator, `(J,)`.
        floor: The same of the unchanged machine under the field's motion.
        machine: The machine.
    """
    before = np.sqrt(np.square(runs.error).mean((0, 1)))
    excess = np.maximum(np.square(before) - np.square(floor), 0.0)
    if not excess.any():
        excess = np.square(before)
    shares = excess / np.square(machine.upper - machine.lower)
    shares = shares / max(float(shares.sum()), TINY)
    parts = shares * split_by_regime(runs, machine)
    joints = {}
    regimes = []
    for j, joint in enumerate(machine.joints):
        errors = {"rmse": before[j], "floor": floor[j], "after": after[j]}
        told = {f"{name}_{joint.unit}": float(value) for name, value in errors.items()}
        joints[joint.name] = told | {"share": float(shares[j])}
        for regime, part in zip(REGIMES, parts[:, j].tolist(), strict=True):
            if part > 0.0:
                regimes.append(RegimeGap(joint.name, regime, part))
    regimes.sort(key=lambda one: -one.share)
    return Where(joints, tuple(regimes))


def split_by_regime(runs: WindowedRuns, machine: Machine) -> np.ndarray:
    """Return the part of each regime in the squared error of each joint, `(C, J)`, none below 0 and of sum 1."""
    error = runs.error
    regime = label_regimes(runs, machine)
    added = np.diff(error, axis=1, prepend=0.0)
    parts = np.zeros((len(REGIMES), error.shape[2]))
    for number in range(len(REGIMES)):
        arisen = np.where(regime == number, added, 0.0).cumsum(1)
        parts[number] = np.maximum((arisen * error).sum((0, 1)), 0.0)
    return parts / np.maximum(parts.sum(0), TINY)


def label_regimes(runs: WindowedRuns, machine: Machine) -> np.ndarray:
    """Return the number of the regime of each step of the simulated motion, `(W, K, J)`."""
    period_s = float(np.median(np.diff(runs.recordings[0].t_s)))
    num_steps = max(1, round(scale_time(machine, TRANSIENT_S) / period_s))
    speed = np.gradient(runs.simulated, axis=1)
    moves = np.abs(speed) > MOVING * np.abs(speed).max((0, 1))
    now = np.where(moves, np.sign(speed), 0.0)
    earlier = np.concatenate([np.repeat(now[:, :1], num_steps, 1), now], 1)[:, : now.shape[1]]
    # A joint that rested in between turns too: its newest direction until then counts.
    step = np.arange(earlier.shape[1])[:, None]
    newest = np.maximum.accumulate(np.where(earlier != 0.0, step, 0), 1)
    turned = now * np.take_along_axis(earlier, newest, 1) < 0.0
    conditions = [(now == 0.0) & (earlier == 0.0), now == 0.0, turned, earlier == 0.0]
    return np.select(conditions, range(len(conditions)), len(conditions))
