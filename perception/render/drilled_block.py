"""The concrete block: a box with drilled holes, chipped rims and painted discs.

The missing volume is a union of convex cavities: half-open cylinders for holes, balls for chips. So
a ray through it is followed exactly: from its entry on, it goes to the end of each cavity that it
is in, until no cavity takes it further.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.render.solids import Box, Hits, Surface

FRONT = 5
"""Part of a box that faces along +z of its pose: the face that is drilled."""
NUM_FACES = 6
_MARCH = 4
"""Cavities that a ray may pass one after another: hole, chip, hole again, and one to spare."""


@dataclass(frozen=True)
class DrilledHole:
    """A cylinder drilled at right angles into face `part` of a block.

    Attributes:
        center_m: Centre of the rim in the block's coordinates, on that face, `(3,)`.
        radius_m: Radius.
        depth_m: From the face to the floor, or to the surface of a filling; 0 for a painted disc.
        part: The face.
    """

    center_m: np.ndarray
    radius_m: float
    depth_m: float
    part: int = FRONT

    @property
    def axis(self) -> int:
        """Axis of the block along which it is drilled: 0, 1 or 2."""
        return self.part // 2

    @property
    def sign(self) -> float:
        """+1 where the outward normal is along that axis, else -1."""
        return 1.0 if self.part % 2 else -1.0

    @property
    def outward(self) -> np.ndarray:
        """Unit vector out of the hole in the block's coordinates, `(3,)`."""
        return self.sign * np.eye(3)[self.axis]

    def across_m(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return two coordinates across the axis and the depth of points, `(…, 3)`, of the block."""
        one, two = (self.axis + 1) % 3, (self.axis + 2) % 3
        away = point - self.center_m.astype(np.float32)
        return away[..., one], away[..., two], -self.sign * away[..., self.axis]

    def interval(
        self, start: np.ndarray, along: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where rays, `(M, 3)`, enter and leave the cavity, and which leave by the floor."""
        x, y, depth = self.across_m(start)
        one, two = (self.axis + 1) % 3, (self.axis + 2) % 3
        dx, dy, sink = along[:, one], along[:, two], -self.sign * along[:, self.axis]
        a = np.maximum(dx * dx + dy * dy, np.float32(1e-12))
        b = x * dx + y * dy
        inside = b * b - a * (x * x + y * y - self.radius_m**2)
        root = np.sqrt(np.maximum(inside, 0.0))
        floor = np.where(
            sink > 1e-9, (self.depth_m - depth) / np.where(sink > 1e-9, sink, 1.0), np.inf
        )
        enter, wall = (-b - root) / a, (-b + root) / a
        leave = np.where(inside > 0, np.minimum(wall, floor), -np.inf)
        return enter, leave, floor < wall


@dataclass(frozen=True)
class Chip:
    """A ball-shaped piece broken off: centre, outside of the face, in block coordinates; radius."""

    center_m: np.ndarray
    radius_m: float

    def interval(self, start: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where rays, `(M, 3)` each, enter and leave the ball."""
        away = start - self.center_m.astype(np.float32)
        a = (along * along).sum(1)
        b = (away * along).sum(1)
        inside = b * b - a * ((away * away).sum(1) - self.radius_m**2)
        root = np.sqrt(np.maximum(inside, 0.0))
        return (-b - root) / a, np.where(inside > 0, (-b + root) / a, -np.inf)


@dataclass(frozen=True)
class DrilledBlock(Box):
    """A box with holes, chips and discs.

    Parts: six faces, wall and floor of each hole, fresh breaks, then the discs.
    """

    holes: tuple[DrilledHole, ...]
    chips: tuple[Chip, ...] = ()
    discs: tuple[DrilledHole, ...] = ()

    @property
    def break_part(self) -> int:
        """Part of the fresh breaks."""
        return NUM_FACES + 2 * len(self.holes)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Return where rays meet the block, inside its holes too."""
        t, part, _ = super().hit(origin, direction)
        mouth = np.zeros(len(t), bool)
        struck = np.flatnonzero(np.isfinite(t))
        start, along = self.pose.local(
            origin if origin.ndim == 1 else origin[struck], direction[struck]
        )
        entry = start + t[struck, None] * along
        near = np.zeros(len(struck), bool)
        for disc_number, disc in enumerate(self.discs):
            x, y = (entry[:, :2] - disc.center_m[:2].astype(np.float32)).T
            on = (part[struck] == FRONT) & (x * x + y * y < disc.radius_m**2)
            part[struck[on]] = self.break_part + 1 + disc_number
        for hole in self.holes:
            x, y, depth = hole.across_m(entry)
            through = (x * x + y * y < hole.radius_m**2) & (np.abs(depth) < 1e-3)
            mouth[struck[through]] = True
            near |= through
        for chip in self.chips:
            away = entry - chip.center_m.astype(np.float32)
            near |= np.einsum("ij,ij->i", away, away) < chip.radius_m**2
        if near.any():
            way, through_part = self._march(entry[near], along[near])
            moved = through_part >= 0
            rows = struck[near][moved]
            t[rows] += way[moved]
            part[rows] = through_part[moved]
        return Hits(t, part, mouth)

    def _march(self, start: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the way of rays through the cavities, and the part that ends it, -1 for none."""
        way, part = np.zeros(len(start), np.float32), np.full(len(start), -1, np.int16)
        cavities = []
        for number, hole in enumerate(self.holes):
            enter, leave, floor = hole.interval(start, along)
            cavities.append((enter, leave, NUM_FACES + 2 * number + floor.astype(np.int16)))
        for chip in self.chips:
            enter, leave = chip.interval(start, along)
            cavities.append((enter, leave, np.full(len(start), self.break_part, np.int16)))
        for _ in range(_MARCH):
            for enter, leave, end in cavities:
                inside = (enter <= way + 1e-6) & (leave > way + 1e-6)
                way = np.where(inside, leave, way).astype(np.float32)
                part = np.where(inside, end, part)
        return way, part

    def surface(self, point: np.ndarray, part: np.ndarray, to_sun: np.ndarray) -> Surface:
        """Describe faces, breaks, discs and the insides of holes, where light falls with depth."""
        flat = np.where(
            (part >= NUM_FACES) & (part >= self.break_part), FRONT, np.minimum(part, FRONT)
        ).astype(np.int16)
        normal, uv, *_ = super().surface(point, flat, to_sun)
        normal = normal.copy()
        openness, sunlit = np.ones(len(part), np.float32), np.ones(len(part), bool)
        local = self.pose.local_point(point)
        sun = (to_sun @ self.pose.rotation).astype(np.float32)
        for number, hole in enumerate(self.holes):
            wall, floor = NUM_FACES + 2 * number, NUM_FACES + 2 * number + 1
            rows = np.flatnonzero((part == wall) | (part == floor))
            if len(rows):
                is_floor = part[rows] == floor
                inside = _describe_inside(hole, local[rows], is_floor, sun)
                normal[rows] = inside.normal @ self.pose.rotation.T.astype(np.float32)
                uv[rows], openness[rows], sunlit[rows] = inside.uv_m, inside.openness, inside.sunlit
        for chip in self.chips:
            away = chip.center_m.astype(np.float32) - local
            on = (part == self.break_part) & (
                np.abs(np.einsum("ij,ij->i", away, away) - chip.radius_m**2) < 1e-4 * chip.radius_m
            )
            normal[on] = (away[on] / chip.radius_m) @ self.pose.rotation.T.astype(np.float32)
        return Surface(normal, uv, openness, sunlit)


def _describe_inside(
    hole: DrilledHole, point: np.ndarray, floor: np.ndarray, sun: np.ndarray
) -> Surface:
    """Describe the inside of a hole in the block's coordinates.

    The part of the sky that is seen through the mouth is, for a ring of the wall at depth h, with x
    = h / 2r: (x^2 + 1/2) / sqrt(x^2 + 1) - x, and for the middle of the floor r^2 / (r^2 + h^2)
    (view factors of a cylinder, Howell's catalogue C-78 and C-13).
    """
    x, y, depth = hole.across_m(point)
    one, two = (hole.axis + 1) % 3, (hole.axis + 2) % 3
    normal = np.zeros_like(point)
    wall = ~floor
    normal[wall, one], normal[wall, two] = -x[wall] / hole.radius_m, -y[wall] / hole.radius_m
    normal[floor, hole.axis] = hole.sign
    half = np.maximum(depth, 0.0) / (2.0 * hole.radius_m)
    ring = (half * half + 0.5) / np.sqrt(half * half + 1.0) - half
    sky = np.where(floor, hole.radius_m**2 / (hole.radius_m**2 + depth * depth), ring)
    rise = sun[hole.axis] * hole.sign
    way = np.maximum(depth, 0.0) / max(rise, 1e-6)
    sunlit = ((x + way * sun[one]) ** 2 + (y + way * sun[two]) ** 2 < hole.radius_m**2) & (rise > 0)
    around = np.stack([np.arctan2(y, x) * hole.radius_m, depth], 1)
    uv = np.where(floor[:, None], np.stack([x, y], 1), around)
    return Surface(normal, uv.astype(np.float32), sky.astype(np.float32), sunlit)
