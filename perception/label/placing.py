"""Where a person says the block is: corners of its drilled face and its mouths, clicked in one frame or touched in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from perception.label.cuboid import Cuboid, Mouth, cuboid_of, sight

EXAMPLE = """expected YAML such as
  frame: "00012"                                  # where it was clicked
  corners_px: [[512, 300], [840, 310], [505, 560]]  # a corner of the drilled face, then its two neighbours; or corners_m, touched
  thickness_m: 0.6                                # of the block behind the face
  mouths: [{center_px: [660, 420], radius_m: 0.05}]  # or center_m"""
TRIALS, JUDGES, TRIMS = 400, 800, 3


@dataclass(frozen=True)
class Placing:
    """What a person has said.

    Attributes:
        frame: Stem of the frame that was clicked in; `None` where everything was touched.
        corners: A corner of the face and its two neighbours, `(3, 2)` px or `(3, 3)` m in the
            world.
        thickness_m: Of the block behind the face.
        mouths: Centre, `(2,)` px or `(3,)` m, and radius in m of each mouth.
    """

    frame: str | None
    corners: np.ndarray
    thickness_m: float
    mouths: tuple[tuple[np.ndarray, float], ...]


def read(path: Path) -> Placing:
    """Returns what stands in a file.

    Raises:
        ConfigError: it cannot be read, or something is missing; shows how it should look.
    """
    try:
        told = yaml.safe_load(path.read_text())
        corners = np.asarray(
            told["corners_px"] if "corners_px" in told else told["corners_m"], float
        )
        mouths = tuple((_center(one), float(one["radius_m"])) for one in told.get("mouths", ()))
        frame = None if told.get("frame") is None else str(told["frame"])
        placing = Placing(frame, corners, float(told["thickness_m"]), mouths)
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"label.placing={path}: {type(error).__name__} {error}; {EXAMPLE}"
        ) from error
    if (
        corners.shape not in ((3, 2), (3, 3))
        or placing.thickness_m <= 0
        or any(radius_m <= 0 for _, radius_m in mouths)
    ):
        raise ConfigError(
            f"label.placing={path}: corners of shape {corners.shape}, sizes above 0 are needed; {EXAMPLE}"
        )
    if frame is None and any(
        len(points) == 2 for points in (*corners, *(center for center, _ in mouths))
    ):
        raise ConfigError(
            f"label.placing={path}: pixels are given, but not the frame they were clicked in; {EXAMPLE}"
        )
    return placing


def placed(placing: Placing, frame: Frame, world_from_camera: np.ndarray) -> Cuboid:
    """Returns the block as it was placed, its mouths still missing.

    Args:
        placing: What a person has said.
        frame: The frame that was clicked in, any frame that shows the face where everything was
            touched.
        world_from_camera: Its camera, `(4, 4)`.

    Raises:
        FrameError: there is too little depth between the clicked corners.
    """
    corners = placing.corners
    if corners.shape[1] == 2:
        lines = sight(frame, corners)
        local = lines / (lines @ _face_plane(frame, corners))[:, None]
        corners = local @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    return cuboid_of(corners, placing.thickness_m, world_from_camera[:3, 3])


def with_mouths(
    cuboid: Cuboid, placing: Placing, frame: Frame, world_from_camera: np.ndarray
) -> Cuboid:
    """Returns the block with its mouths: where the clicked sight meets the face, or the touched point lies."""
    eye = cuboid.own(world_from_camera[:3, 3])
    mouths = []
    for center, radius_m in placing.mouths:
        if len(center) == 2:
            along = sight(frame, center[None])[0] @ world_from_camera[:3, :3].T @ cuboid.rotation
            at = eye - along * eye[2] / along[2]
        else:
            at = cuboid.own(center)
        mouths.append(Mouth(float(at[0]), float(at[1]), radius_m))
    return replace(cuboid, mouths=tuple(mouths))


def _center(told: dict[str, Any]) -> np.ndarray:
    center = np.asarray(told["center_px"] if "center_px" in told else told["center_m"], float)
    if center.shape != ((2,) if "center_px" in told else (3,)):
        raise ValueError(f"a centre of {center.size} numbers")
    return center


def _face_plane(frame: Frame, corners_px: np.ndarray) -> np.ndarray:
    """Returns the face's plane `n / d`, `(3,)`, camera coordinates, from the depth between its clicked corners."""
    inside = np.zeros(frame.depth_m.shape, np.uint8)
    fourth = corners_px[1] + corners_px[2] - corners_px[0]
    outline = np.stack([corners_px[0], corners_px[1], fourth, corners_px[2]])
    shrunk = outline.mean(0) + 0.9 * (outline - outline.mean(0))
    cv2.fillConvexPoly(inside, np.rint(shrunk).astype(np.int32), 1)
    rows, columns = np.nonzero((inside > 0) & np.isfinite(frame.depth_m))
    if len(rows) < 50:
        raise FrameError(
            f"{frame.name}: depth is known at {len(rows)} pixels between the clicked corners, 50 are needed"
        )
    lines = sight(frame, np.stack([columns, rows], axis=1).astype(float))
    inverse = 1.0 / frame.depth_m[rows, columns].astype(float)
    generator = np.random.default_rng(0)
    triples = generator.integers(len(rows), size=(TRIALS, 3))
    triples = triples[np.abs(np.linalg.det(lines[triples])) > 1e-7]
    trials = np.linalg.solve(lines[triples], inverse[triples][..., None])[..., 0]
    judge = generator.integers(len(rows), size=JUDGES)
    # least median of squares (Rousseeuw, 1984): up to half of what lies between the corners may be
    # an arm, a mouth, a wild match
    plane = trials[np.median(np.abs(trials @ lines[judge].T - inverse[judge]), axis=1).argmin()]
    for _ in range(TRIMS):
        away = np.abs(lines @ plane - inverse)
        kept = away <= 2.5 * 1.4826 * np.median(away) + 1e-9
        plane = np.linalg.lstsq(lines[kept], inverse[kept], rcond=None)[0]
    return plane
