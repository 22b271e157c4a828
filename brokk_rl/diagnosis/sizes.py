"""Which sizes of some effects explain a joint's errors best, and how much that earns on recordings they were not fitted to.

What an effect does at a size is interpolated between the sizes at which it was simulated, and effects are added up: both are near
enough for choosing, and what is chosen is simulated again.
Axes: `E` entries (whitened increments), `S` sizes of a ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.diagnosis.noise import loss, weight

STEPS = 6
"""Gauss-Newton steps at most."""
PRIOR = 1.0
"""Standard deviation of a size, over the typical one: tells nothing where the recordings do, and settles what they leave open."""


@dataclass(frozen=True, eq=False)
class Shape:
    """What growing along a ray does to one joint: `change` `(S, E)` at `sizes` `(S,)`, which are `prior` wide beforehand."""

    sizes: np.ndarray
    change: np.ndarray
    prior: float = PRIOR

    def at(self, size: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns the change at a size and its slope over the size, each `(E,)`."""
        cell = int(np.clip(np.searchsorted(self.sizes, size, side="right") - 1, 0, len(self.sizes) - 2))
        slope = (self.change[cell + 1] - self.change[cell]) / (self.sizes[cell + 1] - self.sizes[cell])
        return self.change[cell] + (size - self.sizes[cell]) * slope, slope

    def part(self, rows: np.ndarray) -> Shape:
        """Returns the shape on some entries only."""
        return Shape(self.sizes, self.change[:, rows], self.prior)


def predicted(shapes: Sequence[Shape], sizes: np.ndarray) -> np.ndarray:
    """Returns the sum of the changes, `(E,)`."""
    return np.sum([shape.at(size)[0] for shape, size in zip(shapes, sizes, strict=True)], 0)


def fitted(z: np.ndarray, shapes: Sequence[Shape], start: np.ndarray | None = None) -> np.ndarray:
    """Returns the sizes that explain the errors `z` `(E,)` best: most likely under a t distribution and a wide prior."""
    if not shapes:
        return np.zeros(0)
    low, high = (np.array([shape.sizes[end] for shape in shapes]) for end in (0, -1))
    prior = np.array([shape.prior for shape in shapes])
    size = np.array([_best(z, shape) for shape in shapes]) if start is None else start.copy()
    if len(shapes) > 1 and start is None:
        size *= 0.7

    def total(at: np.ndarray) -> float:
        return float(loss(z - predicted(shapes, at))) + 0.5 * float(np.square(at / prior).sum())

    now = total(size)
    damping = 1e-3
    for _ in range(STEPS):
        pairs = [shape.at(one) for shape, one in zip(shapes, size, strict=True)]
        left, slope = z - np.sum([pair[0] for pair in pairs], 0), np.stack([pair[1] for pair in pairs])
        weighted = slope * weight(left)
        normal = weighted @ slope.T + np.diag(prior**-2.0)
        gradient = weighted @ left - size / prior**2
        improved = False
        for _ in range(3):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            trial = np.clip(size + step, low, high)
            then = total(trial)
            if then < now - 1e-9:
                improved = now - then > 1e-2
                size, now, damping = trial, then, damping / 5
                break
            damping = 10 * max(damping, 1e-3)
        if not improved:
            break
    return size


def _best(z: np.ndarray, shape: Shape) -> float:
    """Returns the best of the simulated sizes and those in the middle between them."""
    trials = np.unique(np.concatenate([shape.sizes, (shape.sizes[1:] + shape.sizes[:-1]) / 2]))
    totals = [float(loss(z - shape.at(size)[0])) + 0.5 * size**2 / shape.prior**2 for size in trials]
    return float(trials[int(np.argmin(totals))])


@dataclass(frozen=True)
class Plain:
    """A joint's errors without any effect, small faults of the simulator itself fitted.

    Attributes:
        z: Errors over the noise, `(E,)`.
        fold: Half of the recordings of each entry.
        faults: What the simulator's own numbers change.
        loss: Loss of each entry where faults were fitted to the other half.
    """

    z: np.ndarray
    fold: np.ndarray
    faults: Sequence[Shape]
    loss: np.ndarray


def plain(z: np.ndarray, faults: Sequence[Shape], fold: np.ndarray) -> Plain:
    """Returns a joint's errors with the simulator's faults fitted crosswise."""
    return Plain(z, fold, faults, _each(z - crossed(z, faults, fold, fitted(z, faults))))


def crossed(z: np.ndarray, shapes: Sequence[Shape], fold: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Returns what shapes change, `(E,)`, on each half with sizes fitted to the other."""
    change = np.zeros(len(z))
    for half in (0, 1):
        own, other = fold != half, fold == half
        if shapes and own.any() and other.any():
            size = fitted(z[own], [shape.part(own) for shape in shapes], start)
            change[other] = predicted([shape.part(other) for shape in shapes], size)
    return change


def earned(joint: Plain, shapes: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Returns by how much shapes fitted to one half of the entries lower the loss of the other, entry by entry `(E,)`.

    Returns:
        What each entry earns, and the sizes fitted to all.
    """
    every = [*shapes, *joint.faults]
    alone = fitted(joint.z, shapes)
    start = np.concatenate([alone, np.zeros(len(joint.faults))])
    whole = fitted(joint.z, every, start)
    return joint.loss - _each(joint.z - crossed(joint.z, every, joint.fold, whole)), whole[: len(shapes)]


def _each(z: np.ndarray) -> np.ndarray:
    return loss(z[:, None], axis=1)
