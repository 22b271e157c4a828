"""Whether a flexible model still predicts what is left: then something is there, and the library has no name for it.

The model is a ridge regression of increments on what a machine could depend on: its own speed and changes of speed now and a little
ago, position, direction, running time, the other joints. It is judged as effects are, on entries that it was not fitted to, and by
what it earns on reference recordings.
Axes: `W` windows, `I` increments, `J` joints, `E` entries, `F` features.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.diagnosis.evidence import Evidence
from brokk_rl.diagnosis.noise import loss, weight

RIDGES = (3.0, 30.0, 300.0)
TURNS = 2
"""Increments before and after whose changes of speed may matter."""


def predictable(evidence: Evidence, z: np.ndarray) -> np.ndarray:
    """Returns what the flexible model earns on errors over the noise `z` `(J, E)`, entry by entry on the other half, `(J, E)`."""
    found = np.zeros_like(z)
    for j in range(len(z)):
        x = _whitened(evidence, _features(evidence, j), j)
        gains = []
        for ridge in RIDGES:
            gain = np.zeros(z.shape[1])
            for half in (0, 1):
                own, other = evidence.fold != half, evidence.fold == half
                change = x[other] @ _ridge(x[own], z[j, own], ridge)
                gain[other] = loss(z[j, other][:, None], 1) - loss((z[j, other] - change)[:, None], 1)
            gains.append(gain)
        found[j] = max(gains, key=lambda gain: gain.sum())
    return found


def _ridge(x: np.ndarray, z: np.ndarray, ridge: float) -> np.ndarray:
    """Returns coefficients of a robust ridge regression on features of equal size."""
    beta = np.zeros(x.shape[1])
    for _ in range(3):
        weighted = x * weight(z - x @ beta)[:, None]
        beta = np.linalg.solve(weighted.T @ x + ridge * np.eye(x.shape[1]), weighted.T @ z)
    return beta


def _features(evidence: Evidence, j: int) -> np.ndarray:
    """Returns features of joint `j`, `(W, I, F)`."""
    way = evidence.way
    machine = evidence.candidates.machine
    own, full = way[..., j], np.abs(way[..., j]).max() + 1e-12
    middle, half = (machine.upper + machine.lower)[j] / 2, (machine.upper - machine.lower)[j] / 2
    place = (evidence.start[:, None, j] + np.cumsum(own, 1) - middle) / half
    size, out = np.abs(own) / full, (own > 0).astype(float)
    time = np.linspace(-1.0, 1.0, len(way))[:, None] * np.ones_like(own)
    turn = np.diff(own, axis=1, prepend=own[:, :1])
    columns = [own * out, own * (1 - out), np.ones_like(own) * full * 0.1]
    columns += [
        own * np.maximum(1 - np.abs(size - level) / 0.25, 0.0) * side for level in (0.0, 0.25, 0.5, 0.75) for side in (out, 1 - out)
    ]
    columns += [own * np.cos(order * np.arccos(np.clip(place, -1, 1))) * side for order in (1, 2, 3, 4) for side in (out, 1 - out)]
    columns += [own * time, own * (time**2 - 0.5), own * np.sin(3 * np.pi * time), own * np.cos(3 * np.pi * time)]
    columns += [np.roll(turn, shift, 1) * side for shift in range(-TURNS, TURNS + 1) for side in (out, 1 - out)]
    columns += [np.abs(turn), np.abs(np.roll(turn, 1, 1)), np.sign(own) * (size < 0.1) * full]
    for k in range(way.shape[2]):
        if k != j:
            scale = np.abs(way[..., k]).max() + 1e-12
            columns += [own * np.abs(way[..., k]) / scale, way[..., k] / scale * full, np.abs(way[..., k]) / scale * full]
    return np.stack(columns, -1)


def _whitened(evidence: Evidence, features: np.ndarray, j: int) -> np.ndarray:
    """Returns features over the noise of joint `j`, of equal size, `(E, F)`."""
    x = evidence.whitened_joint(features, j)
    size = np.sqrt(np.mean(np.square(x), 0))
    return x / np.where(size > 1e-9, size, np.inf)
