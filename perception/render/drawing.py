"""One scene out of the ranges of `perception.render.scenes`: where everything stands, and how it is lit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from perception.render.arm import arm_over
from perception.render.concrete import bars_in, block_at, frame_of
from perception.render.drilled import Block, Disc, Hole
from perception.render.rig import Rig
from perception.render.scenes import Scene, Scenes, integer, logarithmic, uniform
from perception.render.sensor import Exposure
from perception.render.solids import Box, Plane, Pose, Solid
from perception.render.texture import NUM_TEXTURES, SIDE, Material
from perception.render.tracer import Light

NUM_RIM_POINTS = 360
_CLUTTER_TRIES = 30
_GREY = 1 / 3


def compose(kind: Scenes, rig: Rig, generator: np.random.Generator) -> Scene:
    """Returns a scene: first the block before the camera, then the arm, then all the rest; the generator is the only chance."""
    target, normal, turn = _target(kind, rig, generator)
    block, arm = None, []
    if generator.random() < kind.block.present:
        block = block_at(kind.block, target, normal, turn, generator)
    hidden = uniform(kind.around.hidden, generator)
    if generator.random() < kind.around.arm:
        rim = (
            rim_points(block, block.holes[0])
            if block and block.holes
            else target + 0.05 * frame_of(normal, turn)[:, :2].T
        )
        arm = arm_over(rim, rig, hidden, generator)
    return surround(kind, rig, block, arm, target, normal, generator)


def surround(
    kind: Scenes,
    rig: Rig,
    block: Block | None,
    arm: Sequence[Solid],
    target: np.ndarray,
    normal: np.ndarray,
    generator: np.random.Generator,
    ground_m: float | None = None,
) -> Scene:
    """Returns a scene of this kind around a block and an arm that stand already.

    Args:
        kind: Says what else there is, and how it is lit.
        rig: The camera pair.
        block: The block, `None` for none.
        arm: Parts of the arm.
        target: What the camera is pointed at, `(3,)`, camera coordinates.
        normal: Normal of the face there, `(3,)`.
        generator: The only source of chance.
        ground_m: How far below the camera the ground lies; `None` for where the block stands on it.
    """
    down = rig.down_in_camera
    if ground_m is None:
        ground_m = (
            max(0.5, float((block.corners_m @ down).max())) if block else float(target @ down) + 0.2
        )
    solids: list[Solid] = [*_setting(kind, down, ground_m, generator)]
    if block:
        solids += [block, *bars_in(kind.block, block, generator)]
    solids += arm
    solids += _clutter(kind, rig, block, down, ground_m, generator)
    light = _light(kind, down, target, generator)
    exposure, level = _exposure(kind, light, normal, target, generator)
    sky = (0.8 * light.ambient, 0.8 * light.ambient, 0.8 * light.ambient)
    hidden_parts = tuple(hidden_part(solids, block, hole) for hole in block.holes) if block else ()
    hidden_discs = tuple(hidden_part(solids, block, disc) for disc in block.discs) if block else ()
    sight = target / np.linalg.norm(target)
    conditions = {
        "distance_m": float(np.linalg.norm(target)),
        "obliquity_rad": float(np.arccos(np.clip(-normal @ sight, -1, 1))),
        "hidden": hidden_parts[0] if hidden_parts else 0.0,
        "light": level,
        "transmission": math.exp(-exposure.extinction_per_m * float(target[2])),
        "arm": float(bool(arm)),
        "decoys": float(len(block.discs)) if block else 0.0,
    }
    return Scene(tuple(solids), block, light, exposure, sky, hidden_parts, hidden_discs, conditions)


def rim_points(block: Block, circle: Hole | Disc) -> np.ndarray:
    """Returns points on the rim of a hole or disc of the block in camera coordinates, `(NUM_RIM_POINTS, 3)`."""
    axis = circle.axis if isinstance(circle, Hole) else 2
    angle = np.linspace(0, 2 * np.pi, NUM_RIM_POINTS, endpoint=False)
    local = np.repeat(circle.center_m[None], NUM_RIM_POINTS, 0)
    local[:, (axis + 1) % 3] += circle.radius_m * np.cos(angle)
    local[:, (axis + 2) % 3] += circle.radius_m * np.sin(angle)
    return block.pose.point(local)


def hidden_part(solids: Sequence[Solid], block: Block, circle: Hole | Disc) -> float:
    """Returns the part of the rim of a hole or disc that other solids, or the block itself, hide from the left camera."""
    rim = rim_points(block, circle)
    outward = block.pose.rotation @ (
        circle.outward if isinstance(circle, Hole) else np.array([0.0, 0.0, 1.0])
    )
    if (outward @ rim.mean(0)) >= 0:  # on a face that looks away
        return 1.0
    shut = np.zeros(len(rim), bool)
    for solid in solids:
        if solid is not block:
            shut |= solid.hit(np.zeros(3), rim.astype(np.float32)).t < 0.999
    return float(shut.mean())


def _target(
    kind: Scenes, rig: Rig, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns the point on the face that is looked at, the face's normal (both `(3,)`), and the turn of the block about it."""
    inner = 1.0 - 2.0 * kind.sight.margin
    size = np.array([rig.width, rig.height])
    pixel = (0.5 + inner * (generator.random(2) - 0.5)) * (size - 1)
    ray = rig.left.rays(pixel[None])[0].astype(np.float64)
    ray /= np.linalg.norm(ray)
    up = -np.array([0.0, 1.0, 0.0])
    up -= ray * (up @ ray)
    up /= np.linalg.norm(up)
    side = np.cross(ray, up)
    azimuth, obliquity = (
        uniform(kind.sight.azimuth_rad, generator),
        uniform(kind.sight.obliquity_rad, generator),
    )
    lean = math.cos(azimuth) * up + math.sin(azimuth) * side
    normal = -math.cos(obliquity) * ray + math.sin(obliquity) * lean
    return (
        ray * uniform(kind.sight.distance_m, generator),
        normal,
        float(generator.uniform(-np.pi, np.pi)),
    )


