"""Closed forms to begin a calibration with: all poses together, and small groups of poses where some are wrong."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from perception.calibrate import rigid

GROUP = 5
"""Poses of a group: three would do without noise."""
GROUPS = 150
KEPT = 5
"""Of the groups, those whose answer most poses agree with."""
LEAST_TURN = 0.05
"""Relative turns below this, rad, say nothing about an axis."""


def starts(
    base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields guesses of `base_from_camera` and `link_from_board`, `(4, 4)` each; never fails, may be far off.

    Args:
        base_from_link: `(N, 4, 4)`.
        camera_from_board: `(N, C, 4, 4)`.
    """
    count, num_candidates = camera_from_board.shape[:2]
    first = camera_from_board[:, 0]
    yield kronecker(base_from_link, first)
    yield motions(base_from_link, first)
    generator = np.random.default_rng(0)
    found = []
    for _ in range(GROUPS if count > GROUP else 0):
        group = generator.choice(count, GROUP, replace=False)
        which = (
            generator.integers(num_candidates, size=GROUP)
            if generator.random() < 0.5
            else np.zeros(GROUP, int)
        )
        guess = kronecker(base_from_link[group], camera_from_board[group, which])
        found.append((_typical(*guess, base_from_link, camera_from_board), len(found), guess))
    for _, _, guess in sorted(found, key=lambda one: one[:2])[:KEPT]:
        yield guess


def kronecker(
    base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns camera and board at once: `A Y = X B` by the Kronecker product (Shah, 2013)."""
    turns_a, turns_b = base_from_link[:, :3, :3], camera_from_board[:, :3, :3]
    # A Y B' = X; with rows stacked, (A kron B) vec(Y) = vec(X): singular vectors of the largest
    # value of the sum
    table = np.einsum("nij,nkl->ikjl", turns_a, turns_b).reshape(9, 9)
    left, _, right = np.linalg.svd(table)
    x, y = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(x)) or 1.0
    turn_x, turn_y = rigid.nearest_rotation(sign * x), rigid.nearest_rotation(sign * y)
    shift_x, shift_y = _shifts(turn_x, base_from_link, camera_from_board)
    return rigid.pose(turn_x, shift_x), rigid.pose(turn_y, shift_y)


def motions(
    base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the board from the motions between all pairs of poses (Park and Martin, 1994), and the camera that follows."""
    one, other = np.triu_indices(len(base_from_link), 1)
    a = rigid.turn_of(
        np.swapaxes(base_from_link[one, :3, :3], 1, 2) @ base_from_link[other, :3, :3]
    )
    b = rigid.turn_of(
        np.swapaxes(camera_from_board[one, :3, :3], 1, 2) @ camera_from_board[other, :3, :3]
    )
    size = np.linalg.norm(a, axis=1)
    told = (size > LEAST_TURN) & (size < np.pi - 0.2)
    turn_y = rigid.nearest_rotation(a[told].T @ b[told]) if told.sum() >= 2 else np.eye(3)
    turn_x = rigid.nearest_rotation(
        (base_from_link[:, :3, :3] @ turn_y @ np.swapaxes(camera_from_board[:, :3, :3], 1, 2)).sum(
            0
        )
    )
    shift_x, shift_y = _shifts(turn_x, base_from_link, camera_from_board)
    return rigid.pose(turn_x, shift_x), rigid.pose(turn_y, shift_y)


def _shifts(
    turn_x: np.ndarray, base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the shifts of camera and board by least squares: `R_A t_Y - t_X = R_X t_B - t_A`."""
    count = len(base_from_link)
    rows = np.concatenate(
        [np.broadcast_to(-np.eye(3), (count, 3, 3)), base_from_link[:, :3, :3]], 2
    ).reshape(-1, 6)
    right = (camera_from_board[:, :3, 3] @ turn_x.T - base_from_link[:, :3, 3]).reshape(-1)
    found = np.linalg.lstsq(rows, right, rcond=1e-9)[0]
    return found[:3], found[3:]


def _typical(
    x: np.ndarray, y: np.ndarray, base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> float:
    """Returns how far off a guess typically is, in degrees plus units of 20 mm."""
    away = rigid.apart(camera_from_board, (rigid.inverse(x) @ base_from_link @ y)[:, None])
    size = (
        np.degrees(np.linalg.norm(away[..., 3:], axis=-1))
        + np.linalg.norm(away[..., :3], axis=-1) / 0.02
    )
    return float(np.median(size.min(1)))
