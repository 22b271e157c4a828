"""Conics, many at a time: ellipses by centre, semi-axes and direction, and as quadratic forms.

Axes: `C` conics, `P` points. An ellipse is a row `(x, y, a, b, theta_rad)` with `a >= b`; a row of
NaN stands for none. A quadratic form `Q`, `(3, 3)`, holds the points with `(x, y, 1) Q (x, y, 1)^T
= 0`.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.contracts.vision import Ellipse


def as_row(ellipse: Ellipse) -> np.ndarray:
    """Return centre, semi-axes and direction of an ellipse, `(5,)`."""
    return np.array([ellipse.x, ellipse.y, ellipse.a, ellipse.b, ellipse.theta_rad])


def fit_ellipses(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit ellipses to weighted points, `(C, 5)`; a row of NaN where the points determine none.

    Halir and Flusser (1998), the numerically stable form of Fitzgibbon's direct fit, on points
    moved and scaled to unit size.

    Args:
        points: `(C, P, 2)`.
        weights: `(C, P)`, 0 for points that are left out.
    """
    total = np.maximum(weights.sum(1), 1e-12)
    center = (weights[:, None] @ points)[:, 0] / total[:, None]
    counts = weights > 0
    x = np.where(counts, points[..., 0] - center[:, 0, None], 0.0)
    y = np.where(counts, points[..., 1] - center[:, 1, None], 0.0)
    scale = np.sqrt(((x * x + y * y) * weights).sum(1) / total) + 1e-12
    x, y = x / scale[:, None], y / scale[:, None]
    powers = np.empty((len(x), 6, x.shape[1]))
    for k, power in enumerate((x * x, x * y, y * y, x, y, 1.0)):
        powers[:, k] = power
    scatter = (powers * weights[:, None]) @ powers.transpose(0, 2, 1)
    s1, s2, s3 = scatter[:, :3, :3], scatter[:, :3, 3:], scatter[:, 3:, 3:]
    known = (counts.sum(1) >= 6) & np.isfinite(s1).all((1, 2)) & (np.linalg.det(s3) > 1e-9)
    result = np.full((len(points), 5), np.nan)
    if not known.any():
        return result
    t = -np.linalg.solve(s3[known], s2[known].transpose(0, 2, 1))
    m = s1[known] + s2[known] @ t
    values, vectors = np.linalg.eig(m[:, [2, 1, 0]] * np.array([0.5, -1.0, 0.5])[:, None])
    # Of the eigenvalues only one is positive, that of the ellipse.
    best = np.real(values).argmax(1)
    a, b, c = a1 = np.real(vectors)[np.arange(len(m)), :, best].T
    d, e, f = (t @ a1.T[:, :, None])[:, :, 0].T
    fitted = _convert_coefficients(a, b / 2, d / 2, c, e / 2, f)
    fitted[4 * a * c - b * b <= 0] = np.nan
    fitted[:, :4] *= scale[known][:, None]
    fitted[:, :2] += center[known]
    result[known] = fitted
    return result


def build_quadratic_forms(ellipses: np.ndarray) -> np.ndarray:
    """Return the forms `(C, 3, 3)` of ellipses `(C, 5)`, negative inside.

    Along an axis the form is `(distance / semi-axis)² - 1`.
    """
    x, y, a, b, theta = np.moveaxis(np.asarray(ellipses, dtype=float), -1, 0)
    u = np.stack([np.cos(theta), np.sin(theta)], -1) / a[..., None]
    v = np.stack([-np.sin(theta), np.cos(theta)], -1) / b[..., None]
    inner = u[..., :, None] * u[..., None, :] + v[..., :, None] * v[..., None, :]
    center = np.stack([x, y], -1)
    side = -np.einsum("...ij,...j->...i", inner, center)
    last = -np.einsum("...i,...i->...", side, center) - 1.0
    top = np.concatenate([inner, side[..., None]], -1)
    return np.concatenate([top, np.concatenate([side, last[..., None]], -1)[..., None, :]], -2)


def convert_forms_to_ellipses(forms: np.ndarray) -> np.ndarray:
    """Return the ellipses `(C, 5)` of forms `(C, 3, 3)`, a row of NaN where a form is none."""
    rows, columns = np.triu_indices(3)
    return _convert_coefficients(*forms[:, rows, columns].T)