def matt(
    brightness: float,
    contrast: float,
    texel_m: float,
    generator: np.random.Generator,
    tint: float = 0.06,
    texture: int | None = None,
) -> Material:
    """Returns a material of about this brightness, of a random pattern and a slight tint."""
    color = brightness * (1.0 + tint * generator.standard_normal(3))
    pattern = int(generator.integers(NUM_TEXTURES)) if texture is None else texture
    shift = tuple(generator.uniform(0, SIDE, 2))
    red, green, blue = np.clip(color, 0.01, 0.95)
    return Material(
        (float(red), float(green), float(blue)),
        contrast,
        texel_m,
        pattern,
        (float(shift[0]), float(shift[1])),
    )


def _setting(
    kind: Scenes, down: np.ndarray, lowest_m: float, generator: np.random.Generator
) -> tuple[Plane, Plane]:
    """Returns ground and backdrop."""
    soil = matt(
        uniform(kind.around.ground_brightness, generator),
        generator.uniform(0.15, 0.4),
        0.002,
        generator,
        0.12,
    )
    wall = matt(generator.uniform(0.2, 0.6), generator.uniform(0.1, 0.3), 0.006, generator, 0.1)
    ground = Plane("ground", Pose(frame_of(-down, 0.0), down * lowest_m), (soil,))
    level = np.array([0.0, 0.0, 1.0]) - down * down[2]
    level /= np.linalg.norm(level)
    backdrop = Plane(
        "ground",
        Pose(frame_of(-level, 0.0), level * uniform(kind.around.backdrop_m, generator)),
        (wall,),
    )
    return ground, backdrop


