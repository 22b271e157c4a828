"""Random scenes: block, arm, surroundings, light and exposure, drawn from ranges."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from perception.render.block_sampler import draw_block
from perception.render.camera_sensor import CameraExposure
from perception.render.drilled_block import DrilledBlock, DrilledHole
from perception.render.materials import NUM_TEXTURES, TEXTURE_SIDE, Material
from perception.render.ray_tracer import Light
from perception.render.scene_ranges import (
    Scene,
    SceneRanges,
    draw_integer,
    draw_log_uniform,
    draw_uniform,
)
from perception.render.solids import (
    Box,
    Cylinder,
    PlaneSolid,
    Solid,
    SolidPose,
    build_frame,
    move_solid,
)
from perception.render.stereo_camera import StereoRig

_CLEAR = 1.6
"""Where the arm hides nothing it stays away from the rim's centre by this factor of the rim's size
at least."""
_BISECTIONS = 14


def place_arm(
    rim: np.ndarray, rig: StereoRig, hidden: float, generator: np.random.Generator
) -> list[Solid]:
    """Return an arm from a random side that hides the part `hidden` of a rim, `(P, 3)`."""
    middle = rim.mean(0)
    ray = middle / np.linalg.norm(middle)
    # The arm comes in from a random side.
    angle = generator.uniform(-np.pi, np.pi)
    sideways = build_frame(ray, float(angle))[:, 0]
    # Between the camera and the rim, nearer to the rim: an arm at the lens would hide everything.
    # Chosen by hand; not searched.
    nearness = float(generator.uniform(0.45, 0.8))
    parts = _build_arm(nearness * middle, ray, sideways, generator)

    def covered(push: float) -> float:
        shut = np.zeros(len(rim), bool)
        for solid in _shift_solids(parts, -push * sideways):
            shut |= solid.hit(np.zeros(3), rim.astype(np.float32)).t < 1.0
        return float(shut.mean())

    # The size of the rim as it looks at the arm's distance.
    size = float(np.linalg.norm(rim - middle, axis=1).max()) * nearness
    if hidden <= 0:
        # Beyond the rim by a margin, and up to three sizes more.
        low = -_CLEAR * size
        return _shift_solids(parts, -(low - generator.uniform(0.0, 3.0) * size) * sideways)
    low, high = -2.0 * size, 2.0 * size
    # The hidden part grows with the push, so bisection finds it.
    for _ in range(_BISECTIONS):
        middle_push = (low + high) / 2
        low, high = (middle_push, high) if covered(middle_push) < hidden else (low, middle_push)
    return _shift_solids(parts, -high * sideways)


def _build_arm(
    start: np.ndarray, ray: np.ndarray, sideways: np.ndarray, generator: np.random.Generator
) -> list[Solid]:
    """Return the arm on the side `sideways`, its edge on the line of sight through `start`."""
    along = np.cross(ray, sideways)
    wide = float(generator.uniform(0.06, 0.16))
    thick = float(generator.uniform(0.05, 0.12))
    # The yellow of a demolition machine, faded and dirty to a varying degree. Chosen by hand; not
    # searched.
    faded = np.array([0.75, 0.45, 0.08]) * generator.uniform(0.3, 1.2)
    yellow = np.clip(faded + 0.05 * generator.standard_normal(3), 0.02, 0.9)
    paint = Material(tuple(yellow.tolist()), 0.08, 0.002, int(generator.integers(4)))
    grey = float(generator.uniform(0.03, 0.3))
    steel = Material((grey, grey, grey), 0.15, 0.001, int(generator.integers(4)))
    length = float(generator.uniform(0.6, 1.5))
    turn = np.stack([sideways, np.cross(along, sideways), along], 1)
    place = SolidPose(turn, start + wide * sideways)
    # Booms are boxes or tubes; both look alike to no network.
    if generator.random() < 0.5:
        flat = SolidPose(np.stack([sideways, along, np.cross(sideways, along)], 1), place.center_m)
        boom: Solid = Box("arm", flat, np.array([wide, length, thick]), (paint,))
    else:
        boom = Cylinder("arm", place, wide, length, (paint,))
    beside = SolidPose(turn, start + 2.3 * wide * sideways + 0.08 * ray)
    hose = Cylinder("arm", beside, 0.025, length, (steel,))
    # The chisel leans towards the camera, as a tool over the block does.
    leaning = build_frame(0.8 * ray + 0.6 * along, 0.0)
    chisel_pose = SolidPose(leaning, start + 3.2 * wide * sideways + 0.1 * along)
    chisel = Cylinder("arm", chisel_pose, 0.04, 0.25, (steel,))
    return [boom, hose, chisel]


def _shift_solids(parts: list[Solid], shift_m: np.ndarray) -> list[Solid]:
    """Return the arm elsewhere."""
    return [move_solid(part, np.eye(3), shift_m) for part in parts]


NUM_RIM_POINTS = 360
_CLUTTER_TRIES = 30
_GREY = 1 / 3


def compose_scene(kind: SceneRanges, rig: StereoRig, generator: np.random.Generator) -> Scene:
    """Return a random scene: first the block, then the arm, then all the rest."""
    target, normal, turn = _draw_target(kind, rig, generator)
    block, arm = None, []
    if generator.random() < kind.block.present:
        block = draw_block(kind.block, target, normal, turn, generator)
    hidden = draw_uniform(kind.around.hidden, generator)
    if generator.random() < kind.around.arm:
        rim = (
            sample_rim(block, block.holes[0])
            if block and block.holes
            else target + 0.05 * build_frame(normal, turn)[:, :2].T
        )
        arm = place_arm(rim, rig, hidden, generator)
    return add_surroundings(kind, rig, block, arm, target, normal, generator)


def add_surroundings(
    kind: SceneRanges,
    rig: StereoRig,
    block: DrilledBlock | None,
    arm: Sequence[Solid],
    target: np.ndarray,
    normal: np.ndarray,
    generator: np.random.Generator,
    ground_m: float | None = None,
) -> Scene:
    """Return a scene of this kind around a block and an arm that stand already.

    Args:
        kind: Ranges of surroundings and light.
        rig: The camera pair.
        block: The block, `None` for none.
        arm: Parts of the arm.
        target: Point that the camera is aimed at, `(3,)`, camera coordinates.
        normal: Normal of the face there, `(3,)`.
        generator: The only source of chance.
        ground_m: How far below the camera the ground lies; `None` for where the block stands on it.
    """
    down = rig.down_in_camera
    if ground_m is None:
        # The block stands on the ground; without one the ground lies a little below the aim.
        ground_m = (
            max(0.5, float((block.corners_m @ down).max())) if block else float(target @ down) + 0.2
        )
    solids: list[Solid] = [*_draw_ground_and_backdrop(kind, down, ground_m, generator)]
    if block:
        solids.append(block)
    solids += arm
    solids += _draw_clutter(kind, rig, block, down, ground_m, generator)
    light = _draw_light(kind, down, target, generator)
    exposure, level = _draw_exposure(kind, light, normal, target, generator)
    # The sky is a little darker than its light on a surface. Chosen by hand; not searched.
    sky = (0.8 * light.ambient, 0.8 * light.ambient, 0.8 * light.ambient)
    hidden = 0.0
    if block and block.holes:
        hidden = compute_hidden_share(solids, block, block.holes[0])
    sight = target / np.linalg.norm(target)
    conditions = {
        "distance_m": float(np.linalg.norm(target)),
        "obliquity_rad": float(np.arccos(np.clip(-normal @ sight, -1, 1))),
        "hidden": hidden,
        "light": level,
        "transmission": math.exp(-exposure.extinction_per_m * float(target[2])),
        "arm": float(bool(arm)),
        "decoys": float(len(block.discs)) if block else 0.0,
    }
    return Scene(tuple(solids), block, light, exposure, sky, conditions)


def sample_rim(block: DrilledBlock, circle: DrilledHole) -> np.ndarray:
    """Return points on the rim of a hole or disc, camera coordinates, `(NUM_RIM_POINTS, 3)`."""
    axis = circle.axis
    angle = np.linspace(0, 2 * np.pi, NUM_RIM_POINTS, endpoint=False)
    local = np.repeat(circle.center_m[None], NUM_RIM_POINTS, 0)
    local[:, (axis + 1) % 3] += circle.radius_m * np.cos(angle)
    local[:, (axis + 2) % 3] += circle.radius_m * np.sin(angle)
    return block.pose.point(local)


def compute_hidden_share(
    solids: Sequence[Solid], block: DrilledBlock, circle: DrilledHole
) -> float:
    """Return the part of a rim that other solids or the block hide from the left camera."""
    rim = sample_rim(block, circle)
    outward = block.pose.rotation @ circle.outward
    # A face that looks away hides its rim, whatever stands before it.
    if (outward @ rim.mean(0)) >= 0:  # on a face that looks away
        return 1.0
    shut = np.zeros(len(rim), bool)
    for solid in solids:
        if solid is not block:
            # Slightly less than 1, so that the face itself does not hide its rim.
            shut |= solid.hit(np.zeros(3), rim.astype(np.float32)).t < 0.999
    return float(shut.mean())


def _draw_target(
    kind: SceneRanges, rig: StereoRig, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the aimed point and the face's normal, `(3,)` each, and the turn about it."""
    # Not at the border of the picture, where half a block would be out of sight.
    inner = 1.0 - 2.0 * kind.sight.margin
    size = np.array([rig.width, rig.height])
    pixel = (0.5 + inner * (generator.random(2) - 0.5)) * (size - 1)
    ray = rig.left.rays(pixel[None])[0].astype(np.float64)
    ray /= np.linalg.norm(ray)
    # Up in the picture is the negative y axis of the camera.
    up = -np.array([0.0, 1.0, 0.0])
    up -= ray * (up @ ray)
    up /= np.linalg.norm(up)
    side = np.cross(ray, up)
    azimuth = draw_uniform(kind.sight.azimuth_rad, generator)
    # The normal leans from the line of sight by the obliquity.
    obliquity = draw_uniform(kind.sight.obliquity_rad, generator)
    lean = math.cos(azimuth) * up + math.sin(azimuth) * side
    normal = -math.cos(obliquity) * ray + math.sin(obliquity) * lean
    target = ray * draw_uniform(kind.sight.distance_m, generator)
    return target, normal, float(generator.uniform(-np.pi, np.pi))


