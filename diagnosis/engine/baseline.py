"""The machine as it was: the numbers of each joint fitted to the reference, with each part left out once.

What a part errs by, when the numbers were fitted to the others, shows the noise of the machine.
Axes: `T` samples, `N` increments, `P` numbers, `F` fitted numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diagnosis.engine.descent import Simulate, descend, find_slopes
from diagnosis.engine.measure import (
    PLAIN,
    IncrementMeasure,
    Motion,
    Scale,
    fit_kept,
    fit_memory,
    fit_variance,
    measure_motion,
)
from diagnosis.engine.side import Side

LEAST_SPREAD = 1e-3
"""Least mean square of the error of increments, so that a simulated reference has a covariance."""
NUM_PARTS = 4
"""Parts of the reference that are left out in turn."""
STEP_SHARES = np.array([1.0, 0.5, 0.25, 0.0])
"""Shares of a step towards the numbers without a part that are tried. Left-out parts are likelier so than by whole steps:
those of these machines by 1,966 nats, and those of four tabletop arms (20 joints) by 28,400."""
LONGEST_STEP = 6.0
"""Longest such step, in steps of the finite differences: without a bound the 24 joints are less likely by 577 nats."""
FIRST_DELAYS_S = np.arange(0.0, 0.9, 0.05)
LATE_FACTORS = np.array([0.0, 1.0, 1.4, 2.0, 2.8, 4.0])
"""Multiples of the mean from which numbers that are known late begin; 1 alone told a false lack of flow on two of
six practice cranes, those from 1 on one. Friction that is not there begins at 0: from its mean the fit of a servo
without friction ended worse than it had begun. Their spacing is chosen by hand."""


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
        slopes: Slopes of the increments over the fitted numbers, `(F, N)`.
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
    slopes: np.ndarray
    spread: float
    covariance: np.ndarray
    frame_variance: np.ndarray
    error: np.ndarray


def build_simulation(
    side: Side, joint: int, numbers: np.ndarray, measure: IncrementMeasure, places: np.ndarray
) -> Simulate:
    """Return the increments of a joint with numbers `(P,)` as a function of those at `places`, `(F,)`."""

    def simulate(trials: np.ndarray) -> np.ndarray:
        varied = np.repeat(numbers[None], len(trials), 0)
        varied[:, places] = trials
        return measure(side.simulate(joint, varied))

    return simulate


def linearise(
    side: Side, joint: int, numbers: np.ndarray, measure: IncrementMeasure
) -> tuple[np.ndarray, np.ndarray]:
    """Return the increments of the simulated joint `(N,)` and their slopes over the fitted numbers `(F, N)`."""
    fitted = side.model.fitted
    simulate = build_simulation(side, joint, numbers, measure, fitted)
    return find_slopes(simulate, numbers[fitted], side.model.prior)


def multiply_plain(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the products `(A, B)` of increments `(A, N)` and `(B, N)` that are independent."""
    return left @ right.T


def fit_numbers(
    side: Side, joint: int, numbers: np.ndarray, measure: IncrementMeasure, stage: int
) -> np.ndarray:
    """Return the numbers of a joint, those that are free in a fit fitted to the recordings, `(P,)`.

    Args:
        side: The reference.
        joint: Place of the joint.
        numbers: Where to begin, `(P,)`.
        measure: Map from paths to increments.
        stage: Which of the fits, 0 to 2.
    """
    model = side.model
    is_free = model.list_fitted("joins") <= stage
    places = model.fitted[is_free]
    simulate = build_simulation(side, joint, numbers, measure, places)
    target = measure(side.q[:, joint]).astype(float)
    prior = model.prior.select(is_free)
    found = numbers.copy()
    found[places] = descend(
        simulate, target, multiply_plain, numbers[places], prior, model.fit_rounds[stage]
    )
    return found


def guess_numbers(side: Side, joint: int) -> np.ndarray:
    """Return numbers to begin with: the delay, and the speed of a joint that takes speeds, that fit best, `(P,)`."""
    model = side.model
    measure = IncrementMeasure(side, PLAIN)
    mean = model.list_values("mean")
    trials = np.repeat(mean[None], len(FIRST_DELAYS_S), 0)
    trials[:, model.place["delay_s"]] = FIRST_DELAYS_S
    for name, value in model.late.items():
        trials[:, model.place[name]] = value
    found = measure(side.simulate(joint, trials)).astype(float)
    target = measure(side.q[:, joint]).astype(float)
    if not model.integrates:
        errors = np.square(target - found).sum(1)
        return trials[int(np.argmin(errors))]
    gains = found @ target / np.maximum(np.square(found).sum(1), 1e-9)
    errors = np.square(target - gains[:, None] * found).sum(1)
    best = int(np.argmin(errors))
    numbers = trials[best]
    speed = np.clip(mean[model.place["speed_out"]] * gains[best], 0.02, 2.0)
    numbers[[model.place["speed_out"], model.place["speed_in"]]] = speed
    return numbers


