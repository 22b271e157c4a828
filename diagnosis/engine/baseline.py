"""The machine as it was: the numbers of each joint fitted to the reference, with each part left out once.

What a part errs by, when the numbers were fitted to the others, shows the noise of the machine.
Axes: `T` samples, `N` increments, `P` numbers, `F` fitted numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.engine import joint_model
from diagnosis.engine.measure import (
    PLAIN,
    IncrementMeasure,
    Motion,
    Scale,
    fit_memory,
    fit_variance,
    measure_motion,
)
from diagnosis.engine.side import Side

NUM_PARTS = 4
"""Parts of the reference that are left out in turn."""
FIRST_DELAYS_S = np.arange(0.0, 0.9, 0.05)
FITTED = np.flatnonzero(joint_model.FITTED)
MEAN = joint_model.list_values("mean")
DEVIATION = joint_model.list_values("deviation")[FITTED]
STEP = joint_model.list_values("step")[FITTED]
LOWER = joint_model.list_values("lower")
UPPER = joint_model.list_values("upper")
PLACE = joint_model.PLACE
POOLED = 0.15
"""Share of the mean of all joints in the variance of each."""
ENOUGH = 2e-4
"""Relative gain of a round below which a fit ends."""


@dataclass
class JointBaseline:
    """One joint of the reference.

    Attributes:
        numbers: Its numbers, `(P,)`.
        scale: Variance and memory of its increments.
        measure: Map from paths of the reference to increments.
        motion: Motion of the simulated joint.
        left_out: Increments of the error of each part, numbers fitted to the others, `(N,)`.
        part: Part of each increment, `(N,)`.
        spread: Mean square of `left_out`.
        covariance: Of the fitted numbers, `(F, F)`.
        frame_variance: Coefficients of the variance of one sample's step.
        error: Recorded less simulated path of each part, numbers fitted to the others, `(T,)`,
            units.
    """

    numbers: np.ndarray
    scale: Scale
    measure: IncrementMeasure
    motion: Motion
    left_out: np.ndarray
    part: np.ndarray
    spread: float
    covariance: np.ndarray
    frame_variance: np.ndarray
    error: np.ndarray


def linearise(
    side: Side, joint: int, numbers: np.ndarray, measure: IncrementMeasure
) -> tuple[np.ndarray, np.ndarray]:
    """Return the increments of the simulated joint `(N,)` and their slopes over the fitted numbers `(F, N)`."""
    varied = np.repeat(numbers[None], 1 + len(FITTED), 0)
    fits = numbers[FITTED] + STEP <= UPPER[FITTED]
    steps = np.where(fits, STEP, -STEP)
    varied[1 + np.arange(len(FITTED)), FITTED] += steps
    found = measure(side.simulate(joint, varied)).astype(float)
    return found[0], (found[1:] - found[0]) / steps[:, None]


def fit_numbers(
    side: Side,
    joint: int,
    numbers: np.ndarray,
    measure: IncrementMeasure,
    rounds: int,
    fixed: Sequence[str] = (),
) -> np.ndarray:
    """Return the numbers of a joint after some rounds of Levenberg's and Marquardt's method, `(P,)`."""
    target = measure(side.q[:, joint]).astype(float)
    names = np.array(joint_model.NAMES)[FITTED]
    rows = np.flatnonzero(~np.isin(names, fixed))
    free = FITTED[rows]

    def compute_cost(tried: np.ndarray, increments: np.ndarray) -> float:
        off = (tried[FITTED] - MEAN[FITTED]) / DEVIATION
        return float(np.square(target - increments).sum() + np.square(off).sum())

    damping = 1e-3
    for _ in range(rounds):
        base, slopes = linearise(side, joint, numbers, measure)
        before = compute_cost(numbers, base)
        slopes = slopes[rows]
        precision = 1.0 / DEVIATION[rows] ** 2
        normal = slopes @ slopes.T + np.diag(precision)
        downhill = slopes @ (target - base) - (numbers[free] - MEAN[free]) * precision
        # All dampings are simulated at once: a step costs one call of the kernel.
        trials = np.repeat(numbers[None], 4, 0)
        for k, trial in enumerate(trials):
            damped = normal + damping * 8.0**k * np.diag(np.diag(normal))
            trial[free] += np.linalg.solve(damped, downhill)
        trials = np.clip(trials, LOWER, UPPER)
        tried = measure(side.simulate(joint, trials)).astype(float)
        costs = [compute_cost(one, row) for one, row in zip(trials, tried, strict=True)]
        best = int(np.argmin(costs))
        if costs[best] >= before:
            break
        numbers = trials[best]
        damping *= 8.0**best / 6.0
        if (before - costs[best]) / before < ENOUGH:
            break
    return numbers


def guess_numbers(side: Side, joint: int) -> np.ndarray:
    """Return numbers to begin with: the delay and the speed that fit best, `(P,)`."""
    measure = IncrementMeasure(side, PLAIN)
    trials = np.repeat(MEAN[None], len(FIRST_DELAYS_S), 0)
    trials[:, PLACE["delay_s"]] = FIRST_DELAYS_S
    trials[:, PLACE["pump_load"]] = 0.0
    found = measure(side.simulate(joint, trials)).astype(float)
    target = measure(side.q[:, joint]).astype(float)
    gains = found @ target / np.maximum(np.square(found).sum(1), 1e-9)
    errors = np.square(target - gains[:, None] * found).sum(1)
    best = int(np.argmin(errors))
    numbers = trials[best]
    speed = np.clip(MEAN[PLACE["speed_out"]] * gains[best], 0.02, 2.0)
    numbers[[PLACE["speed_out"], PLACE["speed_in"]]] = speed
    return numbers


def split_parts(side: Side) -> np.ndarray:
    """Return the part of each sample, `(T,)`: whole recordings where there are enough."""
    edges = side.starts
    if len(edges) < NUM_PARTS:
        edges = np.linspace(0, side.num_samples, NUM_PARTS + 1).astype(int)[:-1]
    elif len(edges) > NUM_PARTS:
        places = np.linspace(0, len(edges), NUM_PARTS + 1).astype(int)[:-1]
        edges = edges[places]
    return np.searchsorted(edges, np.arange(side.num_samples), "right") - 1


def fit_reference(side: Side) -> list[JointBaseline]:
    """Return the baseline of every joint; the demand of `side` is set on the way."""
    joints = range(side.num_joints)
    plain = IncrementMeasure(side, PLAIN)
    shared = ("droop", "pump_load")
    every = [guess_numbers(side, j) for j in joints]
    every = [fit_numbers(side, j, every[j], plain, 4, shared) for j in joints]
    side.ask_others(every)
    for numbers in every:
        numbers[PLACE["pump_load"]] = MEAN[PLACE["pump_load"]]
    every = [fit_numbers(side, j, every[j], plain, 6) for j in joints]
    side.ask_others(every)
    first = [_leave_out(side, j, every[j], PLAIN, None) for j in joints]
    side.ask_others(every)
    scales = _fit_scales(side, first)
    found = []
    for j in joints:
        motion = measure_motion(side, side.simulate(j, every[j])[0])
        measure = IncrementMeasure(side, scales[j], motion)
        numbers = fit_numbers(side, j, every[j], measure, 5)
        found.append(_leave_out(side, j, numbers, scales[j], motion).baseline)
    side.ask_others([one.numbers for one in found])
    return found


@dataclass
class _LeftOut:
    """A baseline with the errors of its parts in units, `(N,)` over an interval."""

    baseline: JointBaseline
    increments: np.ndarray


def _leave_out(
    side: Side, joint: int, numbers: np.ndarray, scale: Scale, motion: Motion | None
) -> _LeftOut:
    """Fit the numbers without each part by one step of Gauss and Newton, and keep what each part then errs by."""
    measure = IncrementMeasure(side, scale, motion)
    base, slopes = linearise(side, joint, numbers, measure)
    target = measure(side.q[:, joint]).astype(float)
    residual = target - base
    every = split_parts(side)
    part = every[: len(residual)]
    precision = 1.0 / DEVIATION**2
    normal = slopes @ slopes.T + np.diag(precision)
    downhill = slopes @ residual - (numbers[FITTED] - MEAN[FITTED]) * precision
    trials = np.repeat(numbers[None], NUM_PARTS, 0)
    for k, trial in enumerate(trials):
        own = part == k
        without = normal - slopes[:, own] @ slopes[:, own].T
        step = np.linalg.solve(without, downhill - slopes[:, own] @ residual[own])
        trial[FITTED] += np.clip(step, -6.0 * STEP, 6.0 * STEP)
    paths = side.simulate(joint, np.clip(trials, LOWER, UPPER))
    errors = side.q[:, joint] - paths
    h = measure.interval
    rows = np.arange(len(residual))
    left_out = (target - measure(paths))[part, rows]
    increments = (errors[:, h:] - errors[:, :-h])[part, rows]
    frames = (errors[:, 1:] - errors[:, :-1])[part, rows]
    spread = float(np.square(np.clip(left_out, -3.0, 3.0)).sum() / measure.count)
    if motion is None:
        motion = measure_motion(side, side.simulate(joint, numbers)[0])
    baseline = JointBaseline(
        numbers=numbers,
        scale=scale,
        measure=measure,
        motion=motion,
        left_out=left_out,
        part=part,
        spread=spread,
        covariance=np.linalg.inv(normal / max(spread, 1e-3)),
        frame_variance=fit_variance(frames, motion, measure.valid),
        error=errors[every, np.arange(side.num_samples)],
    )
    return _LeftOut(baseline, increments)


def _fit_scales(side: Side, parts: Sequence[_LeftOut]) -> list[Scale]:
    """Return variance and memory of each joint, the variance partly pooled over joints."""
    own = []
    for one in parts:
        valid = one.baseline.measure.valid
        own.append(fit_variance(one.increments, one.baseline.motion, valid))
    pooled = np.mean(own, 0)
    found = []
    for one, coefficients in zip(parts, own, strict=True):
        mixed = Scale((1.0 - POOLED) * coefficients + POOLED * pooled)
        measure = IncrementMeasure(side, mixed, one.baseline.motion)
        scaled = one.increments * measure.weight
        memory = fit_memory(scaled, measure.interval, measure.valid)
        found.append(Scale(mixed.coefficients, memory))
    return found
