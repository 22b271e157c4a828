"""Ranges of random scenes: viewpoint, block, surroundings, light, air and camera."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Interval

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Index, Ordered, PositiveRange, Range, spec
from perception.render.camera_sensor import CameraExposure
from perception.render.drilled_block import DrilledBlock
from perception.render.ray_tracer import Light
from perception.render.solids import Solid, move_solid

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
            raise ConfigError(
                f"hidden: {self.hidden} needs an arm in every picture (arm: 1.0), got {self.arm}"
            )


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