def draw_material(
    brightness: float,
    contrast: float,
    texel_m: float,
    generator: np.random.Generator,
    tint: float = 0.06,
) -> Material:
    """Return a material of about this brightness, of a random pattern and a slight tint."""
    color = brightness * (1.0 + tint * generator.standard_normal(3))
    pattern = int(generator.integers(NUM_TEXTURES))
    shift = generator.uniform(0, TEXTURE_SIDE, 2)
    color = tuple(np.clip(color, 0.01, 0.95).tolist())
    return Material(color, contrast, texel_m, pattern, tuple(shift.tolist()))


def _draw_ground_and_backdrop(
    kind: SceneRanges, down: np.ndarray, lowest_m: float, generator: np.random.Generator
) -> tuple[PlaneSolid, PlaneSolid]:
    """Return ground and backdrop."""
    bright = draw_uniform(kind.around.ground_brightness, generator)
    soil = draw_material(bright, generator.uniform(0.15, 0.4), 0.002, generator, 0.12)
    bright = generator.uniform(0.2, 0.6)
    wall = draw_material(bright, generator.uniform(0.1, 0.3), 0.006, generator, 0.1)
    ground = PlaneSolid("ground", SolidPose(build_frame(-down, 0.0), down * lowest_m), (soil,))
    level = np.array([0.0, 0.0, 1.0]) - down * down[2]
    level /= np.linalg.norm(level)
    behind = level * draw_uniform(kind.around.backdrop_m, generator)
    backdrop = PlaneSolid("ground", SolidPose(build_frame(-level, 0.0), behind), (wall,))
    return ground, backdrop


