"""Data types that simulation, policy and machine share.

Shapes: `N` environments (absent on the machine), `J` joints. Arrays are numpy on the machine and
torch in the simulator.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class JointState:
    """Measured joint positions, shape `(…, J)` in rad or m, at `t_s`."""

    t_s: float
    q: Any


@dataclass(frozen=True)
class Command:
    """Valve commands, shape `(…, J)`, each in [-1, 1]; + moves the joint in its positive direction."""

    u: Any


@dataclass(frozen=True)
class Frame:
    """One RGB-D frame of a camera in the optical convention: x right, y down, z forward.

    Attributes:
        color: RGB, `(h, w, 3)` uint8.
        depth_m: Depth along z, `(h, w)` float32 in m, NaN where unknown; never 0, never infinite.
        camera_matrix: `(3, 3)`, px; pixel centres at whole numbers.
        base_from_camera: Pose of the camera in the base frame when the picture was taken, `(4, 4)`;
            `None` for unknown.
        t_s: Time of the picture.
        distortion: Coefficients of the lens in OpenCV's order; `None` for a rectified picture.
        right: Right picture of a rectified stereo pair, as `color`; `None` where there is none.
        baseline_m: Distance between the two cameras of the pair.
        name: Path of a frame on disk without its endings, else ''.
        camera_cov: Covariance of the camera's pose, the same error in all frames: of a small motion
            in its own coordinates, `(6, 6)`, m and then rad; `None` for unknown.
        disparity_std_px: Standard deviation of the error that the pair's disparity has in all
            frames alike, px: of a constant, and of its slopes per unit of x / z and y / z. 0 for a
            perfect pair, `None` for one that was not calibrated.
        disparity_error_px: Known error of the disparity between the two pictures, px: a constant,
            and slopes per unit of x / z and y / z. `depth_m` is free of it, `right` still has it.
        gamma: Exponent of the camera's tone curve: values are light to the power 1 / gamma. 1 for
            linear pictures; real cameras have about 2.2.
        depth_shrink: Pixels of the picture to one for which depth was measured, in each direction.
    """

    color: np.ndarray
    depth_m: np.ndarray
    camera_matrix: np.ndarray
    base_from_camera: np.ndarray | None
    t_s: float
    distortion: np.ndarray | None = None
    right: np.ndarray | None = None
    baseline_m: float | None = None
    name: str = ""
    camera_cov: np.ndarray | None = None
    disparity_std_px: float | None = None
    disparity_error_px: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gamma: float = 1.0
    depth_shrink: int = 1
