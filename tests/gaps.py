"""Gaps of known size and recordings of known motion, for the tests of the diagnosis."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.error_covariance import ErrorCovariance
from diagnosis.gap import GapClosure

PERIOD_S = 0.05
DELAY = 11
NOISE = 0.0003
STEPS = 10
SENSOR = ErrorCovariance(sensor=0.006, change=0.0, wander=0.0, memory=10.0)
"""Errors of 6 mrad at each of two increments, whatever the motion."""


def held(base: np.ndarray, measured: np.ndarray, noise: Any = None) -> Any:
    """Returns free runs beside measured positions, all of which begin at 0."""
    cut, start = SimpleNamespace(measured=measured), np.zeros((len(base), base.shape[2]))
    ends = base[:, 4::5]
    return SimpleNamespace(
        base=base,
        start=start,
        increments=np.diff(ends, axis=1, prepend=start[:, None]),
        noise=noise,
        simulator=SimpleNamespace(cut=cut, fixed=()),
    )


def reach(
    machine: Machine,
    before: float,
    after: float,
    own: float,
    floor: float,
    scatter: float = 0.0,
    windows: int = 40,
) -> GapClosure:
    """Returns errors of one size everywhere, or of a size that scatters from window to window."""
    noise, draw = [SENSOR] * machine.num_joints, np.random.default_rng(1)
    measured = np.zeros((windows, STEPS, machine.num_joints))
    by = 1.0 + scatter * draw.standard_normal((windows, 1, 1))
    other = 1.0 + scatter * draw.standard_normal((windows, 1, 1))
    null = SimpleNamespace(residuals=held(measured + floor * other, measured, noise))
    base: Any = SimpleNamespace(
        field=SimpleNamespace(residuals=held(measured + before * by, measured, noise)),
        left_out=[null],
        is_flexible=False,
    )
    paths = measured + after * by
    return GapClosure(base, machine, paths, measured + own * by, np.random.default_rng(0))


def recording(
    machine: Machine, ignored: np.ndarray | None = None, seconds: float = 240.0
) -> Recording:
    """Returns a recording in which all joints but q2 go to and fro; `ignored`, `(T,)`: where q3 does not obey."""
    steps = round(seconds / PERIOD_S)
    u = np.zeros((steps, 5))
    for j, (length, level) in enumerate(((90, 0.5), (70, 0.4), (80, 0.5), (60, 0.4), (100, 0.3))):
        u[:, j] = level * np.array([0.0, 1.0, 0.0, -1.0])[(np.arange(steps) // length) % 4]
    u[:, 1] = 0.0
    obeyed = u.copy()
    if ignored is not None:
        obeyed[ignored, 2] = 0.0
    moved = np.zeros((steps, 5))
    moved[DELAY:] = obeyed[:-DELAY] * machine.max_speed * PERIOD_S
    q = (
        machine.home
        + np.cumsum(moved, 0)
        + NOISE * np.random.default_rng(0).standard_normal((steps, 5))
    )
    return Recording(
        machine="brokk170", joints=machine.joint_names, units=("rad",) * 5, rate_hz=20.0, t_s=np.arange(steps) * PERIOD_S,
        u=u.astype(np.float32), q=q.astype(np.float32), metadata={"run": "planted"},
    )  # fmt: skip
