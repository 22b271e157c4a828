"""Solids that a ray can hit, and their materials, filtered to a pixel's size so that both views agree.

`M` rays start at `origin`, `(3,)` or `(M, 3)`, along `direction`, `(M, 3)`, all float32 in camera
coordinates (m; x right, y down, z forward). Directions need not be unit vectors: a hit is given as
the factor `t` on the direction, `inf` for a miss. Each solid has parts (faces, walls of holes, …)
with a material of its own.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

TEXTURE_SIDE = 1024
"""Texels of a texture along each side; it repeats beyond."""
NUM_TEXTURES = 4
_FINEST_OCTAVE, _COARSEST_OCTAVE = 10, 3
_ROW = 1024
"""Points are handed to OpenCV in rows of this length, as it takes no longer ones."""


@dataclass(frozen=True)
class Material:
    """A matt surface.

    Attributes:
        color: Reflected part of the light, RGB, each in [0, 1].
        contrast: Standard deviation of its brightness over the surface, relative to the mean.
        texel_m: Size of the finest grain.
        texture: Which of the `NUM_TEXTURES` patterns of grain.
        shift: Where the pattern begins, texels.
        marks: Brightness painted over it, `(h, w)` float32, 1 for none, and the size of its texels
            in m; repeats beyond.
    """

    color: tuple[float, ...]
    contrast: float
    texel_m: float
    texture: int = 0
    shift: tuple[float, ...] = (0.0, 0.0)
    marks: tuple[np.ndarray, float] | None = None

    def albedo(self, uv_m: np.ndarray, pixel_m: np.ndarray) -> np.ndarray:
        """Return the reflected part of the light, `(M, 3)`.

        Args:
            uv_m: Where on the surface, `(M, 2)`.
            pixel_m: Size of a pixel there, `(M,)`.
        """
        uv = uv_m / np.float32(self.texel_m) + np.asarray(self.shift, np.float32)
        level = np.log2(np.maximum(pixel_m / self.texel_m, 1.0))
        grain = _sample_pyramid(_build_pyramid(self.texture), uv, level)
        bright = np.clip(1.0 + self.contrast * grain, 0.15, 1.9)[:, None]
        if self.marks is not None:
            picture, size_m = self.marks
            center = uv_m / np.float32(size_m) + np.array(picture.shape[::-1], np.float32) / 2
            bright = bright * _interpolate_bilinear(picture, center)[:, None]
        return bright * np.asarray(self.color, np.float32)


@lru_cache(maxsize=NUM_TEXTURES)
def _build_pyramid(number: int) -> tuple[np.ndarray, ...]:
    """Return a periodic pattern, mean 0 and deviation 1, and its reductions by two to one texel.

    The patterns are the same for every scene: a scene differs in where, how strong and in which
    colours they appear.
    """
    generator = np.random.default_rng(9000 + number)
    # Strength of each octave relative to the one twice as coarse: from cloudy to speckled.
    rise = (0.9, 1.0, 1.15, 1.3)[number]
    total = np.zeros((TEXTURE_SIDE, TEXTURE_SIDE), np.float32)
    for octave in range(_COARSEST_OCTAVE, _FINEST_OCTAVE + 1):
        coarse = generator.standard_normal((1 << octave, 1 << octave)).astype(np.float32)
        pad = 2
        scale = TEXTURE_SIDE >> octave
        padded = np.pad(coarse, pad, mode="wrap")
        wide = cv2.resize(padded, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        inner = slice(pad * scale, pad * scale + TEXTURE_SIDE)
        total += rise ** (octave - _COARSEST_OCTAVE) * wide[inner, inner]
    if number >= NUM_TEXTURES // 2:  # gravel: bright and dark stones
        total = np.tanh(2.0 * total / total.std())
    levels = [(total - total.mean()) / total.std()]
    while levels[-1].shape[0] > 1:
        side = levels[-1].shape[0] // 2
        levels.append(
            cv2.resize(levels[-1], (side, side), interpolation=cv2.INTER_AREA).reshape(side, side)
        )
    return tuple(levels)


def _sample_pyramid(
    pyramid: tuple[np.ndarray, ...], uv: np.ndarray, level: np.ndarray
) -> np.ndarray:
    """Return the pattern at `uv`, `(M, 2)` finest texels, blended between the levels at `level`."""
    level = np.minimum(level, len(pyramid) - 1.001)
    total = np.zeros(len(uv), np.float32)
    for number in range(int(level.min()), int(level.max()) + 2):
        weight = 1.0 - np.abs(level - number)
        rows = np.flatnonzero(weight > 0)
        if len(rows):
            total[rows] += weight[rows] * _interpolate_bilinear(
                pyramid[number], (uv[rows] + 0.5) / np.float32(1 << number) - 0.5
            )
    return total


def _interpolate_bilinear(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the periodic picture at `uv`, `(M, 2)` as x and y."""
    height, width = picture.shape[:2]
    size = np.array([width, height], np.float32)
    wrapped = uv - np.floor(uv / size) * size
    count = len(uv)
    rows = -(-count // _ROW)
    maps = np.zeros((2, rows * _ROW), np.float32)
    maps[:, :count] = wrapped.T
    x, y = maps.reshape(2, rows, _ROW)
    found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return found.ravel()[:count]


PAINT = Material((0.6, 0.35, 0.06), 0.1, 0.002)
"""Faded yellow of a demolition machine."""
SHORTEST_ROD_M = 1e-3
NEAR_M = 1e-4
"""Hits nearer than this are those of the surface that a shadow ray starts on."""


class Hits(NamedTuple):
    """Where rays meet one solid.

    Attributes:
        t: Factor on the direction, `inf` where they miss, `(M,)`.
        part: Index of the part, `(M,)` int16.
        mouth: They pass through the rim of a hole, `(M,)` bool; `None` for solids without.
    """

    t: np.ndarray
    part: np.ndarray
    mouth: np.ndarray | None = None


class Surface(NamedTuple):
    """Surface of a solid at `M` points.

    Attributes:
        normal: Unit normals, `(M, 3)`.
        uv_m: Coordinates of the texture in m, `(M, 2)`.
        openness: Part of the ambient light that arrives, `(M,)`; `None` for all of it.
        sunlit: The solid itself does not shade the point, `(M,)` bool; `None` where only the normal
            decides.
    """

    normal: np.ndarray
    uv_m: np.ndarray
    openness: np.ndarray | None = None
    sunlit: np.ndarray | None = None


@dataclass(frozen=True)
class SolidPose:
    """Pose in camera coordinates: `rotation`, `(3, 3)`, its columns the axes; `center_m`, `(3,)`."""

    rotation: np.ndarray
    center_m: np.ndarray

    def local(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rays in the solid's coordinates."""
        turn = self.rotation.astype(np.float32)
        return ((origin - self.center_m) @ self.rotation).astype(np.float32), direction @ turn

    def local_point(self, point_m: np.ndarray) -> np.ndarray:
        """Return points, `(M, 3)`, of the camera's coordinates in those of the solid, float32."""
        away_m = point_m - self.center_m.astype(np.float32)
        return away_m @ self.rotation.astype(np.float32)

    def list_corners(self, half_m: np.ndarray) -> np.ndarray:
        """Return the corners, `(8, 3)`, of a box about the origin in the camera's coordinates."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return self.point(signs * half_m)

    def point(self, local_m: np.ndarray) -> np.ndarray:
        """Return a point, `(…, 3)`, of the solid's coordinates in those of the camera."""
        return local_m @ self.rotation.T + self.center_m


def build_frame(normal: np.ndarray, turn_rad: float) -> np.ndarray:
    """Return a rotation whose third column is along `normal`, `(3,)`, turned about it."""
    normal = normal / np.linalg.norm(normal)
    first = np.cross(
        np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.9 else np.array([1.0, 0.0, 0.0]), normal
    )
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    return np.stack([cos * first + sin * second, cos * second - sin * first, normal], 1)


@dataclass(frozen=True)
class PlaneSolid:
    """A plane without end: the third axis of `pose` is its normal."""

    role: str
    pose: SolidPose
    materials: tuple[Material, ...]
    corners_m: None = None
    """A solid without end has none."""

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Return where rays meet the plane, from either side."""
        start, along = self.pose.local(origin, direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -start[..., 2] / along[:, 2]
        t = np.where(t > NEAR_M, t, np.inf).astype(np.float32)
        return Hits(t, np.zeros(len(t), np.int16))

    def surface(self, point: np.ndarray, part: np.ndarray, to_sun: np.ndarray) -> Surface:
        """Describe the plane; its texture lies along its first two axes."""
        normal = np.broadcast_to(self.pose.rotation[:, 2].astype(np.float32), point.shape)
        return Surface(normal, self.pose.local_point(point)[:, :2])


@dataclass(frozen=True)
class Box:
    """A box about the origin of `pose`.

    Parts: faces -x, +x, -y, +y, -z, +z; one material may serve all of them.
    """

    role: str
    pose: SolidPose
    half_m: np.ndarray
    materials: tuple[Material, ...]

    @property
    def corners_m(self) -> np.ndarray:
        """The eight corners."""
        return self.pose.list_corners(self.half_m)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Return where rays enter the box; rays that start inside miss."""
        start, along = self.pose.local(origin, direction)
        half = self.half_m.astype(np.float32)
        enter = np.full(len(along), -np.inf, np.float32)
        leave = np.full(len(along), np.inf, np.float32)
        part = np.zeros(len(along), np.int16)
        for axis in range(3):
            slope = along[:, axis]
            slope = np.where(np.abs(slope) < 1e-12, np.float32(1e-12), slope)
            side = np.where(slope > 0, -half[axis], half[axis])
            near = (side - start[..., axis]) / slope
            far = (-side - start[..., axis]) / slope
            later = near > enter
            enter = np.where(later, near, enter)
            part = np.where(
                later, np.where(slope > 0, 2 * axis, 2 * axis + 1).astype(np.int16), part
            )
            leave = np.minimum(leave, far)
        t = np.where((enter <= leave) & (enter > NEAR_M), enter, np.inf).astype(np.float32)
        return Hits(t, part)

    def surface(self, point: np.ndarray, part: np.ndarray, to_sun: np.ndarray) -> Surface:
        """Describe faces; opposite ones show different places of the texture."""
        local = self.pose.local_point(point)
        axis, sign = part // 2, (2.0 * (part % 2) - 1.0).astype(np.float32)
        normal = self.pose.rotation.T.astype(np.float32)[axis] * sign[:, None]
        rows = np.arange(len(part))
        uv = np.stack([local[rows, (axis + 1) % 3], local[rows, (axis + 2) % 3]], 1)
        return Surface(normal, uv + 0.37 * part[:, None].astype(np.float32))


@dataclass(frozen=True)
class Cylinder:
    """A cylinder with caps along the third axis of `pose`. Parts: side, cap."""

    role: str
    pose: SolidPose
    radius_m: float
    half_length_m: float
    materials: tuple[Material, ...]

    @property
    def corners_m(self) -> np.ndarray:
        """The eight corners of the box around it."""
        half_m = np.array([self.radius_m, self.radius_m, self.half_length_m])
        return self.pose.list_corners(half_m)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Return where rays enter the cylinder."""
        start, along = self.pose.local(origin, direction)
        across = along[:, 0] ** 2 + along[:, 1] ** 2
        across = np.maximum(across, np.float32(1e-12))
        # about the point that is nearest to the axis: the difference of large squares would cost
        # the digits that matter
        middle = -(start[..., 0] * along[:, 0] + start[..., 1] * along[:, 1]) / across
        x, y = start[..., 0] + middle * along[:, 0], start[..., 1] + middle * along[:, 1]
        root = np.sqrt(np.maximum(self.radius_m**2 - x * x - y * y, 0.0) / across)
        outside = x * x + y * y > self.radius_m**2
        slope = np.where(np.abs(along[:, 2]) < 1e-12, np.float32(1e-12), along[:, 2])
        side = np.where(slope > 0, -self.half_length_m, self.half_length_m)
        cap, end = (side - start[..., 2]) / slope, (-side - start[..., 2]) / slope
        enter, leave = np.maximum(middle - root, cap), np.minimum(middle + root, end)
        t = np.where((enter <= leave) & (enter > NEAR_M) & ~outside, enter, np.inf).astype(
            np.float32
        )
        return Hits(t, (cap > middle - root).astype(np.int16))

    def surface(self, point: np.ndarray, part: np.ndarray, to_sun: np.ndarray) -> Surface:
        """Describe side and caps; the texture goes round the side."""
        local = self.pose.local_point(point)
        side, up = local.copy(), np.zeros_like(local)
        side[:, 2] = 0.0
        side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
        up[:, 2] = np.sign(local[:, 2])
        normal = np.where((part == 0)[:, None], side, up) @ self.pose.rotation.T.astype(np.float32)
        around = np.stack([np.arctan2(local[:, 1], local[:, 0]) * self.radius_m, local[:, 2]], 1)
        return Surface(
            normal, np.where((part == 0)[:, None], around, local[:, :2]).astype(np.float32)
        )


Solid = PlaneSolid | Box | Cylinder
"""Something that a ray can hit, with a role: `block`, `arm`, `ground`, `clutter` or `board`."""


def move_solid(solid: Any, turn: np.ndarray, shift_m: np.ndarray) -> Any:
    """Return a solid turned about the origin, `(3, 3)`, and then shifted, `(3,)`."""
    pose = SolidPose(turn @ solid.pose.rotation, turn @ solid.pose.center_m + shift_m)
    return replace(solid, pose=pose)


def build_rods(points_m: np.ndarray, link_m: float, tool_m: float) -> list[Solid]:
    """Return an arm as cylinders of these radii between points, `(P, 3)`; the last one is the tool."""
    rods: list[Solid] = []
    for number, (begin, end) in enumerate(itertools.pairwise(points_m)):
        length_m = float(np.linalg.norm(end - begin))
        if length_m > SHORTEST_ROD_M:
            radius_m = tool_m if number == len(points_m) - 2 else link_m
            pose = SolidPose(build_frame(end - begin, 0.0), (begin + end) / 2)
            rods.append(Cylinder("arm", pose, radius_m, length_m / 2, (PAINT,)))
    return rods
