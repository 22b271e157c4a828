"""Noise and quantisation of sensors, from the scatter of samples; free runs are too coarse.

A few statistics describe each recording, by joint. An effect is put onto recordings of the
reference at several sizes. The most likely size has the statistics that are nearest to those of the
field.
Axes: `T` time, `J` joints, `P` parts of the reference, `F` statistics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel
from brokk_rl.record import Recording
from diagnosis.answer import Estimate
from diagnosis.case import GapCase, split_recordings
from diagnosis.effect_library import DetectedEffect, EffectType, StationaryModel, estimate_interval
from diagnosis.engine.sizes import SIGMAS, get_form_error

SIZES = np.geomspace(0.05, 40.0, 40)
"""Sizes that are tried, of typical; steps of 19 %, up to what a broken sensor shows. Steps chosen by
hand."""
MIN_ADDED_SCATTER = 1.0
"""Least scatter that an effect adds to the positions, over the noise of the reference's own sensor:
what adds less is not seen in motion. On 120 answers from practice plants of other making, faults
that were there reached 6 or more, and those named without being there 0.6 at most."""
REST_SPEED, MOVING_SPEED = 0.01, 0.08
"""Mean speed over a second, of full speed, below which a joint rests and above which it moves;
chosen by hand."""
MIN_STEPS = 20
"""Least number of steps for an estimate of the smallest; chosen by hand."""
STATISTICS_SIGMA = np.array([0.08, 0.08, 0.03, 0.03, 0.08, 0.08])
"""Standard deviation of the statistics from day to day; chosen by hand: larger ones miss faint
effects, smaller ones add false alarms."""
MAX_GAIN = 60.0
"""Largest gain in log likelihood that counts; chosen by hand: the statistics are no exact
likelihood."""
WHITE_NOISE_FACTOR = 6.0
"""Variance of the second differences of white noise over its own: 1 + 4 + 1."""
FLOAT_NOISE = 2e-6
"""Resolution of float32 at 16 rad or m."""


def compute_scatter_statistics(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return scatter, share of equal neighbours and smallest steps, by joint, `(J, F)`.

    Scatter and steps are logarithms. The smallest steps are those of the sensor, where it has any.
    """
    second = max(2, round(1.0 / machine.period_s))
    speed = np.zeros_like(q)
    speed[second // 2 : second // 2 + len(q) - second] = (q[second:] - q[:-second]) / second
    speed = np.abs(speed) / (machine.max_speed * machine.period_s)
    bend, step = np.abs(np.diff(q, 2, axis=0)), np.abs(np.diff(q, axis=0))[1:]
    found = np.full((q.shape[1], 6), np.nan)
    for j in range(q.shape[1]):
        for place, rows in enumerate((speed[1:-1, j] < REST_SPEED, speed[1:-1, j] > MOVING_SPEED)):
            if rows.sum() >= 3 * second:
                cut = np.minimum(bend[rows, j], 4 * np.sqrt(np.mean(bend[rows, j] ** 2)))
                found[j, place] = np.log(np.sqrt(np.mean(cut**2)) + FLOAT_NOISE)
                found[j, 2 + place] = np.mean(step[rows, j] < FLOAT_NOISE / 2)
                moved = step[rows, j][step[rows, j] >= FLOAT_NOISE / 2]
                found[j, 4 + place] = np.log(
                    np.quantile(moved, 0.2) if len(moved) > MIN_STEPS else FLOAT_NOISE
                )
    return found


def measure_excess_scatter(
    field: Sequence[Recording], reference: Sequence[Recording], machine: Machine
) -> np.ndarray:
    """Return the scatter of positions in the field beyond the reference, rad or m, `(J,)`.

    Seen in second differences, at rest or in motion, whichever is more: a joint that rests between
    two steps of a coarse sensor flickers.
    """
    squares = []
    for some in (field, reference):
        seen = np.exp(
            2.0
            * np.stack(
                [compute_scatter_statistics(r.q.astype(float), machine)[:, :2] for r in some]
            )
        )
        told = np.isfinite(seen)
        squares.append(np.where(told, seen, 0.0).sum(0) / np.maximum(told.sum(0), 1))
    now, then = squares
    return np.sqrt(np.maximum(now - then, 0.0).max(1) / WHITE_NOISE_FACTOR)


def find_sensor_effects(
    case: GapCase, kinds: Sequence[EffectType], price: float, name_price: float
) -> list[DetectedEffect]:
    """Return the effects on sensors that the scatter of the field's samples shows."""
    reference, machine = split_recordings(case.reference, case.machine), case.machine
    if len(reference) < 2:
        return []
    seen = _compute_mean(_stack_statistics(case.field, machine))
    plain = _stack_statistics(reference, machine)  # (P, J, F)
    tried = []
    for kind in kinds:
        if kind.target.side == "measurement" and (kind.target.stochastic or not kind.target.smooth):
            tried.append(kind)
    if not tried:
        return []
    found_by_kind = map_parallel(
        lambda kind: _fit_sensor(kind, seen, plain, reference, machine), tried
    )
    # A process returns copies: the effects themselves are those of the library.
    fits = [replace(fit, kind=kind) for fit, kind in zip(found_by_kind, tried, strict=True)]
    none = _compute_likelihood(seen, plain, plain)
    highest = np.stack([fit.likelihood.max(0) for fit in fits])  # (kinds, J)
    gain = np.minimum(highest - none, MAX_GAIN)
    best = highest.argmax(0)
    own = estimate_sensor_noise(reference)
    found = []
    for place, fit in enumerate(fits):
        relevant = fit.added >= MIN_ADDED_SCATTER * own
        mask = (best == place) & (gain[place] > price) & relevant
        worth = float((gain[place][mask] - price).sum()) - name_price
        if worth <= 0:
            continue
        earned = float(gain[place][mask].sum())
        parameters = _estimate_parameters(fit, mask, machine)
        closed = _compute_closed_share(seen[mask], fit.after[mask], plain.mean(0)[mask])
        found.append(DetectedEffect(fit.kind, mask, parameters, worth, earned, closed))
    return found


@dataclass(frozen=True)
class SensorFit:
    """Fit of one effect on sensors, joint by joint.

    Attributes:
        kind: The effect.
        likelihood: Log likelihood at each of `SIZES`, `(S, J)`.
        after: Statistics at the most likely size, `(J, F)`.
        added: Root mean square change of positions at that size, rad or m, `(J,)`.
    """

    kind: EffectType
    likelihood: np.ndarray
    after: np.ndarray
    added: np.ndarray


def _stack_statistics(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Return the statistics of each recording, `(P, J, F)`."""
    return np.stack([compute_scatter_statistics(r.q.astype(float), machine) for r in recordings])


def _fit_sensor(
    kind: EffectType,
    seen: np.ndarray,
    plain: np.ndarray,
    reference: Sequence[Recording],
    machine: Machine,
) -> SensorFit:
    likelihood, means, added = [], [], []
    for size in SIZES:
        measured = [_measure(kind, size, recording, machine) for recording in reference]
        drawn = np.stack([compute_scatter_statistics(one, machine) for one in measured])
        likelihood.append(_compute_likelihood(seen, drawn, plain))
        means.append(_compute_mean(drawn))
        changes = [one - r.q for one, r in zip(measured, reference, strict=True)]
        added.append(np.sqrt(np.mean(np.square(np.concatenate(changes)), 0)))
    best = np.argmax(likelihood, 0)
    joints = np.arange(machine.num_joints)
    return SensorFit(
        kind, np.stack(likelihood), np.stack(means)[best, joints], np.stack(added)[best, joints]
    )


def estimate_sensor_noise(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the standard deviation of the noise of each sensor, `(J,)`, from third differences.

    The median makes edges of motions, which are few, count little. White noise of 1 has third
    differences of sqrt(20).
    """
    third = [np.diff(recording.q.astype(float), 3, axis=0) for recording in recordings]
    # 0.6745: median absolute value of a standard normal. 20 = 1 + 9 + 9 + 1, the squared weights.
    return np.median(np.abs(np.concatenate(third)), 0) / 0.6745 / np.sqrt(20.0)


def _estimate_parameters(
    fit: SensorFit, mask: np.ndarray, machine: Machine
) -> dict[str, dict[str, Estimate]]:
    parameters: dict[str, dict[str, Estimate]] = {}
    for j in np.flatnonzero(mask):
        size, low, high = estimate_interval(SIZES, fit.likelihood[:, j])
        own = np.log(high / low) / (2.0 * SIGMAS)
        factor = np.exp(SIGMAS * np.hypot(own, get_form_error(fit.kind.name)))
        ends = size * np.array([1.0, 1.0 / factor, factor])
        for name in fit.kind.fitted:
            mean, low, high = (
                float(v) for v in fit.kind.numbers[name].none + fit.kind.size(name)[j] * ends
            )
            parameters.setdefault(name, {})[machine.joint_names[j]] = Estimate(mean, (low, high))
    return parameters


def _compute_closed_share(seen: np.ndarray, after: np.ndarray, before: np.ndarray) -> float:
    """Return the share of the squared difference of statistics that an effect explains."""
    left = np.nansum(np.square((seen - after) / STATISTICS_SIGMA))
    whole = np.nansum(np.square((seen - before) / STATISTICS_SIGMA))
    return float(np.clip(1.0 - left / whole, 0.0, 1.0))


def _compute_likelihood(seen: np.ndarray, drawn: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Return the log likelihood of the field's statistics given those of the parts, `(J,)`.

    Parts scatter at least as they do without an effect, `plain` `(P, J, F)`: a few of them may
    agree by chance.
    """
    variance = np.fmax(_compute_variance(drawn), _compute_variance(plain))
    variance = variance * (1.0 + 1.0 / len(drawn)) + STATISTICS_SIGMA**2
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


def _measure(kind: EffectType, size: float, recording: Recording, machine: Machine) -> np.ndarray:
    """Return the positions of a recording, measured with an effect on all joints, `(T, J)`."""
    q = torch.as_tensor(recording.q, dtype=torch.float32)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = kind.wrap(StationaryModel(), machine, len(q), torch.device("cpu"))
    for name in kind.fitted:
        value = kind.clipped(name, kind.numbers[name].none + size * kind.size(name))
        model.parameters[name].copy_(torch.as_tensor(value, dtype=torch.float32))
    with torch.inference_mode():
        return model.measure(q).numpy().astype(float)
