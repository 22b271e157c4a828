"""What a simulator gets wrong already on the reference: learned there, and taken off in the field before any effect is tried.

A tidy simulator is wrong in the same way wherever the machine goes (a wavy flow curve, a lever that
changes, oil that warms up). An effect would be named for that in every case. Errors of the
simulator on recordings that it was not fitted to are regressed on its own motion (Kennedy and
O'Hagan's discrepancy, linear), as far as one part of the reference predicts another.
Axes: `W` windows, `I` increments, `J` joints, `E` entries (whitened increments), `F` features.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diagnosis.evidence import Evidence
from diagnosis.noise import SPAN, loss, weight
from diagnosis.sizes import fitted

RIDGES = (10.0, 100.0, 1000.0)
"""Pulls towards no discrepancy, in features of unit size over the noise; that which predicts best
is used."""
TURNS = 2
"""Increments before and after whose changes of speed may matter."""
LEVELS = (0.0, 0.25, 0.5, 0.75)
"""Speeds, of full speed, about which errors may differ."""
ORDERS = (1, 2, 3, 4)
"""Chebyshev polynomials of the position within the travel."""
WIDEST = 5.0
"""Faults are no larger than so many times the usual."""
TOLD = 0.5
"""Variance of an estimate, over that of its prior, up to which recordings tell anything about a
fault."""
WARM_S = 900.0
"""Time in which oil warms up."""


def features(evidence: Evidence, j: int) -> np.ndarray:
    """Returns what an error of joint `j` could depend on, in the simulator's own motion, `(W, I, F)`."""
    way, machine = evidence.way, evidence.candidates.machine
    full = machine.max_speed * machine.period_s * SPAN
    own, speed = way[..., j], way / full
    middle, half = (machine.upper + machine.lower)[j] / 2, (machine.upper - machine.lower)[j] / 2
    place = np.clip((evidence.start[:, None, j] + np.cumsum(own, 1) - middle) / half, -1.0, 1.0)
    size, out = np.abs(speed[..., j]), (own > 0).astype(float)
    sides, turn = (out, 1.0 - out), np.diff(own, axis=1, prepend=own[:, :1])
    warm = 1.0 - np.exp(-evidence.candidates.running_s / WARM_S)[:, None]
    columns = [own * side for side in sides] + [np.full_like(own, 0.1 * full[j]), own * warm]
    columns += [
        own * np.maximum(1.0 - np.abs(size - level) / 0.25, 0.0) * side
        for level in LEVELS
        for side in sides
    ]
    columns += [own * np.cos(order * np.arccos(place)) * side for order in ORDERS for side in sides]
    columns += [
        np.roll(turn, shift, 1) * side for shift in range(-TURNS, TURNS + 1) for side in sides
    ]
    columns += [np.abs(turn), np.abs(np.roll(turn, 1, 1)), np.sign(own) * (size < 0.1) * full[j]]
    for k in range(way.shape[2]):
        if k != j:
            other = speed[..., k]
            columns += [own * np.abs(other), full[j] * other, full[j] * np.abs(other)]
    return np.stack(columns, -1)


def ridge(x: np.ndarray, z: np.ndarray, pull: float) -> np.ndarray:
    """Returns coefficients `(F,)` of a robust ridge regression of `z` `(E,)` on features `(E, F)` of about unit size."""
    beta = np.zeros(x.shape[1])
    for _ in range(3):
        weighted = x * weight(z - x @ beta)[:, None]
        beta = np.linalg.solve(weighted.T @ x + pull * np.eye(x.shape[1]), weighted.T @ z)
    return beta


def learned(parts: Sequence[Evidence], field: Evidence) -> tuple[list[np.ndarray], np.ndarray]:
    """Returns the discrepancy of each part, learned on the others, and of the field, learned on all, each `(W, I, J)`.

    Joints of which no part predicts the others have none.

    Args:
        parts: The simulator against parts of the reference that it was not fitted to, with their
            noise.
        field: The simulator against the field.
    """
    found, of_field = [np.zeros_like(part.way) for part in parts], np.zeros_like(field.way)
    if len(parts) < 2:
        return found, of_field
    for j in range(of_field.shape[2]):
        raw = [features(part, j) for part in parts]
        white = [part.whitened_joint(columns, j) for part, columns in zip(parts, raw, strict=True)]
        size = np.sqrt(np.mean(np.square(np.concatenate(white)), 0))
        by = np.where(size > 1e-9, 1.0 / np.maximum(size, 1e-9), 0.0)
        x, z = [one * by for one in white], [part.z[j] for part in parts]
        others = [[k for k in range(len(parts)) if k != out] for out in range(len(parts))]
        best, lowest = None, sum(float(loss(one)) for one in z)
        for pull in RIDGES:
            betas = [
                ridge(
                    np.concatenate([x[k] for k in rest]), np.concatenate([z[k] for k in rest]), pull
                )
                for rest in others
            ]
            total = sum(
                float(loss(one - columns @ beta))
                for one, columns, beta in zip(z, x, betas, strict=True)
            )
            if total < lowest:
                best, lowest = (pull, betas), total
        if best is None:
            continue
        pull, betas = best
        for bias, columns, beta in zip(found, raw, betas, strict=True):
            bias[..., j] = columns @ (beta * by)
        of_field[..., j] = features(field, j) @ (
            ridge(np.concatenate(x), np.concatenate(z), pull) * by
        )
    return found, of_field


def widths(parts: Sequence[Evidence]) -> np.ndarray:
    """Returns how far the simulator's own numbers are off on parts of the reference, over what is usual, `(P,)`, 1 at least.

    All joints and parts together, less what chance alone does to an estimate.
    """
    squares, chance = [], []
    for part in parts:
        for z, faults in zip(part.z, part.faults, strict=True):
            lines = WIDEST * faults
            found = fitted(z, [], faults=lines)
            slack = np.diag(
                np.linalg.inv((lines * weight(z - found @ lines)) @ lines.T + np.eye(len(lines)))
            )
            squares.append(np.where(slack < TOLD, np.square(found), np.nan))
            chance.append(np.where(slack < TOLD, slack, np.nan))
    told = np.isfinite(squares)
    excess = (np.nansum(squares, 0) - np.nansum(chance, 0)) / np.maximum(told.sum(0), 1)
    return np.clip(WIDEST * np.sqrt(np.maximum(excess, 0.0)), 1.0, WIDEST)
