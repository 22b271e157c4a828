"""Whether the poses of a calibration say all that is asked of them, and which are missing."""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from perception.calibrate import rigid

AXES = ("forward axis", "axis to the left", "vertical")
RANGE_PERCENT = (5, 95)


def turns_rad(base_from_link: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far the poses turn about three perpendicular axes of their own, most first, and these axes in the base frame.

    Args:
        base_from_link: `(N, 4, 4)`.

    Returns:
        `(3,)` rad from the 5th to the 95th percentile, and the axes as rows, `(3, 3)`.
    """
    middle = rigid.nearest_rotation(base_from_link[:, :3, :3].sum(0))
    vectors = rigid.turn_of(base_from_link[:, :3, :3] @ middle.T)
    axes = np.linalg.svd(vectors - vectors.mean(0), full_matrices=False)[2]
    low, high = np.percentile(vectors @ axes.T, RANGE_PERCENT, axis=0)
    order = np.argsort(low - high)
    return (high - low)[order], axes[order]


def unturned(base_from_link: np.ndarray, distance_m: np.ndarray, least_rad: float) -> list[str]:
    """Returns in words what poses, `(N, 4, 4)`, do not show; empty where they say enough.

    Args:
        base_from_link: The link in the poses that were used.
        distance_m: How far the camera was from the board, `(N,)`.
        least_rad: About two axes at least the poses should turn this far.
    """
    turns, axes = turns_rad(base_from_link)
    found = []
    for number, what in enumerate(("", "second ")):
        if turns[number] < least_rad:
            nearest = AXES[int(np.abs(axes[number]).argmax())]
            found.append(
                f"the poses turn by {np.degrees(turns[number]):.0f} degrees about their {what}axis (near the {nearest}), "
                f"{np.degrees(least_rad):.0f} are needed"
            )
    if distance_m.max() < 1.2 * distance_m.min():
        found.append(
            f"the board is always {distance_m.min():.1f} to {distance_m.max():.1f} m away: add poses nearer and farther, by a fifth"
        )
    return found


def missing(
    machine: Machine,
    q: np.ndarray,
    base_from_link: np.ndarray,
    distance_m: np.ndarray,
    least_rad: float,
) -> list[str]:
    """Returns in words which poses of a machine should be added; see `unturned`.

    Args:
        machine: Names and travel of the joints.
        q: Joint positions of the poses that were used, `(N, J)`.
        base_from_link: The link there.
        distance_m: How far the camera was from the board.
        least_rad: About two axes at least the poses should turn this far.
    """
    found = unturned(base_from_link, distance_m, least_rad)
    if turns_rad(base_from_link)[0][1] < least_rad:
        low, high = q.min(0), q.max(0)
        for column, joint in enumerate(machine.joints):
            if joint.kind == "hinge" and high[column] - low[column] < 0.5 * least_rad:
                room = (
                    "lower"
                    if low[column] - joint.lower.value > joint.upper.value - high[column]
                    else "higher"
                )
                found.append(
                    f"{joint.name} stays within {np.degrees(low[column]):.0f} to {np.degrees(high[column]):.0f} degrees: add poses "
                    f"with it {room}, as far as the board stays in view"
                )
    return found
