"""Robust fits: linear ones with the weights of Tukey's biweight, and a first guess of a plane."""

from __future__ import annotations

import numpy as np

TUKEY = 4.685
"""Residual in standard deviations from which a value counts nothing: 95 % efficient with Gaussian
noise (Holland and Welsch 1977)."""
MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def compute_biweight(off: np.ndarray, reach: float) -> np.ndarray:
    """Return Tukey's weights of residuals; 0 from `reach` on, which has their unit."""
    return np.maximum(1.0 - (off / reach) ** 2, 0.0) ** 2


def estimate_spread(off: np.ndarray) -> float:
    """Return the robust standard deviation of residuals about 0."""
    return MAD_TO_STD * float(np.median(np.abs(off)))


def fit_linear(
    design: np.ndarray,
    values: np.ndarray,
    floor: float,
    start: np.ndarray | None = None,
    num_rounds: int = 6,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit `values = design @ solution`; gross errors count nothing.

    Args:
        design: `(n, k)`.
        values: `(n,)`.
        floor: Least standard deviation of the values, in their unit.
        start: First solution, `(k,)`; `None`: the median of the values, as if all were alike.
        num_rounds: Rounds of reweighting.

    Returns:
        The solution, `(k,)`, and its covariance, `(k, k)`.
    """
    weight = np.ones(len(values))
    # The first scale is that about a guess: gross errors would tilt a first fit.
    away = values - (np.median(values) if start is None else design @ start)
    solution = np.zeros(design.shape[1])
    scale = floor
    for _ in range(num_rounds):
        scale = max(estimate_spread(away), floor)
        weight = compute_biweight(away, TUKEY * scale)
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0]
        away = values - design @ solution
    # Residuals of unlike spread: the sandwich of White (1980) with leverages (HC3).
    normal = np.linalg.pinv(design.T @ (design * weight[:, None]))
    heavy = design * weight[:, None]
    leverage = np.einsum("ni,ij,nj->n", design, normal, heavy)
    moved = heavy * (away / np.maximum(1.0 - leverage, 0.1))[:, None]
    return solution, normal @ (moved.T @ moved) @ normal


def guess_plane(
    rays: np.ndarray,
    inverse: np.ndarray,
    generator: np.random.Generator,
    num_trials: int = 40,
    num_judges: int = 400,
) -> np.ndarray:
    """Return the plane `rays @ m = inverse` through three points with the least median residual.

    Least median of squares (Rousseeuw 1984) bears it that half of the points are wrong.

    Args:
        rays: `(n, 3)`.
        inverse: Inverse depth, `(n,)`.
        generator: Draws points.
        num_trials: Planes that are tried.
        num_judges: Points that judge them: as many judge as well as all do.
    """
    judge = generator.integers(len(rays), size=min(len(rays), num_judges))
    triples = generator.integers(len(rays), size=(num_trials, 3))
    # Points nearly on a line determine no plane.
    triples = triples[np.abs(np.linalg.det(rays[triples])) > 1e-9]
    if not len(triples):
        return np.linalg.lstsq(rays, inverse, rcond=None)[0]
    planes = np.linalg.solve(rays[triples], inverse[triples][..., None])[..., 0]
    off = np.abs(inverse[judge, None] - rays[judge] @ planes.T)
    middle = len(judge) // 2
    return planes[np.argmin(np.partition(off, middle, axis=0)[middle])]
