"""A block of concrete as a cuboid with round mouths, its projection, and its placing by clicks."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from perception.robust_fit import fit_linear, guess_plane


@dataclass(frozen=True)
class Mouth:
    """Rim of a hole: its centre in the drilled face's coordinates and its radius, m."""

    x_m: float
    y_m: float
    radius_m: float


@dataclass(frozen=True)
class Cuboid:
    """A block.

    Its own coordinates: one corner of the drilled face at the origin, the face along +x and +y, the
    block towards -z.

    Attributes:
        rotation: From its coordinates to the world, `(3, 3)`.
        origin_m: That corner in the world, `(3,)`.
        size_m: Width and height of the face, thickness behind it, `(3,)`.
        mouths: Mouths of holes in the face.
    """

    rotation: np.ndarray
    origin_m: np.ndarray
    size_m: np.ndarray
    mouths: tuple[Mouth, ...] = ()

    @property
    def low_m(self) -> np.ndarray:
        """Lower bounds in its own coordinates, `(3,)`."""
        return np.array([0.0, 0.0, -self.size_m[2]])

    @property
    def high_m(self) -> np.ndarray:
        """Upper bounds in its own coordinates, `(3,)`."""
        return np.array([self.size_m[0], self.size_m[1], 0.0])

    def world(self, points_m: np.ndarray) -> np.ndarray:
        """Return points of its own coordinates, `(…, 3)`, in the world."""
        return points_m @ self.rotation.T + self.origin_m

    def own(self, points_m: np.ndarray) -> np.ndarray:
        """Return points of the world, `(…, 3)`, in its own coordinates."""
        return (points_m - self.origin_m) @ self.rotation

    def locate(self, mouth: int) -> np.ndarray:
        """Return the centre of a mouth in its own coordinates, `(3,)`."""
        return np.array([self.mouths[mouth].x_m, self.mouths[mouth].y_m, 0.0])

    def moved(self, change: np.ndarray) -> Cuboid:
        """Return the block turned about its face's middle, shifted, and with another face.

        Args:
            change: Rotation vector (3, rad), shift (3, m), growth of the face (2, m), and shift of
                each mouth on it (2, m).
        """
        middle = self.world(self.high_m * [0.5, 0.5, 0.0])
        turn = Rotation.from_rotvec(change[:3]).as_matrix()
        size_m = self.size_m + np.array([change[6], change[7], 0.0])
        rotation = turn @ self.rotation
        # The face grows on both sides of its middle.
        origin_m = middle + change[3:6] - rotation @ (size_m * [0.5, 0.5, 0.0])
        mouths = []
        for number, one in enumerate(self.mouths):
            shift_m = change[6:8] / 2 + change[8 + 2 * number : 10 + 2 * number]
            mouths.append(Mouth(one.x_m + shift_m[0], one.y_m + shift_m[1], one.radius_m))
        return Cuboid(rotation, origin_m, size_m, tuple(mouths))

    def edges(self, eye_m: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the edges of the faces that are seen, as end points in its own coordinates.

        Args:
            eye_m: Where from, world, `(3,)`.
        """
        eye = self.own(eye_m)
        bounds = self.low_m, self.high_m
        edges = []
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            for first, second in itertools.product((0, 1), (0, 1)):
                begin = self.low_m.copy()
                begin[one], begin[two] = bounds[first][one], bounds[second][two]
                end = begin.copy()
                end[axis] = self.high_m[axis]
                is_seen = False
                for across, side in ((one, first), (two, second)):
                    beyond = eye[across] - bounds[side][across]
                    is_seen |= bool(beyond > 0 if side else beyond < 0)
                if is_seen:
                    edges.append((begin, end))
        return edges


@dataclass(frozen=True)
class CuboidView:
    """Projection of a cuboid into a picture; all `(h, w)`.

    Attributes:
        depth_m: Depth along z of its visible part, infinite beside it.
        mouth: Number of the mouth that is seen, -1 beside them.
    """

    depth_m: np.ndarray
    mouth: np.ndarray


def trace_rays(cuboid: Cuboid, rays: np.ndarray, world_from_camera: np.ndarray) -> CuboidView:
    """Follow rays until they meet the cuboid.

    Args:
        cuboid: The block.
        rays: Lines of sight at depth 1 in the camera's frame, `(…, 3)`, see `compute_pixel_rays`.
        world_from_camera: Pose of the camera, `(4, 4)`.
    """
    eye = cuboid.own(world_from_camera[:3, 3])
    along = rays @ (world_from_camera[:3, :3].T @ cuboid.rotation)
    along = np.where(np.abs(along) < 1e-9, 1e-9, along)
    low, high = (cuboid.low_m - eye) / along, (cuboid.high_m - eye) / along
    first = np.minimum(low, high)
    enters, leaves = first.max(-1), np.maximum(low, high).min(-1)
    hit = (enters > 0) & (enters < leaves)
    # A ray against z enters through the drilled face, at z = 0.
    on_face = hit & (first.argmax(-1) == 2) & (along[..., 2] < 0)
    point = eye + along * np.where(hit, enters, 0.0)[..., None]
    mouth = np.full(hit.shape, -1)
    for number, one in enumerate(cuboid.mouths):
        away_m = np.hypot(point[..., 0] - one.x_m, point[..., 1] - one.y_m)
        mouth[on_face & (away_m < one.radius_m)] = number
    return CuboidView(np.where(hit, enters, np.inf), mouth)


def compute_pixel_rays(frame: Frame) -> np.ndarray:
    """Return the undistorted rays of all pixels at depth 1, `(h, w, 3)`."""
    height, width = frame.color.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    return compute_rays(frame, np.stack([columns, rows], axis=-1))


def compute_rays(frame: Frame, pixels: np.ndarray) -> np.ndarray:
    """Return the lines of sight of pixels `(…, 2)` at depth 1, `(…, 3)`."""
    matrix = np.asarray(frame.camera_matrix, float)
    if frame.distortion is None or not np.any(frame.distortion):
        flat = (pixels - matrix[:2, 2]) / [matrix[0, 0], matrix[1, 1]]
    else:
        flat = np.asarray(
            cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, frame.distortion)
        ).reshape(pixels.shape)
    return np.concatenate([flat, np.ones((*pixels.shape[:-1], 1))], axis=-1)


def project_points(points_m: np.ndarray, frame: Frame, world_from_camera: np.ndarray) -> np.ndarray:
    """Return where points of the world, `(n, 3)`, are seen, `(n, 2)` px; NaN behind the camera."""
    local = (points_m - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    ahead = local[:, 2] > 0.05
    pixels = np.full((len(points_m), 2), np.nan)
    if ahead.any():
        zero = np.zeros(3)
        there = np.ascontiguousarray(local[ahead])
        seen, _ = cv2.projectPoints(
            there, zero, zero, np.asarray(frame.camera_matrix, float), frame.distortion
        )
        pixels[ahead] = np.asarray(seen).reshape(-1, 2)
    return pixels


def build_cuboid(corners_m: np.ndarray, thickness_m: float, eye_m: np.ndarray) -> Cuboid:
    """Return the block whose drilled face has three known corners.

    Args:
        corners_m: A corner and its two neighbours on the face, `(3, 3)`, world.
        thickness_m: Of the block behind the face.
        eye_m: A point in front of the face, world.
    """
    one, two = corners_m[1] - corners_m[0], corners_m[2] - corners_m[0]
    if np.cross(one, two) @ (eye_m - corners_m[0]) < 0:
        one, two = two, one
    x = one / np.linalg.norm(one)
    z = np.cross(one, two) / np.linalg.norm(np.cross(one, two))
    y = np.cross(z, x)
    return Cuboid(
        np.stack([x, y, z], axis=1),
        corners_m[0],
        np.array([np.linalg.norm(one), two @ y, thickness_m]),
    )


EXAMPLE = """expected YAML such as
  frame: "00012"   # where it was clicked
  # a corner of the drilled face, then its two neighbours
  corners_px: [[512, 300], [840, 310], [505, 560]]
  thickness_m: 0.6 # of the block behind the face
  mouths: [{center_px: [660, 420], radius_m: 0.05}]"""
# Robust fit of the face's plane; all chosen by hand.
MIN_FACE_PIXELS = 50
"""Pixels with depth that the plane needs."""
FACE_SHARE = 0.9
"""Part of the clicked face that is used, about its middle: clicks are a few pixels off."""


@dataclass(frozen=True)
class BlockPlacing:
    """Placing of the block by a person.

    Attributes:
        frame: Stem of the frame that was clicked in.
        corners_px: A corner of the face and its two neighbours, `(3, 2)`.
        thickness_m: Of the block behind the face.
        mouths: Centre, `(2,)` px, and radius in m of each mouth.
    """

    frame: str
    corners_px: np.ndarray
    thickness_m: float
    mouths: tuple[tuple[np.ndarray, float], ...]


def read_placing(path: Path) -> BlockPlacing:
    """Read a placing from YAML.

    Raises:
        ConfigError: it cannot be read, or something is missing; shows the expected form.
    """
    try:
        data = yaml.safe_load(path.read_text())
        corners_px = np.asarray(data["corners_px"], float)
        mouths = []
        for one in data.get("mouths", ()):
            mouths.append((np.asarray(one["center_px"], float), float(one["radius_m"])))
        placing = BlockPlacing(
            str(data["frame"]), corners_px, float(data["thickness_m"]), tuple(mouths)
        )
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"label.placing={path}: {type(error).__name__} {error}; {EXAMPLE}"
        ) from error
    smallest = min([placing.thickness_m, *(radius_m for _, radius_m in mouths)])
    has_pixels = all(center_px.shape == (2,) for center_px, _ in mouths)
    if corners_px.shape != (3, 2) or not has_pixels or smallest <= 0:
        raise ConfigError(
            f"label.placing={path}: corners of shape {corners_px.shape}; three corners and centres "
            f"of two numbers, and sizes above 0 are needed; {EXAMPLE}"
        )
    return placing


def place_cuboid(placing: BlockPlacing, frame: Frame, world_from_camera: np.ndarray) -> Cuboid:
    """Return the block as it was placed, its mouths still missing.

    Args:
        placing: Corners, thickness, mouths.
        frame: The frame that was clicked in.
        world_from_camera: Its camera, `(4, 4)`.

    Raises:
        FrameError: there is too little depth between the clicked corners.
    """
    lines = compute_rays(frame, placing.corners_px)
    local = lines / (lines @ _fit_face_plane(frame, placing.corners_px))[:, None]
    corners_m = local @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    return build_cuboid(corners_m, placing.thickness_m, world_from_camera[:3, 3])


def place_mouths(
    cuboid: Cuboid, placing: BlockPlacing, frame: Frame, world_from_camera: np.ndarray
) -> Cuboid:
    """Return the block with its mouths where clicked rays meet the face."""
    eye = cuboid.own(world_from_camera[:3, 3])
    mouths = []
    for center_px, radius_m in placing.mouths:
        ray = compute_rays(frame, center_px[None])[0]
        along = ray @ world_from_camera[:3, :3].T @ cuboid.rotation
        point = eye - along * eye[2] / along[2]
        mouths.append(Mouth(float(point[0]), float(point[1]), radius_m))
    return replace(cuboid, mouths=tuple(mouths))


def _fit_face_plane(frame: Frame, corners_px: np.ndarray) -> np.ndarray:
    """Return the face's plane `n / d`, `(3,)`, camera coordinates, by depth between its corners."""
    inside = np.zeros(frame.depth_m.shape, np.uint8)
    fourth = corners_px[1] + corners_px[2] - corners_px[0]
    outline = np.stack([corners_px[0], corners_px[1], fourth, corners_px[2]])
    shrunk = outline.mean(0) + FACE_SHARE * (outline - outline.mean(0))
    cv2.fillConvexPoly(inside, np.rint(shrunk).astype(np.int32), 1)
    rows, columns = np.nonzero((inside > 0) & np.isfinite(frame.depth_m))
    if len(rows) < MIN_FACE_PIXELS:
        raise FrameError(
            f"{frame.name}: depth is known at {len(rows)} pixels between the clicked corners, "
            f"{MIN_FACE_PIXELS} are needed"
        )
    rays = compute_rays(frame, np.stack([columns, rows], axis=1).astype(float))
    inverse = 1.0 / frame.depth_m[rows, columns].astype(float)
    # Up to half of the pixels between the corners may show an arm, a mouth or a wrong match.
    start = guess_plane(rays, inverse, np.random.default_rng(0))
    # The residuals of a matcher that smooths can be 0.
    return fit_linear(rays, inverse, 1e-6, start)[0]
