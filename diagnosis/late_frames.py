"""Smallest random delay or loss of frames that some motions would tell; see `diagnosis.timing`.

Each change of a command shows when it arrived, up to a standard error. Delays by chance scatter these
times. The expected gain in log likelihood is the divergence of the scattered times from those of a
machine on which all frames arrive in time.
Axes: `D` changes of a command, `Q` quadrature points.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from diagnosis.effect_library import EffectType
from diagnosis.residuals import Residuals
from diagnosis.timing import (
    JITTER_SIZES,
    MIN_DELAYS,
    MIN_SCATTER_RATIO,
    TIMING_ERROR,
    CommandChanges,
)

MAX_WINDOWS = 12
"""Free runs of which each change of a command is simulated; they stand for the others. Chosen by
hand: a second of time."""
POINTS = np.linspace(-4.0, 4.0, 33)
"""Quadrature points of an error, in standard errors."""


def find_smallest_lateness(
    residuals: Residuals, kind: EffectType, number: str, price: float, times: float
) -> float | None:
    """Return the smallest size over the typical one that is told; `None` where none is.

    Args:
        residuals: A simulator along the motions.
        kind: Effect on the arrival of commands.
        number: Its number.
        price: Penalty of the effect, nats.
        times: Length of the motions over that of the free runs.
    """
    errors, share = measure_delay_errors(residuals)
    times = times / share
    if len(errors) * times < MIN_DELAYS:
        return None
    period_s = residuals.simulator.machine.period_s
    width = np.hypot(errors, TIMING_ERROR)
    for size in JITTER_SIZES:
        value = kind.numbers[number].none + size * kind.size(number)[:1]
        value = float(kind.clipped(number, value)[0])
        # A number in seconds is the longest of uniform delays, any other a share of late frames.
        if number.endswith("_s"):
            spread = np.full(2, value / period_s / 2.0) * [-1.0, 1.0] / np.sqrt(3.0)
            chances = np.full(2, 0.5)
        else:
            spread, chances = np.array([0.0, 1.0]), np.array([1.0 - value, value])
        variance = chances @ np.square(spread) - (chances @ spread) ** 2
        scatter = np.sqrt(1.0 + variance / np.mean(np.square(errors)))
        gain = times * compute_divergence(width, spread - chances @ spread, chances)
        if gain > price and scatter > MIN_SCATTER_RATIO:
            return float(size)
    return None


def measure_delay_errors(residuals: Residuals) -> tuple[np.ndarray, float]:
    """Return the standard errors of the delays that could be measured, periods, `(D,)`.

    With the share of the free runs that was used.
    """
    cut = residuals.simulator.cut
    count = len(cut.q)
    kept = np.unique(np.linspace(0, count - 1, min(MAX_WINDOWS, count)).round().astype(int))
    some = replace(cut, u=cut.u[kept], q=cut.q[kept], run=cut.run[kept])
    simulator = replace(
        residuals.simulator, cut=some, running_s=residuals.simulator.running_s[kept]
    )
    changes = CommandChanges(Residuals(simulator, residuals.noise, residuals.valid_mask[kept]))
    if not len(changes.responses):
        return np.empty(0), len(kept) / count
    nothing = np.zeros_like(changes.residuals.increments)
    return changes.delays(nothing).error, len(kept) / count


def compute_divergence(width: np.ndarray, spread: np.ndarray, chances: np.ndarray) -> float:
    """Return the expected gain of delays `spread` with these chances over no delays, nats.

    Args:
        width: Errors of the measured delays, periods, `(D,)`.
        spread: Delays that occur, periods.
        chances: Probability of each.
    """
    at = spread[:, None, None] + width[:, None] * POINTS  # (delays, D, Q)
    weight = stats.norm.pdf(POINTS) / stats.norm.pdf(POINTS).sum()
    away = (at[..., None] - spread) / width[:, None, None]
    mixed = (np.exp(-0.5 * np.square(away)) * chances).sum(-1)
    plain = np.exp(-0.5 * np.square(at / width[:, None]))
    ratio = np.log(mixed + 1e-300) - np.log(plain + 1e-300)
    return float((chances[:, None, None] * weight * ratio).sum())
