"""Robust fits: linear ones with the weights of Tukey's biweight, and a first guess of a plane."""

from __future__ import annotations

import itertools

import numpy as np

TUKEY = 4.685
"""Residual in standard deviations from which a value counts nothing: 95 % efficient with Gaussian
noise (Holland and Welsch 1977)."""
FEWEST = 8
"""Cells from which a covariance is estimated, below which bands of rows take their place."""
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
    num_rounds: int = 6,
    cell: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit `values = design @ solution`; gross errors count nothing.

    Args:
        design: `(n, k)`.
        values: `(n,)`.
        floor: Least standard deviation of the values, in their unit.
        num_rounds: Rounds of reweighting.
        cell: Number of each value's cell, within which errors are alike, `(n,)`; `None`: each
            value has an error of its own.

    Returns:
        The solution, `(k,)`, and its covariance, `(k, k)`; infinite where one cell alone determines
        a number.
    """
    weight = np.ones(len(values))
    # The first scale is that about the median: gross errors would tilt a first fit.
    away = values - np.median(values)
    solution = np.zeros(design.shape[1])
    scale = floor
    for _ in range(num_rounds):
        scale = max(estimate_spread(away), floor)
        weight = compute_biweight(away, TUKEY * scale)
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0]
        away = values - design @ solution
    slopes = design * compute_psi_slope(away / (TUKEY * scale))[:, None]
    cell = np.arange(len(values)) if cell is None else number_cells(cell)
    cov = estimate_sandwich_covariance(slopes, design * weight[:, None], away, cell)
    return solution, np.full((len(solution),) * 2, np.inf) if cov is None else cov


def number_cells(cell: np.ndarray) -> np.ndarray:
    """Return consecutive numbers of cells, `(P,)`; of too few cells, bands of rows in their place."""
    cell = np.unique(cell, return_inverse=True)[1]
    if cell.max(initial=0) >= FEWEST:
        return cell
    return np.arange(len(cell)) * FEWEST // max(len(cell), 1)


def compute_psi_slope(off: np.ndarray) -> np.ndarray:
    """Return the derivative of Tukey's influence function over its weight, `(P,)`; 0 beyond its reach.

    `off` is in units of the biweight's reach. The influence of a growing residual falls, so that a
    fit varies more than its weights alone tell: by a fifth with a reach of 4.7 standard
    deviations, by a half with one of 3.
    """
    square = off**2
    within = square < 1.0
    # The quotient has a pole at the reach, where the weight is 0.
    return np.where(within, (1.0 - 5.0 * square) / np.where(within, 1.0 - square, 1.0), 0.0)


def estimate_sandwich_covariance(
    slopes: np.ndarray, heavy: np.ndarray, residual: np.ndarray, cell: np.ndarray
) -> np.ndarray | None:
    """Return the cluster-robust covariance of a fit, `(k, k)`.

    The jackknife over cells, within which noise may be correlated: the sandwich estimate CR3 (Bell
    and McCaffrey 2002). Return `None` where the fit is singular without one of the cells.

    Args:
        slopes: Derivatives of the residuals times `compute_psi_slope`, `(P, k)`.
        heavy: Weighted derivatives, or instruments in their place, `(P, k)`.
        residual: `(P,)`.
        cell: Number of each point's cell, from 0 on, `(P,)`.
    """
    size = heavy.shape[1]
    sums = np.stack([np.bincount(cell, one * residual) for one in heavy.T], -1)
    parts = []
    for one, other in itertools.product(heavy.T, slopes.T):
        parts.append(np.bincount(cell, one * other))
    squares = np.stack(parts, -1).reshape(-1, size, size)
    # The sums without each cell, all at once.
    without = squares.sum(0) - squares
    try:
        moved = np.linalg.solve(without, sums[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return None
    return moved.T @ moved * (1.0 - 1.0 / len(moved))


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