def guess_late(side: Side, joint: int, numbers: np.ndarray) -> np.ndarray:
    """Return the numbers with those that are known late at the multiple of their mean that fits best, `(P,)`.

    A limit that is never reached has no slope, so that no method of descent would find it.
    """
    model = side.model
    measure = IncrementMeasure(side, PLAIN)
    places = [model.place[name] for name in model.late]
    trials = np.repeat(numbers[None], len(LATE_FACTORS), 0)
    trials[:, places] = np.outer(LATE_FACTORS, model.list_values("mean")[places])
    found = measure(side.simulate(joint, trials)).astype(float)
    errors = np.square(measure(side.q[:, joint]) - found).sum(1)
    return trials[int(np.argmin(errors))]


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
    every = [guess_numbers(side, j) for j in joints]
    every = [fit_numbers(side, j, every[j], plain, 0) for j in joints]
    side.ask_others(every)
    every = [guess_late(side, j, every[j]) for j in joints]
    every = [fit_numbers(side, j, every[j], plain, 1) for j in joints]
    side.ask_others(every)
    found = []
    for j in joints:
        first = _leave_out(side, j, every[j], plain)
        measure = IncrementMeasure(side, _fit_scale(side, first), first.motion)
        numbers = fit_numbers(side, j, every[j], measure, 2)
        found.append(_leave_out(side, j, numbers, measure))
    side.ask_others([one.numbers for one in found])
    return found


def _leave_out(
    side: Side, joint: int, numbers: np.ndarray, measure: IncrementMeasure
) -> JointBaseline:
    """Fit the numbers without each part by one step of Gauss and Newton, and keep what each part then errs by.

    Of the whole step and shares of it, the one is taken that fits the other parts best.
    """
    base, slopes = linearise(side, joint, numbers, measure)
    target = measure(side.q[:, joint]).astype(float)
    residual = target - base
    every = split_parts(side)
    part = every[: len(residual)]
    model, fitted = side.model, side.model.fitted
    prior = model.prior
    most = LONGEST_STEP * prior.step
    normal = slopes @ slopes.T + np.diag(prior.precision)
    downhill = slopes @ residual + prior.pull(numbers[fitted])
    rows = prior.find_free(numbers[fitted], downhill)
    errors = np.empty((NUM_PARTS, side.num_samples))
    left_out = np.empty_like(residual)
    for k in range(NUM_PARTS):
        own = part == k
        without = normal - slopes[:, own] @ slopes[:, own].T
        towards = downhill - slopes[:, own] @ residual[own]
        step = np.linalg.solve(without[np.ix_(rows, rows)], towards[rows])
        trials = np.repeat(numbers[None], len(STEP_SHARES), 0)
        trials[:, fitted[rows]] += np.outer(STEP_SHARES, np.clip(step, -most[rows], most[rows]))
        trials = np.clip(trials, model.list_values("lower"), model.list_values("upper"))
        paths = side.simulate(joint, trials)
        left = target - measure(paths)
        off = (trials[:, fitted] - prior.mean) / prior.deviation
        best = np.argmin(np.square(left[:, ~own]).sum(1) + np.square(off).sum(1))
        errors[k] = side.q[:, joint] - paths[best]
        left_out[own] = left[best, own]
    frames = (errors[:, 1:] - errors[:, :-1])[part, np.arange(len(part))]
    spread = float(np.square(np.clip(left_out, -3.0, 3.0)).sum() / measure.count)
    motion = measure_motion(side, side.simulate(joint, numbers)[0])
    return JointBaseline(
        numbers=numbers,
        scale=measure.scale,
        measure=measure,
        motion=motion,
        left_out=left_out,
        part=part,
        slopes=slopes,
        spread=spread,
        covariance=np.linalg.inv(normal / max(spread, LEAST_SPREAD)),
        frame_variance=fit_variance(frames, motion, measure.valid),
        error=errors[every, np.arange(side.num_samples)],
    )


def _fit_scale(side: Side, base: JointBaseline) -> Scale:
    """Return variance and memory of a joint."""
    part = split_parts(side)
    h = base.measure.interval
    # The parts were fitted apart, so that errors jump where one ends.
    valid = base.measure.valid & (part[h:] == part[:-h])
    kept = 1.0 if side.model.integrates else fit_kept(base.error, h, valid)
    increments = base.error[h:] - kept * base.error[:-h]
    scale = Scale(fit_variance(increments, base.motion, valid), (), kept)
    measure = IncrementMeasure(side, scale, base.motion)
    memory = fit_memory(increments * measure.weight, h, valid)
    return replace(scale, memory=memory)
