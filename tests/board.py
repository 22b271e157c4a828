"""A board on the arm as a camera sees it, for tests of calibration: poses with known errors, and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from brokk_rl.extensions import load_part
from brokk_rl.machine import Machine
from perception.calibrate import arm, transforms
from perception.calibrate.hand_eye import HandEyeViews

SIZE_PX = (1280, 720)
MATRIX = np.array([[700.0, 0.0, 639.5], [0.0, 700.0, 359.5], [0.0, 0.0, 1.0]])
CAMERA = transforms.make_transform(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    @ Rotation.from_euler("xyz", [-0.5, 0.15, 0.05]).as_matrix(),
    np.array([0.3, 0.45, 1.9]),
)
"""Where the camera truly is: on the machine's left, looking ahead and down."""
MIDDLE = np.array([0.0, -0.75, 0.6, 0.5, 0.5])


@dataclass(frozen=True)
class Posed:
    """Poses of the arm: positions as the sensors say, `(N, J)`, and where the board truly is in the camera, `(N, 4, 4)`."""

    q: np.ndarray
    camera_from_board: np.ndarray
    link_from_board: np.ndarray


def posed(
    machine: Machine,
    count: int,
    seed: int,
    zero_rad: float = 0.0,
    own_rad: float = 0.0,
    wobble_m: float = 0.0,
) -> Posed:
    """Draws poses in which the board, whose z points away from who looks at it, faces the camera, in view.

    Args:
        machine: The arm.
        count: How many.
        seed: Of all draws.
        zero_rad: Standard deviation of the joints' zeros, but for the first and the last, which no
            camera can tell.
        own_rad: That of each joint in each pose.
        wobble_m: By how much, and by as many rad, the link is elsewhere.
    """
    chance = np.random.default_rng(seed)
    turn = Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix()
    facing = transforms.make_transform(turn, np.array([-0.35, -0.2, 2.1]))
    middle = arm.compute_link_poses(machine, MIDDLE[None]).base_from_link[0]
    board = np.linalg.inv(middle) @ CAMERA @ facing
    zeros = zero_rad * chance.standard_normal(5) * [0, 1, 1, 1, 0]
    kept, seen = [], []
    while len(kept) < count:
        q = MIDDLE + chance.uniform(-1, 1, 5) * [0.35, 0.2, 0.35, 0.4, 0.45]
        true = q + zeros + own_rad * chance.standard_normal(5)
        link = arm.compute_link_poses(machine, true[None]).base_from_link[0]
        link = transforms.apply_motion(link, wobble_m * chance.standard_normal(6))
        there = np.linalg.inv(CAMERA) @ link @ board
        corners = corners_m() @ there[:3, :3].T + there[:3, 3]
        pixel = corners @ MATRIX.T / np.maximum(corners[:, 2:], 1e-3)
        inside = (pixel[:, :2] > 5).all() and (pixel[:, :2] < np.array(SIZE_PX) - 5).all()
        if corners[:, 2].min() > 0.8 and inside and there[2, 2] > 0.45:
            kept.append(q)
            seen.append(there)
    return Posed(np.array(kept), np.array(seen), board)


@lru_cache
def charuco() -> Any:
    """Returns the ChArUco board of `conf/board.yaml`."""
    return load_part("board")


def corners_m() -> np.ndarray:
    """Returns its outer corners, `(4, 3)`."""
    width, height = charuco().columns * charuco().square_m, charuco().rows * charuco().square_m
    return np.array([[0.0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]])


def views(
    machine: Machine, poses: Posed, cov: np.ndarray, seed: int, wrong: float = 0.0
) -> tuple[HandEyeViews, np.ndarray]:
    """Returns sights with noise of covariance `cov`, `(6, 6)`, and which of them, a share `wrong`, are of something else."""
    chance = np.random.default_rng(seed + 1000)
    count, links = len(poses.q), arm.compute_link_poses(machine, poses.q)
    off = chance.multivariate_normal(np.zeros(6), cov, len(poses.camera_from_board))
    seen = np.array(list(map(transforms.apply_motion, poses.camera_from_board, off)))
    bad = np.zeros(count, bool)
    bad[chance.permutation(count)[: int(wrong * count)]] = True
    for k in np.flatnonzero(bad):
        gross = np.concatenate([chance.normal(0, 0.3, 3), chance.normal(0, 0.6, 3)])
        seen[k] = transforms.apply_motion(seen[k], gross)
    shared, std = links.joints[:, 1:4], np.full(3, 0.0087)
    wobble = arm.build_wobble_motions(links.base_from_link, 0.001, 0.001)
    slack = np.concatenate([0.0017 * links.joints, wobble], 1)
    found = HandEyeViews(
        links.base_from_link, seen[:, None], np.broadcast_to(cov, (count, 1, 6, 6)), slack, shared, std,
        tuple(str(k) for k in range(count)), machine.joint_names[1:4],
    )  # fmt: skip
    return found, bad


@lru_cache
def sheet() -> np.ndarray:
    """Returns the board as it is printed, `(h, w)` uint8."""
    spec = charuco()
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    board = cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_m, spec.marker_m, markers)
    return board.generateImage((100 * spec.columns, 100 * spec.rows))


def picture(
    camera_from_board: np.ndarray, chance: np.random.Generator, shift_px: float = 0.0
) -> np.ndarray:
    """Returns what the camera sees of the board before something grey, RGB, `(720, 1280, 3)` uint8; shifted to the right."""
    printed = sheet()
    width, height = printed.shape[::-1]
    there = corners_m() @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
    pixel = (there @ MATRIX.T / there[:, 2:])[:, :2] + [shift_px, 0.0]
    paper = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    over = 2  # drawn larger and shrunk, or edges would be ragged
    scaled = (pixel * over + (over - 1) / 2).astype(np.float32)
    warp = cv2.getPerspectiveTransform(paper.astype(np.float32), scaled)
    large = cv2.warpPerspective(
        printed,
        warp,
        (SIZE_PX[0] * over, SIZE_PX[1] * over),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=90,
    )
    gray = cv2.resize(large, SIZE_PX, interpolation=cv2.INTER_AREA).astype(np.float32)
    gray = 20 + 0.75 * gray + 3 * chance.standard_normal(gray.shape, np.float32)
    return np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, 2)