def _convert_coefficients(
    a: np.ndarray, b: np.ndarray, d: np.ndarray, c: np.ndarray, e: np.ndarray, last: np.ndarray
) -> np.ndarray:
    """Return the ellipses `(C, 5)` of `a x² + 2 b xy + c y² + 2 d x + 2 e y + last`, NaN for none."""
    result = np.empty((len(a), 5))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        det = a * c - b * b
        x, y = (b * e - c * d) / det, (b * d - a * e) / det
        level = -(d * x + e * y + last)
        mean, half, skew = (a + c) / 2 / level, (a - c) / 2 / level, b / level
        apart = np.hypot(half, skew)
        flat = mean - apart
        # The difference cancels for flat ellipses; there the product of both eigenvalues is used.
        flat = np.where(flat < 0.5 * mean, det / level**2 / (mean + apart), flat)
        result[:, 0], result[:, 1] = x, y
        result[:, 2] = 1.0 / np.sqrt(flat)
        result[:, 3] = 1.0 / np.sqrt(mean + apart)
        result[:, 4] = np.arctan2(-skew, -half) / 2 % np.pi
        largest = np.maximum(np.maximum(np.abs(a), np.abs(c)), np.abs(b))
        known = (det > 1e-15 * np.maximum(largest, 1e-300) ** 2) & np.isfinite(result).all(1)
    result[~known] = np.nan
    return result


def measure_sampson_distance(
    ellipses: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return Sampson's distance of points `(C, P, 2)` from ellipses `(C, 5)`, negative inside.

    Also return the outward unit normals of the ellipses there, `(C, P, 2)`.
    """
    value, slope = _evaluate_forms(ellipses, points)
    length = np.maximum(np.sqrt(sum_products(slope, slope)), 1e-12)
    return value / length, slope / length[..., None]


def measure_form_gradients(ellipses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the length of the gradient of each form at its points, `(C, P)`.

    Divided by it, the algebraic error is a distance to first order.
    """
    slope = _evaluate_forms(ellipses, points)[1]
    return np.sqrt(sum_products(slope, slope))


def sum_products(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return scalar products over the last axis of length 2; much faster than `sum(-1)`."""
    return one[..., 0] * other[..., 0] + one[..., 1] * other[..., 1]


def sample_ellipses(
    ellipses: np.ndarray, angles_rad: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, outward normals `(C, P, 2)` and arc length per radian `(C, P)` at `angles_rad`.

    Eccentric angles, `(P,)`; the normals have unit length.
    """
    x, y, a, b, theta = (column[:, None] for column in ellipses.T)
    cos, sin, c, s = np.cos(angles_rad), np.sin(angles_rad), np.cos(theta), np.sin(theta)
    u, v = a * cos, b * sin
    points, outward = np.empty((*u.shape, 2)), np.empty((*u.shape, 2))
    points[..., 0], points[..., 1] = x + c * u - s * v, y + s * u + c * v
    nu, nv = b * cos, a * sin
    length = np.sqrt(nu * nu + nv * nv)
    unit = 1.0 / np.maximum(length, 1e-12)
    outward[..., 0], outward[..., 1] = (c * nu - s * nv) * unit, (s * nu + c * nv) * unit
    return points, outward, length


def measure_radii(ellipse: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the distance of places from an ellipse's centre in its own radii: 1 on it.

    `x` and `y` are broadcast against each other.
    """
    c, s = np.cos(ellipse[4]), np.sin(ellipse[4])
    dx, dy = x - ellipse[0], y - ellipse[1]
    return np.hypot((c * dx + s * dy) / ellipse[2], (c * dy - s * dx) / ellipse[3])


def bound_ellipse(
    ellipse: np.ndarray, reach_px: float, shape: tuple[int, ...]
) -> tuple[slice, slice]:
    """Return rows and columns of a picture `(h, w)` around an ellipse's centre, to `reach_px`."""
    rows, columns = (
        slice(max(0, int(middle - reach_px)), max(0, min(size, int(middle + reach_px) + 2)))
        for middle, size in ((ellipse[1], shape[0]), (ellipse[0], shape[1]))
    )
    return rows, columns


def compute_perimeter(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the circumference by Ramanujan's first approximation (1914)."""
    return np.pi * (3 * (a + b) - np.sqrt((3 * a + b) * (a + 3 * b)))


def _evaluate_forms(ellipses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y, a, b, theta = (column[:, None] for column in ellipses.T)
    c, s = np.cos(theta), np.sin(theta)
    dx, dy = points[..., 0] - x, points[..., 1] - y
    u, v = (c * dx + s * dy) / a, (c * dy - s * dx) / b
    slope = np.empty((*u.shape, 2))
    p, q = 2 * u / a, 2 * v / b
    slope[..., 0], slope[..., 1] = c * p - s * q, s * p + c * q
    return u * u + v * v - 1.0, slope
