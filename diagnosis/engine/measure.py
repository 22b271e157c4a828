"""The measure of an error: increments over a short interval, over their scale, less their own past.

The scale follows how much the simulated joint moves and how much its speed changes. The recorded
motion would grow where an effect acts, and hide it.
Axes: `T` samples, `C` candidates, `N` increments (`T` less one interval).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.optimize import nnls

from diagnosis.engine.side import Side

NUM_LAGS = 3
"""Increments of the past that whiten an increment."""
MAX_MOTION = 0.5
"""Largest motion that counts in the scale, units."""
FIRST_VARIANCE = 2.25e-6
"""Variance of an increment before any is known: 1.5 milli units."""
LEAST_VARIANCE = 1e-8
MAX_SQUARE = 12.0
"""One wild sample may not set the scale: its square counts as so many variances."""
LAG_RIDGE = 20.0
"""Weight of no memory at all, in increments."""
COARSE_SPEED = (0.02, 0.17)
"""Variance that a coarse sensor adds, over its step squared: at rest, and at most."""


@dataclass(frozen=True)
class Motion:
    """Motion of a simulated joint near each sample, `(T,)` each, units.

    Attributes:
        travelled: Over an interval.
        changed: Change of that from one interval to the next.
    """

    travelled: np.ndarray
    changed: np.ndarray

    def stack(self) -> np.ndarray:
        """Return the terms of the variance, `(T, 5)`."""
        m, a = self.travelled, self.changed
        return np.stack([np.ones_like(m), m, m**2, a, a**2], 1)


@dataclass(frozen=True)
class Scale:
    """Variance of an increment: non-negative coefficients of `Motion.stack`, and its memory.

    Attributes:
        coefficients: `(5,)`.
        memory: Share of earlier increments in the next, `(NUM_LAGS,)` or empty.
        kept: Share of an error that is still there an interval later; 1 where errors of the speed add up.
        step: Step of a coarse sensor, units; 0: none.
        noise: Standard deviation of noise that a sensor adds, units.
    """

    coefficients: np.ndarray
    memory: tuple[float, ...] = ()
    kept: float = 1.0
    step: float = 0.0
    noise: float = 0.0

    def variance(self, motion: Motion) -> np.ndarray:
        """Return the variance of the increment that begins at each sample, `(T,)`."""
        found = motion.stack() @ self.coefficients + 2.0 * self.noise**2
        if self.step:
            rest, most = COARSE_SPEED
            found = found + self.step**2 * np.minimum(motion.travelled / self.step + rest, most)
        return found


PLAIN = Scale(np.array([FIRST_VARIANCE, 0.0, 0.0, 0.0, 0.0]))


class IncrementMeasure:
    """Linear map from a path of one joint to independent increments of about unit variance.

    Args:
        side: The recordings.
        scale: Variance and memory.
        motion: Motion of the simulated joint.
        used: Samples that count, `(T,)` bool; `None`: all.
    """

    def __init__(
        self, side: Side, scale: Scale, motion: Motion | None = None, used: np.ndarray | None = None
    ) -> None:
        self.interval = side.count(side.model.interval_s)
        self.scale = scale
        valid = find_valid(side)
        if used is not None:
            valid &= used
        variance = FIRST_VARIANCE if motion is None else scale.variance(motion)
        weight = valid / np.sqrt(variance)
        self.valid = valid[: -self.interval]
        self.weight = weight[: -self.interval].astype(np.float32)
        self.count = max(float(self.valid.sum()) / self.interval, 1.0)
        """Number of independent increments, at least one."""

    def __call__(self, path: np.ndarray) -> np.ndarray:
        """Return the increments of paths `(…, T)`, `(…, N)`."""
        h = self.interval
        kept = np.float32(self.scale.kept)
        scaled = (path[..., h:] - kept * path[..., :-h]) * self.weight
        found = scaled.copy()
        for i, share in enumerate(self.scale.memory):
            lag = (i + 1) * h
            found[..., lag:] -= np.float32(share) * scaled[..., :-lag]
        return found / np.float32(np.sqrt(h))


def find_valid(side: Side) -> np.ndarray:
    """Return at which samples an increment begins that lies in one recording, settled, `(T,)` bool."""
    model = side.model
    h, settling = side.count(model.interval_s), side.count(model.settling_s)
    valid = np.ones(side.num_samples, dtype=bool)
    for begin, end in zip(side.starts, side.ends, strict=True):
        valid[begin : begin + settling] = False
        valid[max(begin, end - h) : end] = False
    return valid


def measure_motion(side: Side, path: np.ndarray) -> Motion:
    """Return the motion of a simulated joint, `path` `(T,)`, the largest within a few samples."""
    h = side.count(side.model.interval_s)
    travelled = np.zeros(side.num_samples)
    changed = np.zeros(side.num_samples)
    step = np.abs(path[h:] - path[:-h])
    travelled[:-h] = step
    signed = path[h:] - path[:-h]
    changed[h : -2 * h] = np.abs(signed[2 * h :] - signed[: -2 * h])
    # The response comes somewhat later or earlier than the simulated one.
    near, far = _make_odd(1.4 * h), _make_odd(1.8 * h)
    travelled = maximum_filter1d(travelled, near, origin=-max(1, near // 7))
    changed = maximum_filter1d(changed, far, origin=max(1, far // 4))
    for end in side.ends:
        rest = slice(max(0, end - 3 * h), end)
        travelled[rest] = travelled[max(0, end - 3 * h - 1)]
        changed[rest] = 0.0
    return Motion(np.minimum(travelled, MAX_MOTION), np.minimum(changed, MAX_MOTION))


def _make_odd(width: float) -> int:
    return 2 * int(width // 2) + 1


def fit_variance(increments: np.ndarray, motion: Motion, valid: np.ndarray) -> np.ndarray:
    """Return the coefficients of the variance of increments `(N,)`, by reweighted non-negative least squares."""
    columns = motion.stack()[: len(increments)][valid]
    squares = increments[valid] ** 2
    size = columns.mean(0) + 1e-12
    columns = columns / size
    variance = np.full(len(squares), squares.mean())
    coefficients = np.zeros(columns.shape[1])
    for _ in range(6):
        capped = np.minimum(squares, MAX_SQUARE * variance)
        coefficients, _ = nnls(columns / variance[:, None], capped / variance)
        variance = np.maximum(columns @ coefficients, LEAST_VARIANCE)
    floor = np.zeros(len(size))
    floor[0] = LEAST_VARIANCE
    return np.maximum(coefficients / size, floor)


def fit_kept(error: np.ndarray, interval: int, valid: np.ndarray) -> float:
    """Return which share of an error `(T,)` is still there an interval later."""
    now, later = error[:-interval][valid], error[interval:][valid]
    share = float(now @ later) / max(float(now @ now), LEAST_VARIANCE * len(now))
    return float(np.clip(share, 0.0, 1.0))


def fit_memory(scaled: np.ndarray, interval: int, valid: np.ndarray) -> tuple[float, ...]:
    """Return the share of earlier increments in the next, from increments over their scale `(N,)`."""
    clipped = np.clip(scaled, -4.0, 4.0)
    lagged = []
    for k in range(1, NUM_LAGS + 1):
        lagged.append(np.concatenate([np.zeros(k * interval), clipped[: -k * interval]]))
    past = np.stack(lagged, 1)[valid]
    normal = past.T @ past + LAG_RIDGE * np.eye(NUM_LAGS)
    return tuple(np.linalg.solve(normal, past.T @ clipped[valid]).tolist())
