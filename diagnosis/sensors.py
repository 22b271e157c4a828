"""Noise of sensors, from the scatter of samples; free runs are too coarse.

The scatter of second differences is measured at rest and in motion. White noise of variance `v` adds `6 v`
to its square, so that every size has a likelihood, given the scatter of the parts of the reference.
Axes: `T` time, `J` joints, `P` parts of the reference, `S` sizes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import Estimate
from diagnosis.case import GapCase, split_recordings
from diagnosis.effect_library import DetectedEffect, EffectType, estimate_interval
from diagnosis.engine.direct import find_lattice
from diagnosis.engine.side import stack_side
from diagnosis.engine.sizes import SIGMAS, get_form_error

SIZES = np.geomspace(0.05, 40.0, 40)
"""Sizes that are tried, of typical; steps of 19 %, up to what a broken sensor shows. Steps chosen by
hand."""
MIN_ADDED_SCATTER = 1.0
"""Least noise that is added, over that of the reference's own sensor: what adds less is not seen in
motion. On 120 answers from practice plants of other making, faults that were there reached 6 or
more, and those named without being there 0.6 at most."""
REST_SPEED, MOVING_SPEED = 0.01, 0.08
"""Mean speed over a second, of full speed, below which a joint rests and above which it moves;
chosen by hand."""
SCATTER_SIGMA = 0.08
"""Standard deviation of the logarithm of the scatter from day to day; chosen by hand: larger ones miss
faint effects, smaller ones add false alarms."""
MAX_GAIN = 60.0
"""Largest gain in log likelihood that counts; chosen by hand: the statistics are no exact
likelihood."""
WHITE_NOISE_FACTOR = 6.0
"""Variance of the second differences of white noise over its own: 1 + 4 + 1."""
FLOAT_NOISE = 2e-6
"""Resolution of float32 at 16 rad or m."""


def measure_scatter(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Return the logarithm of the scatter of each recording at rest and in motion, `(P, J, 2)`; NaN where too short."""
    second = max(2, round(1.0 / machine.period_s))
    found = np.full((len(recordings), machine.num_joints, 2), np.nan)
    for number, recording in enumerate(recordings):
        q = recording.q.astype(float)
        speed = np.zeros_like(q)
        speed[second // 2 : second // 2 + len(q) - second] = (q[second:] - q[:-second]) / second
        speed = np.abs(speed[1:-1]) / (machine.max_speed * machine.period_s)
        bend = np.abs(np.diff(q, 2, axis=0))
        for j in range(machine.num_joints):
            states = (speed[:, j] < REST_SPEED, speed[:, j] > MOVING_SPEED)
            for place, rows in enumerate(states):
                if rows.sum() >= 3 * second:
                    cut = np.minimum(bend[rows, j], 4 * np.sqrt(np.mean(bend[rows, j] ** 2)))
                    found[number, j, place] = np.log(np.sqrt(np.mean(cut**2)) + FLOAT_NOISE)
    return found


def find_sensor_noise(
    case: GapCase, kind: EffectType, price: float, name_price: float
) -> DetectedEffect | None:
    """Return the noise that the scatter of the field's samples shows; `None` without any."""
    reference, machine = split_recordings(case.reference, case.machine), case.machine
    if len(reference) < 2:
        return None
    seen = _compute_mean(measure_scatter(case.field, machine))
    plain = measure_scatter(reference, machine)
    (name,) = kind.fitted
    sizes = SIZES[:, None] * kind.size(name)
    noisy = []
    for added in WHITE_NOISE_FACTOR * sizes**2:
        noisy.append(0.5 * np.log(np.exp(2.0 * plain) + added[:, None]))
    likelihood = np.stack([_compute_likelihood(seen, one, plain) for one in noisy])
    gain = np.minimum(likelihood.max(0) - _compute_likelihood(seen, plain, plain), MAX_GAIN)
    best = likelihood.argmax(0)
    joints = np.arange(machine.num_joints)
    mask = gain > price
    mask &= sizes[best, joints] >= MIN_ADDED_SCATTER * estimate_sensor_noise(reference)
    sides = stack_side(case.field, machine), stack_side(case.reference, machine)
    for j in np.flatnonzero(mask).tolist():
        # The steps of a coarse sensor scatter as well.
        mask[j] = find_lattice(*sides, j) == 0.0
    worth = float((gain[mask] - price).sum()) - name_price
    if worth <= 0.0:
        return None
    parameters = {}
    for j in np.flatnonzero(mask).tolist():
        size, low, high = estimate_interval(sizes[:, j], likelihood[:, j])
        own = np.log(high / low) / (2.0 * SIGMAS)
        factor = np.exp(SIGMAS * np.hypot(own, get_form_error(kind.name)))
        parameters[machine.joint_names[j]] = Estimate(size, (size / factor, size * factor))
    after = _compute_mean(np.stack(noisy)[best, :, joints].swapaxes(0, 1))
    closed = _compute_closed_share(seen[mask], after[mask], _compute_mean(plain)[mask])
    earned = float(gain[mask].sum())
    return DetectedEffect(kind, mask, {name: parameters}, worth, earned, closed)


def estimate_sensor_noise(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the standard deviation of the noise of each sensor, `(J,)`, from third differences.

    The median makes edges of motions, which are few, count little. White noise of 1 has third
    differences of sqrt(20).
    """
    third = [np.diff(recording.q.astype(float), 3, axis=0) for recording in recordings]
    # 0.6745: median absolute value of a standard normal. 20 = 1 + 9 + 9 + 1, the squared weights.
    return np.median(np.abs(np.concatenate(third)), 0) / 0.6745 / np.sqrt(20.0)


def _compute_closed_share(seen: np.ndarray, after: np.ndarray, before: np.ndarray) -> float:
    """Return the share of the squared difference of the scatter that the noise explains."""
    left, whole = np.nansum(np.square(seen - after)), np.nansum(np.square(seen - before))
    return float(np.clip(1.0 - left / whole, 0.0, 1.0))


def _compute_likelihood(seen: np.ndarray, drawn: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Return the log likelihood of the field's scatter given that of the parts, `(J,)`.

    Parts scatter at least as they do without noise, `plain` `(P, J, 2)`: a few of them may agree by
    chance.
    """
    variance = np.fmax(_compute_variance(drawn), _compute_variance(plain))
    variance = variance * (1.0 + 1.0 / len(drawn)) + SCATTER_SIGMA**2
    off = np.square(seen - _compute_mean(drawn)) / variance
    return -0.5 * np.nansum(off + np.where(np.isfinite(off), np.log(variance), 0.0), 1)


def _compute_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over parts `(P, …)` that have a value; NaN where none has."""
    told = np.isfinite(values)
    count = told.sum(0)
    return np.where(count > 0, np.where(told, values, 0.0).sum(0) / np.maximum(count, 1), np.nan)


def _compute_variance(values: np.ndarray) -> np.ndarray:
    """Return the variance over parts `(P, …)` that have a value; NaN where fewer than two have."""
    told = np.isfinite(values)
    count = told.sum(0)
    squares = np.square(np.where(told, values - _compute_mean(values), 0.0)).sum(0)
    return np.where(count > 1, squares / np.maximum(count - 1, 1), np.nan)
