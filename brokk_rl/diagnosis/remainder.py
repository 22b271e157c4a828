"""Whether a flexible model still predicts what is left: then something is there, and the library has no name for it.

The model is a ridge regression of increments on what a machine could depend on: its own speed and changes of speed now and a little
ago, position, direction, running time, the other joints. It is judged as effects are, on entries that it was not fitted to, and by
what it earns on reference recordings.
Axes: `W` windows, `I` increments, `J` joints, `E` entries, `F` features.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.diagnosis.discrepancy import features, ridge
from brokk_rl.diagnosis.evidence import Evidence
from brokk_rl.diagnosis.noise import loss

RIDGES = (3.0, 30.0, 300.0)


def predictable(evidence: Evidence, z: np.ndarray) -> np.ndarray:
    """Returns what the flexible model earns on errors over the noise `z` `(J, E)`, entry by entry on the other half, `(J, E)`."""
    found = np.zeros_like(z)
    for j in range(len(z)):
        x = _whitened(evidence, _features(evidence, j), j)
        gains = []
        for pull in RIDGES:
            gain = np.zeros(z.shape[1])
            for half in (0, 1):
                own, other = evidence.fold != half, evidence.fold == half
                change = x[other] @ ridge(x[own], z[j, own], pull)
                gain[other] = loss(z[j, other][:, None], 1) - loss((z[j, other] - change)[:, None], 1)
            gains.append(gain)
        found[j] = max(gains, key=lambda gain: gain.sum())
    return found


def _features(evidence: Evidence, j: int) -> np.ndarray:
    """Returns features of joint `j`, those of the simulator's own discrepancy and the course of the field, `(W, I, F)`."""
    own = evidence.way[..., j]
    time = np.linspace(-1.0, 1.0, len(own))[:, None]
    slow = [own * time, own * (time**2 - 0.5), own * np.sin(3 * np.pi * time), own * np.cos(3 * np.pi * time)]
    return np.concatenate([features(evidence, j), np.stack(slow, -1)], -1)


def _whitened(evidence: Evidence, features: np.ndarray, j: int) -> np.ndarray:
    """Returns features over the noise of joint `j`, of equal size, `(E, F)`."""
    x = evidence.whitened_joint(features, j)
    size = np.sqrt(np.mean(np.square(x), 0))
    return x / np.where(size > 1e-9, size, np.inf)
