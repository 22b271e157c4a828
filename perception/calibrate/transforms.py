"""Rigid transforms as arrays `(…, 4, 4)`, small motions as `(…, 6)`: shift in m, then turn in rad.

A small motion of a transform acts in the transform's own frame: it shifts by `R v` and turns by `R
exp(w)`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def make_transform(rotation: np.ndarray, shift_m: np.ndarray) -> np.ndarray:
    """Returns transforms, `(…, 4, 4)`, of rotations, `(…, 3, 3)`, and shifts, `(…, 3)`."""
    found = np.zeros((*rotation.shape[:-2], 4, 4))
    found[..., :3, :3], found[..., :3, 3], found[..., 3, 3] = rotation, shift_m, 1.0
    return found


def invert(transform: np.ndarray) -> np.ndarray:
    """Returns the inverse transforms."""
    turned = np.swapaxes(transform[..., :3, :3], -1, -2)
    return make_transform(turned, -(turned @ transform[..., :3, 3:])[..., 0])


def apply_motion(transform: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Returns a transform, `(4, 4)`, after a small motion, `(6,)`, in its own frame."""
    turn = transform[:3, :3]
    return make_transform(
        turn @ Rotation.from_rotvec(motion[3:]).as_matrix(), transform[:3, 3] + turn @ motion[:3]
    )


def compute_motion(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns the small motions, `(…, 6)`, that take the transforms `one` to `other`."""
    turned = np.swapaxes(one[..., :3, :3], -1, -2)
    shift = (turned @ (other[..., :3, 3:] - one[..., :3, 3:]))[..., 0]
    return np.concatenate([shift, compute_rotation_vectors(turned @ other[..., :3, :3])], -1)


def compute_rotation_vectors(rotation: np.ndarray) -> np.ndarray:
    """Returns the rotation vectors, `(…, 3)` rad, of rotations."""
    return (
        Rotation.from_matrix(rotation.reshape(-1, 3, 3))
        .as_rotvec()
        .reshape(*rotation.shape[:-2], 3)
    )


def build_cross_matrices(vector: np.ndarray) -> np.ndarray:
    """Returns the matrices, `(…, 3, 3)`, of the cross product with vectors: `crossing(a) @ b` is `a x b`."""
    found = np.zeros((*vector.shape, 3))
    for row, column, part, sign in (
        (0, 1, 2, -1),
        (0, 2, 1, 1),
        (1, 0, 2, 1),
        (1, 2, 0, -1),
        (2, 0, 1, -1),
        (2, 1, 0, 1),
    ):
        found[..., row, column] = sign * vector[..., part]
    return found


def find_nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Returns the rotation nearest to a matrix, `(3, 3)`, in the Frobenius norm (Kabsch, 1976)."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