def _draw_clutter(
    kind: SceneRanges,
    rig: StereoRig,
    block: DrilledBlock | None,
    down: np.ndarray,
    lowest_m: float,
    generator: np.random.Generator,
) -> list[Solid]:
    """Return things on the ground, neither in front of a rim nor inside the block."""
    wanted, found = draw_integer(kind.around.clutter, generator), []
    for _ in range(_CLUTTER_TRIES):
        if len(found) == wanted:
            break
        pixel = generator.random((1, 2)) * [rig.width, rig.height]
        ray = rig.left.rays(pixel)[0].astype(np.float64)
        # Rays above the horizon meet no ground: the thing hangs somewhere ahead.
        way = lowest_m / (ray @ down) if ray @ down > 0.05 else generator.uniform(2.0, 8.0)
        half = generator.uniform(0.03, 0.25, 3) * [1.0, 1.0, 0.7]
        # Just above the ground, so that it does not sink in.
        place = ray * way * generator.uniform(0.9, 1.0) - down * half[2]
        if not 0.8 < place[2] < 12.0:
            continue
        upwards = -down + 0.15 * generator.standard_normal(3)
        tilt = build_frame(upwards, float(generator.uniform(-np.pi, np.pi)))
        bright = generator.uniform(0.05, 0.6)
        stuff = draw_material(bright, generator.uniform(0.05, 0.3), 0.001, generator, 0.25)
        thing = Box("clutter", SolidPose(tilt, place), half, (stuff,))
        if block:
            away_m = np.linalg.norm(place - block.pose.center_m)
            if away_m < np.linalg.norm(half) + np.linalg.norm(block.half_m):
                continue
        # Clutter must not change the labels of the holes.
        if block and any(compute_hidden_share([thing], block, hole) > 0 for hole in block.holes):
            continue
        found.append(thing)
    return found


