"""Findings that need no fit of sizes: coarse sensors, and joints that stand still in the middle of a motion.

Axes: `T` samples.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter1d

from diagnosis.engine.evidence import RowEvidence
from diagnosis.engine.side import Side

STEPS = np.geomspace(0.004, 0.2, 240)
"""Steps of a coarse sensor that are tried, units."""
THINNED_S = 0.35
"""Positions nearer in time repeat each other."""
MAX_POSITIONS = 300
MIN_POSITIONS = 25
STEADY_UNITS = 0.006
"""Simulated motion over a quarter of a second, all around, that counts as steady."""
STILL_UNITS = 0.0032
MOVING_UNITS = 0.008
"""Measured motion over a quarter of a second that counts as standing still, and as moving again."""
TRAVELLED_UNITS = 0.012
"""Motion before a stall; a joint that has not started yet does not stall."""
NOISE_UNITS = 0.0013
"""Noise of an increment for which these limits hold; with more of it they grow in proportion."""


def find_step(side: Side, joint: int) -> tuple[float, float]:
    """Return evidence that positions lie on a lattice, nats, and its step, units.

    The evidence is the concentration of the positions modulo the step, as in a test of a circular
    distribution.
    """
    stride = side.count(THINNED_S)
    picked = []
    for begin, end in zip(side.starts, side.ends, strict=True):
        picked.append(side.q[begin + side.count(1.0) : end : stride, joint])
    q = np.concatenate(picked)
    best = (0.0, 0.0)
    for step in STEPS:
        moved = np.abs(np.diff(q, prepend=q[0] + 1.0)) > 0.3 * step
        count = int(moved.sum())
        if count < MIN_POSITIONS:
            continue
        length = float(np.abs(np.exp(2j * np.pi * q[moved] / step).mean()))
        nats = min(count, MAX_POSITIONS) * (length**2 + 2.0 * max(length - 0.5, 0.0) ** 2)
        if nats > best[0]:
            best = (nats, float(step))
    return best


def count_stalls(side: Side, joint: int, path: np.ndarray, noise: float) -> tuple[int, int]:
    """Return how often a joint stands still within steady simulated motion, and the samples of such motion.

    Args:
        side: The recordings.
        joint: Place of the joint.
        path: Simulated path, `(T,)`, units.
        noise: Standard deviation of an increment at rest, units; motions below are none.
    """
    floor = noise / NOISE_UNITS
    still_limit, moving, travelled = (
        max(1.0, floor) * limit for limit in (STILL_UNITS, MOVING_UNITS, TRAVELLED_UNITS)
    )
    h = side.count(0.25)
    q = side.q[:, joint]
    simulated, measured = np.zeros(side.num_samples), np.zeros(side.num_samples)
    simulated[:-h] = path[h:] - path[:-h]
    measured[:-h] = q[h:] - q[:-h]
    for begin in side.starts:
        simulated[max(0, begin - side.count(0.4)) : begin + side.count(1.5)] = 0.0
    width = 2 * side.count(0.3) + 1
    steady_limit = max(1.0, floor) * STEADY_UNITS
    steady = minimum_filter1d(simulated, width) > steady_limit
    steady |= minimum_filter1d(-simulated, width) > steady_limit
    still = steady & (np.abs(measured) < still_limit) & (np.abs(simulated) > moving)
    before = q[np.maximum(np.arange(side.num_samples) - side.count(0.6), 0)]
    count, is_stalled = 0, False
    for k in np.flatnonzero(steady):
        if k == 0 or not steady[k - 1]:
            is_stalled = False
        if still[k] and not is_stalled and abs(q[k] - before[k]) > travelled:
            count += 1
            is_stalled = True
        elif abs(measured[k]) > moving:
            is_stalled = False
    return count, int(steady.sum())


def weigh_stalls(evidence: RowEvidence, joint: int, numbers: np.ndarray) -> float:
    """Return the evidence that a joint with numbers `(P,)` stalls more often on the field than on the reference, nats (Poisson)."""
    base = evidence.bases[joint]
    noise = float(np.sqrt(base.scale.coefficients[0] + 2.0 * evidence.noises[joint] ** 2))
    seen = []
    for side, own in ((evidence.field, numbers), (evidence.reference, base.numbers)):
        path = side.simulate(joint, own)[0].astype(float)
        seen.append(count_stalls(side, joint, path, noise))
    (count, samples), (known, known_samples) = seen
    expected = (known + 0.5) * samples / max(known_samples, 1)
    if count <= expected:
        return 0.0
    return float(count * np.log(count / expected) - (count - expected))
