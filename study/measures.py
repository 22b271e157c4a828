"""Measures of a trial's recording, one number each; NaN where the recording does not show it.

Everything is counted from the start of the recording to the insertion, or to the limit where there
was none.
Axes: `T` time, `J` joints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from study.design import Hole, Success

PIECE_S = 0.5
"""A path is measured between means over so long: shorter pieces would add up the encoders' noise,
longer ones cut corners."""
SLOPE_SAMPLES = 5
"""Samples, a quarter of a second, over which a line is fitted for a speed: differences of single
samples are mostly noise."""
MOVING = 0.05
"""Share of a joint's top speed above which it moves."""
LEVER_ON, LEVER_OFF = 0.10, 0.05
"""Deflection from which a lever is being moved, and below which it is let go; two, so that tremor
does not count."""


@dataclass(frozen=True)
class Measure:
    """One measure.

    Attributes:
        name: Key in files.
        title: Words in tables and pictures.
        unit: Its unit, '' for a plain number.
        better: +1 where more is better, -1 where less is, 0 where neither.
    """

    name: str
    title: str
    unit: str
    better: int


MEASURES = (
    Measure("time_s", "time to insertion", "s", -1),
    Measure("success", "trials inserted", "share", 1),
    Measure("path_m", "path of the tool", "m", -1),
    Measure("several_joints", "time with two or more joints moving", "share", 1),
    Measure("lever_movements", "lever movements", "", -1),
    Measure("joint_switches", "changes from one joint to another", "", -1),
    Measure("control_effort", "lever travel a second", "1/s", -1),
    Measure("peak_force_n", "largest contact force", "N", -1),
    Measure("advice_error", "distance from the advice", "1", -1),
)
GUIDED_ONLY = "advice_error"
"""Measure that says something only where advice was shown, and so cannot be compared."""
COMPARED = tuple(each.name for each in MEASURES if each.name != GUIDED_ONLY)


def measure_trial(
    recording: Recording, machine: Machine, hole: Hole, success: Success, limit_s: float
) -> dict[str, float]:
    """Return every measure of `MEASURES` of one trial.

    Args:
        recording: From the start of the trial.
        machine: Its machine.
        hole: The hole of the trial.
        success: When the tool is in.
        limit_s: Time limit of the trial.
    """
    tip = compute_tool_kinematics(machine, recording.q).tip_in_base_m
    t_s = recording.t_s - recording.t_s[0]
    last = find_insertion(tip, hole, success)
    within = t_s <= limit_s
    inserted = last is not None and bool(within[last])
    # The sample of the insertion counts; after it the arm is moved away.
    num = last + 1 if inserted and last is not None else int(within.sum())
    period_s = 1.0 / recording.rate_hz
    q, u = recording.q[:num].astype(float), recording.u[:num].astype(float)
    onsets = detect_lever_movements(u)
    moving = np.abs(differentiate(q, period_s)) > MOVING * machine.max_speed
    found = {
        "time_s": float(t_s[num - 1]) if inserted else limit_s,
        "success": float(inserted),
        "path_m": measure_path_length(tip[:num], period_s),
        "several_joints": float((moving.sum(1) >= 2).mean()),
        "lever_movements": float(len(onsets)),
        "joint_switches": float(np.count_nonzero(np.diff(onsets[:, 1]))),
        "control_effort": float(np.abs(np.diff(u, axis=0)).sum() / (period_s * max(1, num - 1))),
        "peak_force_n": math.nan,
        "advice_error": math.nan,
    }
    # Without advice in the recording there is nothing to follow.
    names = [f"advice_{joint}" for joint in recording.joints]
    if all(name in recording.extra for name in names):
        advice = np.stack([recording.extra[name][:num] for name in names], 1)
        shown = ~np.isnan(advice).any(1)
        if shown.any():
            found["advice_error"] = float(np.sqrt(np.square((u - advice)[shown]).mean()))
    if "force_n" in recording.extra:
        found["peak_force_n"] = float(np.max(recording.extra["force_n"][:num], initial=0.0))
    return found


def find_insertion(tip_in_base_m: np.ndarray, hole: Hole, success: Success) -> int | None:
    """Return the first sample at which the tip, `(T, 3)`, is in the hole, `None` where it never is."""
    away = tip_in_base_m - np.array(hole.center_in_base_m)
    inside = (np.hypot(away[:, 0], away[:, 1]) <= success.clearance_m) & (
        away[:, 2] <= -success.depth_m
    )
    return int(inside.argmax()) if inside.any() else None


def measure_path_length(tip_in_base_m: np.ndarray, period_s: float) -> float:
    """Return the length of a path, `(T, 3)`, between means over pieces of `PIECE_S`, m; first and last sample are its ends."""
    # Means over pieces, so that noise of the encoders adds no length.
    size = max(1, round(PIECE_S / period_s))
    inner = len(tip_in_base_m) // size * size
    corners = tip_in_base_m[:inner].reshape(-1, size, 3).mean(1)
    points = np.concatenate((tip_in_base_m[:1], corners, tip_in_base_m[-1:]))
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def differentiate(values: np.ndarray, period_s: float) -> np.ndarray:
    """Return the slope over `SLOPE_SAMPLES` (Savitzky and Golay 1964), `(T, …)`; 0 in shorter ones."""
    if len(values) < SLOPE_SAMPLES:
        return np.zeros_like(values)
    return np.asarray(savgol_filter(values, SLOPE_SAMPLES, 1, deriv=1, delta=period_s, axis=0))


def detect_lever_movements(u: np.ndarray) -> np.ndarray:
    """Return when and which lever axis began to move, `(M, 2)` of sample and joint, in order; commands `u`, `(T, J)`."""
    on, off = np.abs(u) >= LEVER_ON, np.abs(u) < LEVER_OFF
    # 1 and 0 are beyond a threshold; -1 lies between both and keeps the state (hysteresis).
    crossed = np.where(on, 1, np.where(off, 0, -1))
    rows = np.where(crossed >= 0, np.arange(len(u))[:, None], -1)
    # Row of the newest sample beyond a threshold; a recording begins with levers released.
    newest = np.maximum.accumulate(rows, axis=0)
    held = np.where(newest >= 0, np.take_along_axis(crossed, np.maximum(newest, 0), 0), 0)
    return np.argwhere(np.diff(held.astype(int), axis=0, prepend=0) > 0)
