"""Speed over command of each joint, measured and simulated, and what differs between the two.

One model (`conf/curve_fit`) is fitted twice to the same commands: to the measured
motion and to that of the simulator. It has dead time, play, lags, a speed curve on each side,
pose and pump. What it cannot describe is the same in both fits, so that it cancels in the difference.
The difference of two curves is then read as effects: dead band, saturation and gains of the two sides.
The bootstrap draws blocks of the recordings, the same for both fits. Where the simulator was fitted to a
reference, fits that left out parts of it add their scatter (jackknife).

Axes: `J` joints, `I` increments, `K` knots of a side, `C` numbers of a curve (both sides, `2 (K - 1)`),
`B` draws, `P` blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from actuators.identify.curve_fit import FittedCurve, ValveCurveFit
from brokk_rl.machine import Machine
from diagnosis.baseline import SimulatorComparison
from diagnosis.closure import Estimate, serialize_estimate

# Chosen by hand; not searched.
BAND_BOUNDS, LEVEL_BOUNDS, GAIN_BOUNDS = (-0.5, 0.9), (0.1, 1.0), (0.1, 4.0)
"""Bounds of dead band and saturation, of full command, and of the ratio of speeds."""
NEUTRAL_PULL = 0.003
"""Pull of each number to no effect, over the root mean square of the weighted curve: breaks ties."""
NORMAL_95 = 1.96
"""Half width of a 95 % interval of a normal distribution, in standard errors."""
MAX_POINTS = 300
"""Increments of a joint that `diagnosis.json` keeps for the figure."""
MIN_SCORE = 2.0
"""Standard errors from no effect below which a number of the curve is left out."""

DYNAMICS = ("dead_time_s", "play", "spool_s", "speed_s")
CURVE_NUMBERS = (
    "dead_band_extend",
    "dead_band_retract",
    "saturation",
    "extend_gain",
    "retract_gain",
)
NEUTRAL = np.array([0.0, 0.0, 1.0, 1.0, 1.0])
"""Values of `CURVE_NUMBERS` that change nothing."""
ADDED = ("dead_time_s", "play", "lag_s")
"""Differences of the dynamics; the two lags cannot be told apart at 20 Hz, so that they are added."""


@dataclass(frozen=True, eq=False)
class CurveDifference:
    """Change of the simulated speed curve of a joint into the measured one.

    Attributes:
        measured: Of the machine.
        simulated: Of the simulator under the same commands.
        values: `CURVE_NUMBERS`, then `ADDED`, `(8,)`.
        deviation: Their standard errors, `(8,)`; 0 for a number that is left out.
    """

    measured: FittedCurve
    simulated: FittedCurve
    values: np.ndarray
    deviation: np.ndarray

    def estimates(self) -> dict[str, Estimate | None]:
        """Return the numbers by name with 95 % intervals; `None` for one that is left out."""
        found: dict[str, Estimate | None] = {}
        names = [*CURVE_NUMBERS, *(f"{name}_added" for name in ADDED)]
        for name, value, error in zip(names, self.values, self.deviation, strict=True):
            wide = float(NORMAL_95 * error)
            at = float(value)
            found[name] = Estimate(at, (at - wide, at + wide)) if error > 0.0 else None
        return found


@dataclass(frozen=True, eq=False)
class SpeedCurves:
    """Speed curves of all joints.

    Attributes:
        knots: Strokes of the valve, `(K,)`.
        joints: By name; joints that hardly move are absent.
    """

    knots: np.ndarray
    joints: dict[str, CurveDifference]


def measure_curves(
    field: SimulatorComparison,
    others: Sequence[SimulatorComparison],
    machine: Machine,
    fit: ValveCurveFit,
    generator: np.random.Generator,
) -> SpeedCurves:
    """Fit the curves of the machine and of the simulator, and read their difference.

    Args:
        field: The simulator against the field.
        others: Fits of the simulator that left out a part of the reference, against the field.
        machine: The machine.
        fit: Fits the curves.
        generator: Draws blocks.

    Raises:
        RecordingError: no recording is long enough.
    """
    if machine.interface != "speed":  # a target or a torque sets no speed: there is no such curve
        return SpeedCurves(np.array(fit.knots), {})
    measured = _place_steps(field, field.residuals.simulator.cut.measured)
    motions = [measured, _place_steps(field, field.residuals.base)]
    further = [_place_steps(one, one.residuals.base) for one in others]
    curves = fit.fit_curves(machine, field.recordings, motions, further, generator)
    knots, found = np.array(fit.knots), {}
    for name, own in zip(machine.joint_names, curves, strict=True):
        if own:
            scatter = [one.draws[0] for one in own[2:]]
            found[name] = _compare_curves(own[0], own[1], knots, scatter)
    return SpeedCurves(knots, found)


def _place_steps(field: SimulatorComparison, paths: np.ndarray) -> list[np.ndarray]:
    """Return the motion of `paths` `(W, K, J)` from each sample to the next, `(T, J)`, NaN outside of windows."""
    start = field.residuals.start[:, None]
    steps = np.diff(np.concatenate([start, paths], 1), axis=1)
    found = []
    for number, recording in enumerate(field.recordings):
        by_sample = np.full(recording.q.shape, np.nan)
        for window in np.flatnonzero(field.source == number):
            # A step belongs to the sample at which it begins.
            first = field.row[window] - 1
            by_sample[first : first + steps.shape[1]] = steps[window]
        found.append(by_sample)
    return found


def _compare_curves(
    measured: FittedCurve, simulated: FittedCurve, knots: np.ndarray, scatter: Sequence[np.ndarray]
) -> CurveDifference:
    """Return what changes the simulated curve into the measured one, with standard errors.

    Numbers within `MIN_SCORE` standard errors of no effect are left out one by one: dead band,
    saturation and gains replace each other where few commands were large.
    """
    size = len(measured.curve)
    information = measured.information
    root = np.linalg.cholesky(information + 1e-9 * np.trace(information) * np.eye(size)).T
    weight = root / max(1e-9, float(np.sqrt(np.mean(np.square(root @ measured.curve)))))
    extend, retract = np.logical_and(measured.sides, simulated.sides).tolist()
    # A side that was hardly commanded shows nothing: its numbers stay neutral.
    free = np.array([extend, retract, extend or retract, extend, retract])
    while True:
        values, error = _fit_change(measured, simulated, knots, weight, free, scatter)
        score = np.abs(values - NEUTRAL) / np.maximum(error, 1e-9)
        if not free.any() or score[free].min() >= MIN_SCORE:
            break
        free[np.flatnonzero(free)[score[free].argmin()]] = False
    added, of_added = _compare_dynamics(measured, simulated, scatter)
    return CurveDifference(
        measured, simulated, np.concatenate([values, added]), np.concatenate([error, of_added])
    )


def _fit_change(
    measured: FittedCurve,
    simulated: FittedCurve,
    knots: np.ndarray,
    weight: np.ndarray,
    free: np.ndarray,
    scatter: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return `CURVE_NUMBERS` and their standard errors, `(5,)` each; those not `free` stay neutral."""
    values, error = NEUTRAL.copy(), np.zeros(len(NEUTRAL))
    if not free.any():
        return values, error
    size = len(measured.curve)

    def compute_left(x: np.ndarray, curve: np.ndarray, target: np.ndarray) -> np.ndarray:
        numbers = NEUTRAL.copy()
        numbers[free] = x
        changed = change_curve(curve, knots, numbers)
        return np.concatenate([weight @ (changed - target), NEUTRAL_PULL * (x - NEUTRAL[free])])

    bounds = [BAND_BOUNDS, BAND_BOUNDS, LEVEL_BOUNDS, GAIN_BOUNDS, GAIN_BOUNDS]
    low, high = np.array(bounds).T[:, free]
    best = None
    for start in _list_starts(measured.curve, simulated.curve, knots):
        inside = np.clip(start[free], low + 1e-6, high - 1e-6)
        given = (simulated.curve, measured.curve)
        one = least_squares(compute_left, inside, bounds=(low, high), diff_step=1e-3, args=given)
        best = one if best is None or one.cost < best.cost else best
    assert best is not None
    step, base = np.linalg.pinv(best.jac), compute_left(best.x, simulated.curve, measured.curve)
    drawn = []
    for theirs, mine in zip(simulated.draws[1:], measured.draws[1:], strict=True):
        drawn.append(step @ (compute_left(best.x, theirs[:size], mine[:size]) - base))
    variance = np.var(drawn, axis=0)
    if len(scatter) > 1:
        moved = [step @ compute_left(best.x, one[:size], measured.curve) for one in scatter]
        variance = variance + _compute_jackknife_variance(np.stack(moved))
    values[free], error[free] = best.x, np.sqrt(variance)
    return values, error


