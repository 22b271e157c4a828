"""Ranges of random scenes, and random blocks: faces, holes, chips, painted discs, and stains."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Interval

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Index, Ordered, PositiveRange, Range, spec
from perception.render.drilled_block import FRONT, Chip, DrilledBlock, DrilledHole
from perception.render.ray_tracer import Light
from perception.render.solids import (
    NUM_TEXTURES,
    TEXTURE_SIDE,
    Material,
    Solid,
    SolidPose,
    build_frame,
    move_solid,
)
from perception.render.stereo_camera import CameraExposure

Transmission = Annotated[float, Interval(gt=0, le=1)]
CountRange = Annotated[tuple[Index, Index], Ordered()]
"""Fewest and most."""


@spec
class ViewpointRanges:
    """From where the block is seen.

    Attributes:
        distance_m: Camera to the first hole's rim (or the middle of the face).
        obliquity_rad: Between the face's normal and the line of sight.
        azimuth_rad: Direction in the picture towards which the face leans; 0 leans up, as a block
            on the ground does.
        margin: Part of the picture along its border where the first hole never is.
    """

    distance_m: Range
    obliquity_rad: Range
    azimuth_rad: Range
    margin: float


@spec
class BlockRanges:
    """The block, its holes and its marks.

    Attributes:
        present: Probability that there is a block.
        length_m: Its longer side on the drilled face.
        width_m: Its shorter side.
        thickness_m: Along the holes.
        brightness: Reflected part of the light.
        grain: Contrast of its texture.
        holes: Number of holes in the drilled face, the first of them where the camera looks.
        side_holes: Number of holes in other faces.
        radius_m: Of the holes.
        depth_m: Of the holes, down to the surface of a filling.
        fill_brightness: Of the floor.
        edge_m: Concrete left between a hole and the edge of the face.
        chips: Pieces broken off each rim.
        chip_m: Radius of each, along the face.
        dents: Bowls struck into the face beside each rim.
        dent_m: Radius of each, along the face.
        decoys: Flat dark discs on the face.
        decoy_radius_m: Of the discs.
        decoy_brightness: Of the discs.
        stains: Stains and wet patches.
        stain_brightness: Of a stain, relative to the dry face.
        cracks: Cracks and traces of formwork.
    """

    present: float
    length_m: Range
    width_m: Range
    thickness_m: Range
    brightness: Range
    grain: Range
    holes: CountRange
    side_holes: CountRange
    radius_m: Range
    depth_m: Range
    fill_brightness: Range
    edge_m: Range
    chips: CountRange
    chip_m: Range
    dents: CountRange
    dent_m: Range
    decoys: CountRange
    decoy_radius_m: Range
    decoy_brightness: Range
    stains: CountRange
    stain_brightness: Range
    cracks: CountRange

    def check(self) -> None:
        need = 2 * (max(self.radius_m[1], self.decoy_radius_m[1]) + self.edge_m[0])
        if need > min(self.width_m[0], self.length_m[0]):
            raise ConfigError(
                f"width_m: a face of {self.width_m[0]} m has no room for a hole that needs "
                f"{need:g} m"
            )
        if self.depth_m[1] >= self.thickness_m[0]:
            raise ConfigError(
                f"depth_m: holes of {self.depth_m[1]} m go through a block of "
                f"{self.thickness_m[0]} m"
            )


@spec
class SurroundingsRanges:
    """Arm, clutter, ground and backdrop.

    Attributes:
        arm: Probability that the machine's arm is in the picture.
        hidden: Part of the first rim that the arm hides.
        clutter: Other things on the ground.
        backdrop_m: Distance of the wall behind everything.
        ground_brightness: Of the ground.
    """

    arm: float
    hidden: Range
    clutter: CountRange
    backdrop_m: Range
    ground_brightness: Range

    def check(self) -> None:
        if self.hidden[1] > 0 and self.arm < 1 and self.hidden[0] > 0:
            raise ConfigError(f"hidden: {self.hidden} needs an arm always (arm: 1), got {self.arm}")


@spec
class LightRanges:
    """Light and camera of a scene.

    Attributes:
        sun: Strength of the sun or a lamp.
        ambient: Strength of the light from everywhere.
        elevation_rad: Of the sun above the ground.
        shadows: Things out of sight that throw a shadow on the block.
        level: Light there is, relative to the level that the exposure is set for; drawn evenly on a
            logarithmic scale.
        exposure: Brightness of the block's lit face in the picture at level 1, 1 saturates.
        transmission: Light that the air lets through on the way to the block; 1 is clear.
        patchiness: Standard deviation of the dust's density.
        airlight: Brightness of the dust, relative to a lit white surface.
        blur_px: Point spread.
        full_well_e: Electrons at saturation.
        read_noise_e: Electrons in the dark.
        gamma: Exponent of the camera's response.
        vignetting: Light missing in the corners.
    """

    sun: Range
    ambient: Range
    elevation_rad: Range
    shadows: CountRange
    level: PositiveRange
    exposure: Range
    transmission: Annotated[tuple[Transmission, Transmission], Ordered()]
    patchiness: Range
    airlight: Range
    blur_px: Range
    full_well_e: PositiveRange
    read_noise_e: Range
    gamma: PositiveRange
    vignetting: Range


@dataclass(frozen=True)
class Scene:
    """One scene in the left camera's coordinates.

    Attributes:
        solids: All that can be seen; the block, if there is one, among them.
        block: The block, `None` without.
        light: How it is lit.
        exposure: How the pictures are taken.
        sky: Radiance where nothing is.
        conditions: Drawn values by name, for statistics.
    """

    solids: tuple[Solid, ...]
    block: DrilledBlock | None
    light: Light
    exposure: CameraExposure
    sky: tuple[float, float, float]
    conditions: dict[str, float]


def view_from(scene: Scene, camera_from_reference: np.ndarray) -> Scene:
    """Return the scene in the coordinates of another left camera; light and exposure stay.

    `conditions` stay those of the first camera.

    Args:
        scene: The scene.
        camera_from_reference: Motion from the coordinates of `scene` to the new ones, `(4, 4)`.
    """
    turn = camera_from_reference[:3, :3]
    move = functools.partial(move_solid, turn=turn, shift_m=camera_from_reference[:3, 3])
    block = None if scene.block is None else move(scene.block)
    solids = tuple(block if solid is scene.block else move(solid) for solid in scene.solids)
    shade = tuple(move(solid) for solid in scene.light.shade)
    light = replace(scene.light, to_sun=turn @ scene.light.to_sun, shade=shade)
    return replace(scene, solids=solids, block=block, light=light)


@spec
class SceneRanges:
    """A kind of scene; `perception.render.scene_sampler.SceneSampler` draws one.

    Attributes:
        name: In truth files and tables.
        sight: From where the block is seen.
        block: The block and its holes.
        around: Arm, clutter, ground and backdrop.
        light: Light, air and camera.
    """

    name: str
    sight: ViewpointRanges
    block: BlockRanges
    around: SurroundingsRanges
    light: LightRanges


class RangeSampler:
    """Draw numbers from ranges.

    Attributes:
        generator: The only source of chance.
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self.generator = generator

    def uniform(self, value: Range) -> float:
        """Draw evenly from a range."""
        return float(self.generator.uniform(*value))

    def integer(self, value: CountRange) -> int:
        """Draw a whole number, both ends included."""
        return int(self.generator.integers(value[0], value[1] + 1))


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
