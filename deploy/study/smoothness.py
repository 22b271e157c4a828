"""Smoothness of a movement: spectral arc length of its speed.

Source: Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet, J. NeuroEng. Rehabil. 12 (2015)
112 (SPARC), with their parameters (cut-off 10 Hz, threshold 0.05, padding by 2**4).
"""

from __future__ import annotations

import math

import numpy as np

CUT_OFF_HZ = 10.0
THRESHOLD = 0.05
PADDING = 4


def sparc(speed: np.ndarray, rate_hz: float) -> float:
    """Returns minus the length of the spectrum's outline: near -1.4 for one smooth stroke, lower with every stop and start.

    Args:
        speed: Speed over time, `(T,)`, any unit.
        rate_hz: Samples a second.

    Returns:
        NaN where nothing moved.
    """
    if len(speed) < 2 or not np.any(speed):
        return math.nan
    size = 2 ** (math.ceil(math.log2(len(speed))) + PADDING)
    frequency = np.arange(size) * rate_hz / size
    spectrum = np.abs(np.fft.fft(speed, size))
    spectrum = spectrum / spectrum.max()
    within = frequency <= CUT_OFF_HZ
    frequency, spectrum = frequency[within], spectrum[within]
    above = np.flatnonzero(spectrum >= THRESHOLD)
    frequency, spectrum = frequency[above[0] : above[-1] + 1], spectrum[above[0] : above[-1] + 1]
    if len(frequency) < 2:
        return math.nan
    across = np.diff(frequency) / (frequency[-1] - frequency[0])
    return -float(np.hypot(across, np.diff(spectrum)).sum())
