"""Random blocks: faces, holes, chips, painted discs that look like holes, and stains."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from brokk_rl.spec import Range
from perception.render.drilled_block import FRONT, Chip, DrilledBlock, DrilledHole
from perception.render.materials import NUM_TEXTURES, TEXTURE_SIDE, Material
from perception.render.scene_ranges import BlockRanges, CountRange, RangeSampler
from perception.render.solids import SolidPose, build_frame

MARK_M = 0.002
"""Texel of painted marks: stains, wet patches, cracks."""
_TRIES = 60
_SPACING = 1.3
"""Two discs or holes are farther apart than the sum of their radii by this factor."""


class BlockSampler(RangeSampler):
    """Draw blocks from ranges.

    Args:
        kind: The ranges.
        generator: The only source of chance.
    """

    def __init__(self, kind: BlockRanges, generator: np.random.Generator) -> None:
        super().__init__(generator)
        self._kind = kind

    def draw(self, target: np.ndarray, normal: np.ndarray, turn_rad: float) -> DrilledBlock:
        """Return a block that faces along `normal`, its first hole (or its middle) at `target`."""
        kind = self._kind
        sides = (kind.length_m, kind.width_m, kind.thickness_m)
        half = np.array([self.uniform(side) for side in sides]) / 2
        radius, edge = self.uniform(kind.radius_m), self.uniform(kind.edge_m)
        num_holes, num_discs = self.integer(kind.holes), self.integer(kind.decoys)
        radii = [radius] * num_holes
        radii += [self.uniform(kind.decoy_radius_m) for _ in range(num_discs)]
        places = self._scatter_discs(half[:2], radii, edge)
        holes = []
        for place in places[:num_holes]:
            depth = self.uniform(kind.depth_m)
            holes.append(DrilledHole(np.array([*place, half[2]]), radius, depth, FRONT))
        for _ in range(self.integer(kind.side_holes)):
            holes.append(self._draw_side_hole(half, radius, edge))
        discs = []
        for place, size in zip(places[num_holes:], radii[num_holes:], strict=False):
            discs.append(DrilledHole(np.array([*place, half[2]]), size, 0.0, FRONT))
        chips = []
        for hole in holes[:num_holes]:
            chips += self._draw_bowls(hole, kind.chips, kind.chip_m, False)
        for hole in holes[:num_holes]:
            chips += self._draw_bowls(hole, kind.dents, kind.dent_m, True)
        rotation = build_frame(normal, turn_rad)
        first = np.array([*places[0], half[2]]) if places else np.array([0.0, 0.0, half[2]])
        pose = SolidPose(rotation, target - rotation @ first)
        materials = self.draw_materials(half, holes, discs)
        parts = (tuple(holes), tuple(chips), tuple(discs))
        return DrilledBlock("block", pose, half, materials, *parts)

    def _scatter_discs(
        self, half_m: np.ndarray, radii: list[float], edge_m: float
    ) -> list[np.ndarray]:
        """Return places on the face for discs of these radii; the first alone always finds room."""
        found: list[np.ndarray] = []
        for number, radius in enumerate(radii):
            room = np.maximum(half_m - radius - edge_m, 0.0)
            for _ in range(_TRIES):
                place = self.generator.uniform(-room, room)
                if all(
                    np.linalg.norm(place - other) > _SPACING * (radius + radii[k])
                    for k, other in enumerate(found)
                ):
                    found.append(place)
                    break
            if len(found) <= number:
                break
        return found

    def _draw_side_hole(self, half: np.ndarray, radius: float, edge: float) -> DrilledHole:
        """Return a hole in a face beside the drilled one; shallow, so that it meets no other."""
        part = int(self.generator.integers(4))
        axis = part // 2
        center = np.zeros(3)
        center[axis] = half[axis] if part % 2 else -half[axis]
        for other in {0, 1, 2} - {axis}:
            room = max(half[other] - radius - edge, 0.0)
            center[other] = self.generator.uniform(-room, room)
        return DrilledHole(center, radius, min(0.05, self._kind.depth_m[0]), part)

    def _draw_bowls(
        self, hole: DrilledHole, count: CountRange, radius_m: Range, is_dent: bool
    ) -> list[Chip]:
        """Return balls that cut bowls into the face: chips broken off a rim, or dents beside it."""
        generator, found = self.generator, []
        for _ in range(self.integer(count)):
            angle, wide = generator.uniform(-np.pi, np.pi), self.uniform(radius_m)
            away = hole.radius_m
            if is_dent:
                # Beyond the rim, up to a hole's diameter away: a chisel that misses lands near.
                away += wide + generator.uniform(0.0, 2.0 * hole.radius_m)
            height = wide * float(generator.uniform(0.2, 1.5))
            place = hole.center_m + np.array([away * np.cos(angle), away * np.sin(angle), height])
            found.append(Chip(place, float(np.hypot(wide, height))))
        return found

    def draw_materials(
        self, half: np.ndarray, holes: Sequence[DrilledHole], discs: Sequence[DrilledHole]
    ) -> tuple[Material, ...]:
        """Return the materials of all parts of the block; see `DrilledBlock`."""
        kind, generator = self._kind, self.generator
        bright, grain = self.uniform(kind.brightness), self.uniform(kind.grain)
        tint = 1.0 + 0.04 * generator.standard_normal(3)
        texture, marks = int(generator.integers(NUM_TEXTURES)), self._paint_marks(half)

        def stone(brightness: float, contrast: float, with_marks: bool = False) -> Material:
            color = tuple(np.clip(brightness * tint, 0.005, 0.95).tolist())
            shift = tuple(generator.uniform(0, TEXTURE_SIDE, 2).tolist())
            painted = (marks, MARK_M) if with_marks else None
            return Material(color, contrast, 0.0006, texture, shift, painted)

        face, drilled = stone(bright, grain, True), stone(0.8 * bright, grain)
        parts = [face] * 6
        for _ in holes:
            parts += [drilled, stone(self.uniform(kind.fill_brightness), grain)]
        parts.append(stone(1.1 * bright, 1.5 * grain))
        parts += [stone(self.uniform(kind.decoy_brightness), grain) for _ in discs]
        return tuple(parts)

    def _paint_marks(self, half: np.ndarray) -> np.ndarray:
        """Return the relative brightness of stains, wet patches and cracks, `(h, w)` float32."""
        kind, generator = self._kind, self.generator
        size = (2.4 * half[[1, 0]] / MARK_M).astype(int)
        marks = np.ones(tuple(size), np.float32)
        for _ in range(self.integer(kind.stains)):
            coarse = generator.standard_normal((8, 8)).astype(np.float32)
            blotch = cv2.resize(coarse, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
            center, spread = generator.uniform(0, size[::-1]), generator.uniform(15, 120)
            x, y = np.arange(size[1], dtype=np.float32), np.arange(size[0], dtype=np.float32)
            far = np.sqrt((x[None] - center[0]) ** 2 + (y[:, None] - center[1]) ** 2) / spread
            soft = float(generator.uniform(0.02, 0.4))
            cover = np.clip((1.0 - far + 0.35 * blotch) / soft, 0.0, 1.0)
            marks *= 1.0 - cover * (1.0 - self.uniform(kind.stain_brightness))
        for _ in range(self.integer(kind.cracks)):
            steps = generator.standard_normal((12, 2)).cumsum(0) * 6
            steps = steps + generator.uniform(-1, 1, 2) * np.arange(12)[:, None] * 25
            line = (steps + generator.uniform(0, size[::-1])).astype(np.int32)
            dark = float(generator.uniform(0.3, 0.8))
            thick = int(generator.integers(1, 3))
            blank = np.zeros_like(marks)
            painted = cv2.polylines(blank, [line[:, None]], False, 1.0, thick, cv2.LINE_AA)
            marks *= 1.0 - (1.0 - dark) * np.minimum(painted, 1.0)
        return marks
