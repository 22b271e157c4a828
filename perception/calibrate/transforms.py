"""Rigid transforms as arrays `(…, 4, 4)`, small motions as `(…, 6)`: shift in m, turn in rad.

A small motion acts in the transform's own frame: it shifts by `R v` and turns by `R exp(w)`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def make_transform(rotation: np.ndarray, shift_m: np.ndarray) -> np.ndarray:
    """Return transforms, `(…, 4, 4)`, of rotations, `(…, 3, 3)`, and shifts, `(…, 3)`."""
    transform = np.zeros((*rotation.shape[:-2], 4, 4))
    transform[..., :3, :3], transform[..., :3, 3] = rotation, shift_m
    transform[..., 3, 3] = 1.0
    return transform


def apply_motion(transform: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return a transform, `(4, 4)`, after a small motion, `(6,)`, in its own frame."""
    rotation = transform[:3, :3]
    turn = Rotation.from_rotvec(motion[3:]).as_matrix()
    return make_transform(rotation @ turn, transform[:3, 3] + rotation @ motion[:3])


def compute_motion(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the small motions, `(…, 6)`, that take the transforms `start` to `end`."""
    back = np.swapaxes(start[..., :3, :3], -1, -2)
    shift = (back @ (end[..., :3, 3:] - start[..., :3, 3:]))[..., 0]
    turn = Rotation.from_matrix((back @ end[..., :3, :3]).reshape(-1, 3, 3)).as_rotvec()
    return np.concatenate([shift, turn.reshape(shift.shape)], -1)


def span_plane(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that span a plane with a unit normal, `(3,)` each."""
    # The axis that is least parallel to the normal, so that the cross product is well conditioned.
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)