def _draw_light(
    kind: SceneRanges, down: np.ndarray, target: np.ndarray, generator: np.random.Generator
) -> Light:
    """Return sun and sky, and unseen things that throw shadows on the face."""
    elevation = draw_uniform(kind.light.elevation_rad, generator)
    azimuth = generator.uniform(-np.pi, np.pi)
    frame = build_frame(-down, 0.0)
    to_sun = frame @ [
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    shade = []
    for _ in range(draw_integer(kind.light.shadows, generator)):
        # About 3 m towards the sun, out of sight of the camera.
        toward = to_sun + 0.3 * generator.standard_normal(3)
        beam = build_frame(toward, float(generator.uniform(-np.pi, np.pi)))
        beside = beam[:, :2] @ generator.uniform(-0.25, 0.25, 2)
        half = np.array([generator.uniform(0.03, 0.25), 1.5, 0.02])
        dark = draw_material(0.3, 0.1, 0.01, generator)
        shade.append(Box("clutter", SolidPose(beam, target + beside + 3.0 * to_sun), half, (dark,)))
    sun = draw_uniform(kind.light.sun, generator)
    ambient = draw_uniform(kind.light.ambient, generator)
    return Light(to_sun, sun, ambient, tuple(shade))


def _draw_exposure(
    kind: SceneRanges,
    light: Light,
    normal: np.ndarray,
    target: np.ndarray,
    generator: np.random.Generator,
) -> tuple[CameraExposure, float]:
    """Return the exposure, set for the lit face without dust, and the level of light."""
    ranges = kind.light
    # The exposure is set for the face, as a camera's own control would.
    lit = light.ambient + light.sun * max(0.0, float(normal @ light.to_sun))
    face = lit * float(np.mean(kind.block.brightness))
    level = draw_log_uniform(ranges.level, generator)
    # Lambert and Beer: transmission over the distance of the target.
    extinction = -math.log(draw_uniform(ranges.transmission, generator)) / float(target[2])
    exposure = CameraExposure(
        gain=draw_uniform(ranges.exposure, generator) / face * level,
        extinction_per_m=extinction,
        airlight=draw_uniform(ranges.airlight, generator) * (light.ambient + light.sun * _GREY),
        patchiness=draw_uniform(ranges.patchiness, generator),
        blur_px=draw_uniform(ranges.blur_px, generator),
        full_well_e=draw_uniform(ranges.full_well_e, generator),
        read_noise_e=draw_uniform(ranges.read_noise_e, generator),
        gamma=draw_uniform(ranges.gamma, generator),
        vignetting=draw_uniform(ranges.vignetting, generator),
    )
    return exposure, level