def _clutter(
    kind: Scenes,
    rig: Rig,
    block: Block | None,
    down: np.ndarray,
    lowest_m: float,
    generator: np.random.Generator,
) -> list[Solid]:
    """Returns things on the ground, in the picture, not in front of a rim and not inside the block."""
    wanted, found = integer(kind.around.clutter, generator), []
    for _ in range(_CLUTTER_TRIES):
        if len(found) == wanted:
            break
        pixel = generator.random((1, 2)) * [rig.width, rig.height]
        ray = rig.left.rays(pixel)[0].astype(np.float64)
        way = lowest_m / (ray @ down) if ray @ down > 0.05 else generator.uniform(2.0, 8.0)
        half = generator.uniform(0.03, 0.25, 3) * [1.0, 1.0, 0.7]
        place = ray * way * generator.uniform(0.9, 1.0) - down * half[2]
        if not 0.8 < place[2] < 12.0:
            continue
        tilt = frame_of(
            -down + 0.15 * generator.standard_normal(3), float(generator.uniform(-np.pi, np.pi))
        )
        stuff = matt(
            generator.uniform(0.05, 0.6), generator.uniform(0.05, 0.3), 0.001, generator, 0.25
        )
        thing = Box("clutter", Pose(tilt, place), half, (stuff,))
        reach = float(np.linalg.norm(half))
        if block and np.linalg.norm(place - block.pose.center_m) < reach + np.linalg.norm(
            block.half_m
        ):
            continue
        if block and any(hidden_part([thing], block, hole) > 0 for hole in block.holes):
            continue
        found.append(thing)
    return found


def _light(
    kind: Scenes, down: np.ndarray, target: np.ndarray, generator: np.random.Generator
) -> Light:
    """Returns sun and sky, and things out of sight that throw shadows on the face."""
    elevation, azimuth = (
        uniform(kind.light.elevation_rad, generator),
        generator.uniform(-np.pi, np.pi),
    )
    frame = frame_of(-down, 0.0)
    to_sun = frame @ [
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    shade = []
    for _ in range(integer(kind.light.shadows, generator)):
        beam = frame_of(
            to_sun + 0.3 * generator.standard_normal(3), float(generator.uniform(-np.pi, np.pi))
        )
        beside = beam[:, :2] @ generator.uniform(-0.25, 0.25, 2)
        half = np.array([generator.uniform(0.03, 0.25), 1.5, 0.02])
        dark = matt(0.3, 0.1, 0.01, generator)
        shade.append(Box("clutter", Pose(beam, target + beside + 3.0 * to_sun), half, (dark,)))
    return Light(
        to_sun,
        uniform(kind.light.sun, generator),
        uniform(kind.light.ambient, generator),
        tuple(shade),
    )


def _exposure(
    kind: Scenes,
    light: Light,
    normal: np.ndarray,
    target: np.ndarray,
    generator: np.random.Generator,
) -> tuple[Exposure, float]:
    """Returns how the pictures are taken, and the level of light; the exposure is set for the face as it is lit without dust."""
    ranges = kind.light
    lit = light.ambient + light.sun * max(0.0, float(normal @ light.to_sun))
    face = lit * float(np.mean(kind.block.brightness))
    level = logarithmic(ranges.level, generator)
    extinction = -math.log(uniform(ranges.transmission, generator)) / float(target[2])
    exposure = Exposure(
        gain=uniform(ranges.exposure, generator) / face * level,
        extinction_per_m=extinction,
        airlight=uniform(ranges.airlight, generator) * (light.ambient + light.sun * _GREY),
        patchiness=uniform(ranges.patchiness, generator),
        blur_px=uniform(ranges.blur_px, generator),
        full_well_e=uniform(ranges.full_well_e, generator),
        read_noise_e=uniform(ranges.read_noise_e, generator),
        gamma=uniform(ranges.gamma, generator),
        vignetting=uniform(ranges.vignetting, generator),
    )
    return exposure, level