def _compute_jackknife_variance(values: np.ndarray) -> np.ndarray:
    """Return the variance of an estimate from its values with a part left out each, `(parts, …)`."""
    return (len(values) - 1) * np.var(values, axis=0)


def _compare_dynamics(
    measured: FittedCurve, simulated: FittedCurve, scatter: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return `ADDED` and their standard errors, `(3,)` each."""
    size, sums = len(measured.curve), np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]])
    drawn = (measured.draws - simulated.draws)[1:, size:] @ sums.T
    variance = np.var(drawn, axis=0)
    if len(scatter) > 1:
        variance = variance + _compute_jackknife_variance(np.stack(scatter)[:, size:] @ sums.T)
    return sums @ (measured.dynamics - simulated.dynamics), np.sqrt(variance)


def change_curve(curve: np.ndarray, knots: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return a speed curve `(C,)` with dead band, saturation and gains, `CURVE_NUMBERS`.

    A command is first cut at the saturation; beyond the dead band it then rises to a full one. This
    is the order in which the effects of the library act. A negative dead band is one that the
    simulator has and the machine lacks.
    """
    half, changed = len(knots) - 1, []
    for side, (band, gain) in enumerate(zip(numbers[:2], numbers[3:], strict=True)):
        own = np.concatenate([[0.0], curve[side * half : (side + 1) * half]])
        command = np.minimum(knots, numbers[2])
        opened = np.maximum(command - band, 0.0) / (1.0 - band)
        changed.append(gain * np.interp(opened, knots, own)[1:])
    return np.concatenate(changed)


def _list_starts(
    measured: np.ndarray, simulated: np.ndarray, knots: np.ndarray
) -> list[np.ndarray]:
    """Return numbers from which to begin: nothing, and what the measured curve shows to the eye."""
    half, shown = len(knots) - 1, NEUTRAL.copy()
    levels = []
    for side in (0, 1):
        mine, own = slice(side * half, (side + 1) * half), knots[1:]
        fast = measured[mine].max()
        moving = own[measured[mine] > 0.05 * fast]
        shown[side] = max(0.0, float(moving[0]) - 0.05) if len(moving) else 0.0
        levels.append(float(own[np.argmax(measured[mine] > 0.9 * fast)]))
    shown[2] = min(1.0, max(levels))
    plain = change_curve(simulated, knots, shown)
    for side in (0, 1):
        mine = slice(side * half, (side + 1) * half)
        shown[3 + side] = measured[mine].max() / max(1e-3, float(plain[mine].max()))
    middle = 0.5 * (shown + NEUTRAL)
    return [NEUTRAL, shown, middle]


def serialize_curves(curves: SpeedCurves) -> dict[str, Any]:
    """Return the curves for `diagnosis.json`: knots, both curves with intervals, their difference.

    Speeds are parts of the machine's full speed. A number of the difference that is not needed is
    `null`.
    """
    found: dict[str, Any] = {}
    for name, one in curves.joints.items():
        difference = {}
        for key, estimate in one.estimates().items():
            difference[key] = estimate and serialize_estimate(estimate)
        points = one.measured.points
        every = -(-len(points) // MAX_POINTS)
        found[name] = {
            "measured": _serialize_curve(one.measured, len(curves.knots)),
            "simulated": _serialize_curve(one.simulated, len(curves.knots)),
            "difference": difference,
            "points": points[::every].round(4).tolist(),
        }
    return {"knots": curves.knots.tolist(), "joints": found}


def _serialize_curve(one: FittedCurve, num_knots: int) -> dict[str, Any]:
    half = num_knots - 1
    low, high = np.quantile(one.draws[:, : 2 * half], [0.025, 0.975], 0)
    sides = {}
    for side, mine in (("extend", slice(0, half)), ("retract", slice(half, 2 * half))):
        sides[side] = {
            "speed": [0.0, *one.curve[mine].tolist()],
            "low": [0.0, *np.minimum(low[mine], one.curve[mine]).tolist()],
            "high": [0.0, *np.maximum(high[mine], one.curve[mine]).tolist()],
        }
    return {**sides, **dict(zip(DYNAMICS, one.dynamics.tolist(), strict=True))}
