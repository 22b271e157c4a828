"""Noise and quantisation of sensors, from the scatter of samples; free runs are too coarse.

A few statistics describe each recording, by joint. An effect is put onto recordings of the
reference at several sizes. The most likely size has the statistics that are nearest to those of the
field.
Axes: `T` time, `J` joints, `P` parts of the reference, `F` statistics.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import Estimate
from diagnosis.case import GapCase, split_recordings
from diagnosis.effect_library import DetectedEffect, EffectType, StationaryModel, estimate_interval

SIZES = np.geomspace(0.05, 6.0, 25)
"""Sizes that are tried, of typical; steps of 22 %, chosen by hand."""
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
    field, reference, machine = case.field, split_recordings(case.reference), case.machine
    if len(reference) < 2:
        return []
    kinds = [
        kind
        for kind in kinds
        if kind.target.side == "measurement" and (kind.target.stochastic or not kind.target.smooth)
    ]
    seen = np.nanmean([compute_scatter_statistics(r.q.astype(float), machine) for r in field], 0)
    plain = np.stack(
        [compute_scatter_statistics(r.q.astype(float), machine) for r in reference]
    )  # (P, J, F)
    none = _compute_likelihood(seen, plain, plain)
    drawn = {
        kind.name: [_simulate_statistics(kind, size, reference, machine) for size in SIZES]
        for kind in kinds
    }
    likelihood = {
        name: np.stack([_compute_likelihood(seen, one, plain) for one in by_size])
        for name, by_size in drawn.items()
    }
    highest = {name: values.max(0) for name, values in likelihood.items()}
    gain = {name: np.minimum(values - none, MAX_GAIN) for name, values in highest.items()}
    best = (
        [max(highest, key=lambda name: highest[name][j]) for j in range(machine.num_joints)]
        if highest
        else []
    )
    found = []
    for kind in kinds:
        mask = np.array(
            [best[j] == kind.name and gain[kind.name][j] > price for j in range(machine.num_joints)]
        )
        worth = float((gain[kind.name][mask] - price).sum()) - name_price
        if worth <= 0:
            continue
        parameters: dict[str, dict[str, Estimate]] = {}
        for j in np.flatnonzero(mask):
            ends = np.array(estimate_interval(SIZES, likelihood[kind.name][:, j]))
            for name in kind.fitted:
                mean, low, high = kind.numbers[name].none + kind.size(name) * ends
                parameters.setdefault(name, {})[machine.joint_names[j]] = Estimate(
                    float(mean), (float(low), float(high))
                )
        earned = float(gain[kind.name][mask].sum())
        rivals = {
            name: earned - float((highest[kind.name] - highest[name])[mask].sum())
            for name in gain
            if name != kind.name
        }
        after = np.stack(
            [
                drawn[kind.name][int(np.argmax(row))].mean(0)[j]
                for j, row in enumerate(likelihood[kind.name].T)
            ]
        )
        closed = 1.0 - np.nansum(np.square((seen - after) / STATISTICS_SIGMA)[mask]) / np.nansum(
            np.square((seen - plain.mean(0)) / STATISTICS_SIGMA)[mask]
        )
        found.append(
            DetectedEffect(
                kind, mask, parameters, worth, earned, float(np.clip(closed, 0.0, 1.0)), rivals
            )
        )
    return found


def _compute_likelihood(seen: np.ndarray, drawn: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Return the log likelihood of the field's statistics given those of the parts, `(J,)`.

    Parts scatter at least as they do without an effect, `plain` `(P, J, F)`: a few of them may
    agree by chance.
    """
    variance = (
        np.fmax(np.nanvar(drawn, 0, ddof=1), np.nanvar(plain, 0, ddof=1)) * (1.0 + 1.0 / len(drawn))
        + STATISTICS_SIGMA**2
    )
    off = np.square(seen - np.nanmean(drawn, 0)) / variance
    return -0.5 * np.nansum(off + np.where(np.isfinite(off), np.log(variance), 0.0), 1)


def _simulate_statistics(
    kind: EffectType, size: float, reference: Sequence[Recording], machine: Machine
) -> np.ndarray:
    """Return the statistics of the reference with an effect on all joints, `(P, J, F)`."""
    found = []
    for recording in reference:
        q = torch.as_tensor(recording.q, dtype=torch.float32)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            model = kind.wrap(StationaryModel(), machine, len(q), torch.device("cpu"))
        for name in kind.fitted:
            value = kind.clipped(name, np.array(kind.numbers[name].none + size * kind.size(name)))
            model.parameters[name].fill_(float(value))
        with torch.inference_mode():
            found.append(
                compute_scatter_statistics(model.measure(q).numpy().astype(float), machine)
            )
    return np.stack(found)
