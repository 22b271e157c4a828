"""Coarse sensors: positions that lie on a lattice."""

from __future__ import annotations

import numpy as np

from diagnosis.engine.side import Side

STEP_BANDS = ((0.0008, 0.02), (0.02, 0.06), (0.06, 0.2))
"""Steps of a coarse sensor that are looked for, units; each band thins the positions by its largest step."""
BIN_UNITS = 1e-4
"""Width of a bin of the histogram: an eighth of the smallest step."""
PADDING = 8
"""Length of the transform over that of the histogram, so that no peak lies between two frequencies."""
PART_SHARE = 0.9
THINNED_S = 0.35
"""Positions nearer in time repeat each other."""
MAX_POSITIONS = 300
MIN_POSITIONS = 25


LATTICE_NATS = 50.0
"""Evidence of a coarse sensor beyond twice that of the reference: 50 practice cases with fine sensors have
at most 26, eight joints with coarse ones 145 and more."""


LATTICE_LENGTH = 0.8
"""Concentration of the positions at rest from which they lie on a lattice: 0.9 to 1.0 on six joints of a real
servo arm, whose logs were brought to one rate, which takes positions in motion off their lattice."""
ALIKE = 1.1
"""Factor within which two steps are of the same sensor: the scale of an encoder is off by some per cent."""
STILL_STEPS = 4.0
"""A joint is at rest that moves by less than such a part of a step in two samples."""


def measure_rests(side: Side, joint: int, step: float) -> float:
    """Return the concentration of the positions at rest modulo a step, units; 0 where there are few."""
    rests = []
    for begin, end in zip(side.starts, side.ends, strict=True):
        q = side.q[begin:end, joint]
        rests.append(q[1:-1][np.abs(q[2:] - q[:-2]) < step / STILL_STEPS])
    q = np.concatenate(rests)
    q = q[np.abs(np.diff(q, prepend=np.inf)) > step / 3.0]
    if len(q) < MIN_POSITIONS:
        return 0.0
    return float(np.abs(np.exp(2j * np.pi * q / step).mean()))


def find_lattice(field: Side, reference: Side, joint: int) -> float:
    """Return the step of a sensor that is coarse on the field but not on the reference, units; 0: none."""
    nats, step = find_step(field, joint)
    if nats < LATTICE_NATS or measure_rests(reference, joint, step) > LATTICE_LENGTH:
        return 0.0
    # A sensor whose scale is off has nearly the steps of before; half of a step fits as well.
    usual = 0.0
    for before in (step, 2.0 * step):
        found, _ = _find_step_between(reference, joint, before / ALIKE, before * ALIKE)
        usual = max(usual, found)
    return step if nats > 2.0 * usual + LATTICE_NATS else 0.0


def find_step(side: Side, joint: int) -> tuple[float, float]:
    """Return evidence that positions lie on a lattice, nats, and its step, units.

    The evidence is the concentration of the positions modulo the step, as in a test of a circular
    distribution. Fourier's transform of their histogram holds it for all steps.
    """
    best = (0.0, 0.0)
    for smallest, largest in STEP_BANDS:
        found = _find_step_between(side, joint, smallest, largest)
        # Parts of a step fit as well as the step itself.
        if found[0] > PART_SHARE * best[0]:
            best = found
    return best


def _find_step_between(
    side: Side, joint: int, smallest: float, largest: float
) -> tuple[float, float]:
    q = _pick_positions(side, joint, largest)
    if len(q) < MIN_POSITIONS:
        return 0.0, 0.0
    places = np.floor((q - q.min()) / BIN_UNITS).astype(int)
    size = PADDING * (int(places.max()) + 1)
    lengths = np.abs(np.fft.rfft(np.bincount(places, minlength=size)))[1:] / len(q)
    steps = size * BIN_UNITS / np.arange(1, len(lengths) + 1)
    weights = lengths**2 + 2.0 * np.maximum(lengths - 0.5, 0.0) ** 2
    nats = min(len(q), MAX_POSITIONS) * weights * ((steps >= smallest) & (steps <= largest))
    # The first of equally good steps is the largest; its peak is a few frequencies wide.
    best = int(np.argmax(nats > PART_SHARE * nats.max()))
    best += int(np.argmax(nats[best : best + PADDING]))
    return float(nats[best]), float(steps[best])


def _pick_positions(side: Side, joint: int, step: float) -> np.ndarray:
    """Return positions that are apart in time, and in place by a third of a step, on end: nearer ones repeat."""
    stride = side.count(THINNED_S)
    picked = []
    for begin, end in zip(side.starts, side.ends, strict=True):
        picked.append(side.q[begin + side.count(1.0) : end : stride, joint])
    q = np.concatenate(picked)
    return q[np.abs(np.diff(q, prepend=q[0] + 1.0)) > step / 3.0]
