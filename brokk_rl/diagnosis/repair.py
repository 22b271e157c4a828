"""A simulator repaired by a set of effects: sizes fitted by simulation, what is left, and how sure the sizes are.

Axes: `C` candidates, `R` rays, `J` joints, `E` entries (whitened increments), `W` windows, `K` steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.diagnosis.candidates import Candidates
from brokk_rl.diagnosis.evidence import Evidence, Ray
from brokk_rl.diagnosis.library import Kind
from brokk_rl.diagnosis.noise import loss, weight
from brokk_rl.diagnosis.sizes import PRIOR

STEPS = 4
STEP = 0.05
"""Finite difference, of the typical size."""


@dataclass(frozen=True, eq=False)
class Repair:
    """Effects with their sizes.

    Attributes:
        rays: Ways in which the effects grow.
        mask: Which joints have each, `(R, J)` bool.
        sizes: Fitted to all entries, `(R, J)`.
        halves: Fitted to the entries outside of each half, `(2, R, J)`.
        after: Positions of free runs with the sizes that were not fitted to their window, `(W, K, J)`.
        z: Errors of these over the noise, `(J, E)`.
        deviation: Standard errors of the sizes, `(R, J)`.
    """

    rays: Sequence[Ray]
    mask: np.ndarray
    sizes: np.ndarray
    halves: np.ndarray
    after: np.ndarray
    z: np.ndarray
    deviation: np.ndarray

    @property
    def kinds(self) -> list[Kind]:
        """Effects of the set, each once."""
        return list({ray.kind.name: ray.kind for ray in self.rays}.values())

    def effects(self) -> list[tuple[Kind, dict[str, np.ndarray]]]:
        """Returns the effects with their numbers, each `(1, J)` or `(1, 1)`."""
        return _effects(self.rays, self.sizes[None])

    def joints_of(self, kind: Kind) -> np.ndarray:
        """Returns which joints have an effect, `(J,)` bool."""
        return np.any([mask for ray, mask in zip(self.rays, self.mask, strict=True) if ray.kind is kind], 0)


def simulate(candidates: Candidates, rays: Sequence[Ray], sizes: np.ndarray) -> np.ndarray:
    """Returns free runs `(C, W, K, J)` with the effects at sizes `(C, R, J)`."""
    return candidates.paths(_effects(rays, sizes), len(sizes))


def _effects(rays: Sequence[Ray], sizes: np.ndarray) -> list[tuple[Kind, dict[str, np.ndarray]]]:
    values: dict[str, tuple[Kind, dict[str, np.ndarray]]] = {}
    for r, ray in enumerate(rays):
        values.setdefault(ray.kind.name, (ray.kind, {}))[1].update(ray.values(sizes[:, r]))
    return list(values.values())


def repair(
    evidence: Evidence,
    subsets: Sequence[frozenset[str]],
    rays: Mapping[str, Sequence[Ray]],
    start: Sequence[Mapping[str, np.ndarray]],
    steps: int = STEPS,
) -> Repair:
    """Fits a set of effects by simulation.

    Args:
        evidence: Errors of the simulator without them.
        subsets: Effects of each joint.
        rays: Ways in which each effect can grow.
        start: Sizes of each effect along its rays, by joint and name.
        steps: Simulations of all sizes and their neighbourhood.
    """
    chosen = [(ray, place) for name in sorted(frozenset().union(*subsets)) for place, ray in enumerate(rays[name])]
    mask = np.array([[ray.kind.name in subset for subset in subsets] for ray, _ in chosen])
    sizes = np.array(
        [
            [start[j][ray.kind.name][place] if ray.kind.name in subset else 0.0 for j, subset in enumerate(subsets)]
            for ray, place in chosen
        ]
    )
    found = [ray for ray, _ in chosen]
    low, high = (np.array([ray.sizes[end] for ray in found])[:, None] for end in (0, -1))
    low, high = np.where(low < 0, 2.0 * low, low), 2.0 * high  # beyond what was simulated before, within the bounds of the number
    used = np.stack([np.ones(len(evidence.fold)), evidence.fold != 0, evidence.fold != 1])  # (3, E)
    now = np.repeat(sizes[None], 3, 0)
    best, best_loss = now.copy(), np.full((3, sizes.shape[1]), np.inf)
    slopes = z = np.zeros(0)
    for _ in range(steps):
        z, slopes, paths = _linear(evidence, found, now)
        totals = np.einsum("fje,fe->fj", np.log1p(z**2 / 5.0) * 3.0, used) + 0.5 * (now**2).sum(1) / PRIOR**2
        better = totals < best_loss - 1e-6
        best, best_loss = np.where(better[:, None], now, best), np.minimum(totals, best_loss)
        step = np.zeros_like(now)
        for f in range(3):
            for j in np.flatnonzero(mask.any(0)):
                rows = mask[:, j]
                weighted = slopes[f, j][rows] * (weight(z[f, j]) * used[f])
                normal = weighted @ slopes[f, j][rows].T + np.eye(rows.sum()) / PRIOR**2
                step[f, rows, j] = np.linalg.solve(1.001 * normal, weighted @ z[f, j] - now[f, rows, j] / PRIOR**2)
        origin = np.where(better[:, None], now, best)
        now = np.clip(np.where(better[:, None], now + step, 0.5 * (origin + now)), low, high)
    z, slopes, paths = _linear(evidence, found, best)
    half = evidence.fold.reshape(len(evidence.way), -1)[:, 0]
    after = np.where((half == 0)[:, None, None], paths[1], paths[2]) + (0.0 if evidence.mean is None else evidence.mean)
    held = np.where(evidence.fold == 0, z[1], z[2])
    deviation = _deviation(z[0], slopes[0], mask, evidence.block)
    return Repair(found, mask, best[0], best[1:], after, held, deviation)


def _linear(evidence: Evidence, rays: Sequence[Ray], sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns errors `(F, J, E)`, their slopes over the sizes `(F, J, R, E)`, and free runs `(F, W, K, J)` at sizes `(F, R, J)`."""
    fits, count, joints = sizes.shape
    sign = np.array(
        [[1.0 if (row + STEP <= ray.sizes[-1] * 2).all() else -1.0 for row, ray in zip(one, rays, strict=True)] for one in sizes]
    )
    varied = np.repeat(sizes[:, None], count + 1, 1)
    for r in range(count):
        varied[:, r + 1, r] += STEP * sign[:, r, None]
    paths = simulate(evidence.candidates, rays, varied.reshape(-1, count, joints))
    z = evidence.whitened(evidence.error_of(paths)).reshape(joints, fits, count + 1, -1)
    slopes = (z[:, :, :1] - z[:, :, 1:]) / (STEP * sign)[None, :, :, None]
    return z[:, :, 0].swapaxes(0, 1), slopes.swapaxes(0, 1), paths.reshape(fits, count + 1, *paths.shape[1:])[:, 0]


def _deviation(z: np.ndarray, slopes: np.ndarray, mask: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Returns standard errors of the sizes, `(R, J)`: the larger of what the likelihood says and the spread between blocks."""
    found = np.zeros(mask.shape)
    for j in np.flatnonzero(mask.any(0)):
        rows = mask[:, j]
        weighted = slopes[j][rows] * weight(z[j])
        inverse = np.linalg.inv(weighted @ slopes[j][rows].T + np.eye(rows.sum()) / PRIOR**2)
        scores = np.stack([(weighted * z[j])[:, block == one].sum(1) for one in np.unique(block)])
        factor = len(scores) / max(1, len(scores) - 1)
        spread = inverse @ (factor * scores.T @ scores) @ inverse
        found[rows, j] = np.sqrt(np.maximum(np.diag(spread), np.diag(inverse)))
    return found


def gain(before: np.ndarray, after: np.ndarray) -> float:
    """Returns by how much the loss of errors over the noise fell."""
    return float(loss(before) - loss(after))
