"""Noise of sensors, from the scatter of samples; free runs are too coarse.

The scatter of second differences is measured under steady commands, where neither drive nor late frames add to it.
White noise of variance `v` adds `6 v` to its square, which gives its size. What it earns is the likelihood of the
field's scatter given that of the parts of the reference.
Axes: `T` time, `J` joints, `P` parts of the reference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import Estimate
from diagnosis.case import GapCase, split_recordings
from diagnosis.effect_library import DetectedEffect, EffectType
from diagnosis.engine.decide import DIRECT_NATS, NUMBER_NATS
from diagnosis.engine.direct import find_lattice
from diagnosis.engine.side import stack_side
from diagnosis.engine.sizes import SIGMAS, get_form_error

MIN_ADDED_SCATTER = 1.0
"""Least noise that is added, over that of the reference's own sensor: what adds less is not seen in
motion. On 120 answers from practice plants of other making, faults that were there reached 6 or
more, and those named without being there 0.6 at most."""
STEADY_COMMAND = 0.01
"""Changes of a command over the last second, in all, below which it is steady; chosen by hand."""
SCATTER_SIGMA = 0.08
"""Standard deviation of the scatter from day to day, over its size; chosen by hand: larger ones miss
faint effects, smaller ones add false alarms."""
MAX_GAIN = 60.0
"""Largest gain in log likelihood that counts; chosen by hand: the statistics are no exact
likelihood."""
WHITE_NOISE_FACTOR = 6.0
"""Variance of the second differences of white noise over its own: 1 + 4 + 1."""
FLOAT_NOISE = 2e-6
"""Resolution of float32 at 16 rad or m."""


def measure_scatter(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Return the square root of the scatter of each recording under steady commands, `(P, J)`; NaN where there are too few.

    Coarse steps of a real sensor show now and then only: parts differ tenfold, and logarithms without bound.
    """
    second = max(2, round(1.0 / machine.period_s))
    found = np.full((len(recordings), machine.num_joints), np.nan)
    for number, recording in enumerate(recordings):
        way = np.abs(np.diff(recording.u, axis=0)).cumsum(0)
        bend = np.abs(np.diff(recording.q.astype(float), 2, axis=0))[second - 1 :]
        steady = way[second:] - way[:-second] < STEADY_COMMAND
        for j in range(machine.num_joints):
            own = bend[steady[:, j], j]
            if len(own) >= 3 * second:
                cut = np.minimum(own, 4 * np.sqrt(np.mean(own**2)))
                found[number, j] = np.sqrt(np.sqrt(np.mean(cut**2)) + FLOAT_NOISE)
    return found


def find_sensor_noise(case: GapCase, kind: EffectType) -> DetectedEffect | None:
    """Return the noise that the scatter of the field's samples shows; `None` without any."""
    reference, machine = split_recordings(case.reference, case.machine), case.machine
    if len(reference) < 2:
        return None
    seen = _compute_mean(measure_scatter(case.field, machine))
    plain = measure_scatter(reference, machine)
    base = _compute_mean(plain)
    # Where there are too few steady commands nothing is known to be added.
    added = np.nan_to_num(np.maximum(seen**4 - base**4, 0.0))
    sizes = np.sqrt(added / WHITE_NOISE_FACTOR)
    noisy = (plain**4 + added) ** 0.25
    variance = _compute_variance(noisy, plain)
    gain = _compute_likelihood(seen, noisy, variance)
    gain = gain - _compute_likelihood(seen, plain, _compute_variance(plain, plain))
    gain = np.minimum(gain, MAX_GAIN)
    mask = (gain > NUMBER_NATS) & (sizes >= MIN_ADDED_SCATTER * estimate_sensor_noise(reference))
    sides = stack_side(case.field, machine), stack_side(case.reference, machine)
    for j in np.flatnonzero(mask).tolist():
        # The steps of a coarse sensor scatter as well.
        mask[j] = find_lattice(*sides, j) == 0.0
    worth = float((gain[mask] - NUMBER_NATS).sum()) - DIRECT_NATS
    if worth <= 0.0:
        return None
    parameters = {}
    for j in np.flatnonzero(mask).tolist():
        # The scatter grows by this share of a growth of the noise.
        share = added[j] / (base[j] ** 4 + added[j])
        own = 2.0 * np.sqrt(variance[j]) / seen[j] / share
        factor = np.exp(SIGMAS * np.hypot(own, get_form_error(kind.name)))
        size = float(sizes[j])
        parameters[machine.joint_names[j]] = Estimate(size, (size / factor, size * factor))
    (name,) = kind.fitted
    return DetectedEffect(kind, mask, {name: parameters}, worth, float(gain[mask].sum()))


def estimate_sensor_noise(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the standard deviation of the noise of each sensor, `(J,)`, from third differences.

    The median makes edges of motions, which are few, count little. White noise of 1 has third
    differences of sqrt(20).
    """
    third = [np.diff(recording.q.astype(float), 3, axis=0) for recording in recordings]
    # 0.6745: median absolute value of a standard normal. 20 = 1 + 9 + 9 + 1, the squared weights.
    return np.median(np.abs(np.concatenate(third)), 0) / 0.6745 / np.sqrt(20.0)


def _compute_likelihood(seen: np.ndarray, drawn: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the log likelihood of the field's scatter given that of the parts, `(J,)`; NaN without steady commands."""
    return -0.5 * (np.square(seen - _compute_mean(drawn)) / variance + np.log(variance))


def _compute_variance(drawn: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Return the variance of the field's scatter given that of the parts, `(J,)`.

    Parts scatter at least as they do without noise, `plain` `(P, J)`: a few of them may agree by
    chance.
    """
    found = []
    for values in (drawn, plain):
        # NaN where fewer than two parts have steady commands
        found.append(np.ma.masked_invalid(values).var(0, ddof=1).filled(np.nan))
    usual = 0.5 * SCATTER_SIGMA * _compute_mean(drawn)
    return np.fmax(*found) * (1.0 + 1.0 / len(drawn)) + usual**2


def _compute_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over parts `(P, …)` that have a value; NaN where none has."""
    return np.ma.masked_invalid(values).mean(0).filled(np.nan)
