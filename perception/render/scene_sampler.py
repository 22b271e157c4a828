"""Random scenes: block, arm, surroundings, light and exposure, drawn from ranges."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from perception.render.drilled_block import DrilledBlock, DrilledHole
from perception.render.ray_tracer import Light
from perception.render.scene_ranges import BlockSampler, RangeSampler, Scene, SceneRanges
from perception.render.solids import (
    NUM_TEXTURES,
    TEXTURE_SIDE,
    Box,
    Cylinder,
    Material,
    PlaneSolid,
    Solid,
    SolidPose,
    build_frame,
    move_solid,
)
from perception.render.stereo_camera import CameraExposure, StereoRig

_CLEAR = 1.6
"""Where the arm hides nothing it stays away from the rim's centre by this factor of the rim's size
at least."""
_BISECTIONS = 14
NUM_RIM_POINTS = 360
_CLUTTER_TRIES = 30
_GREY = 1 / 3
DRAWN = ("patchiness", "blur_px", "full_well_e", "read_noise_e", "gamma", "vignetting")
"""Settings of an exposure that are drawn as they stand in `LightRanges`, in this order."""


class SceneSampler(RangeSampler):
    """Draw scenes of a kind for a camera pair.

    Args:
        kind: Ranges of all that is drawn.
        rig: The camera pair.
        generator: The only source of chance.
    """

    def __init__(self, kind: SceneRanges, rig: StereoRig, generator: np.random.Generator) -> None:
        super().__init__(generator)
        self._kind, self._rig, self._down = kind, rig, rig.down_in_camera

    def compose(self) -> Scene:
        """Return a random scene: first the block, then the arm, then all the rest."""
        kind = self._kind
        target, normal, turn_rad = self._draw_target()
        block, arm = None, []
        if self.generator.random() < kind.block.present:
            block = BlockSampler(kind.block, self.generator).draw(target, normal, turn_rad)
        hidden = self.uniform(kind.around.hidden)
        if self.generator.random() < kind.around.arm:
            rim = target + 0.05 * build_frame(normal, turn_rad)[:, :2].T
            if block and block.holes:
                rim = sample_rim(block, block.holes[0])
            arm = self._place_arm(rim, hidden)
        return self.surround(block, arm, target, normal)

    def surround(
        self,
        block: DrilledBlock | None,
        arm: Sequence[Solid],
        target: np.ndarray,
        normal: np.ndarray,
        ground_m: float | None = None,
    ) -> Scene:
        """Return a scene of this kind around a block and an arm that stand already.

        Args:
            block: The block, `None` for none.
            arm: Parts of the arm.
            target: Point that the camera is aimed at, `(3,)`, camera coordinates.
            normal: Normal of the face there, `(3,)`.
            ground_m: How far below the camera the ground lies; `None` for where the block stands on it.
        """
        if ground_m is None:
            # The block stands on the ground; without one the ground lies a little below the aim.
            ground_m = float(target @ self._down) + 0.2
            if block:
                ground_m = max(0.5, float((block.corners_m @ self._down).max()))
        solids: list[Solid] = [*self._draw_ground_and_backdrop(ground_m)]
        if block:
            solids.append(block)
        solids += arm
        solids += self._draw_clutter(block, ground_m)
        light = self._draw_light(target)
        exposure, level = self._draw_exposure(light, normal, target)
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

    def _draw_target(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the aimed point and the face's normal, `(3,)` each, and the turn about it."""
        sight, rig, generator = self._kind.sight, self._rig, self.generator
        # Not at the border of the picture, where half a block would be out of sight.
        inner = 1.0 - 2.0 * sight.margin
        size = np.array([rig.width, rig.height])
        pixel = (0.5 + inner * (generator.random(2) - 0.5)) * (size - 1)
        ray = rig.left.rays(pixel[None])[0].astype(np.float64)
        ray /= np.linalg.norm(ray)
        # Up in the picture is the negative y axis of the camera.
        up = -np.array([0.0, 1.0, 0.0])
        up -= ray * (up @ ray)
        up /= np.linalg.norm(up)
        side = np.cross(ray, up)
        azimuth = self.uniform(sight.azimuth_rad)
        # The normal leans from the line of sight by the obliquity.
        obliquity = self.uniform(sight.obliquity_rad)
        lean = math.cos(azimuth) * up + math.sin(azimuth) * side
        normal = -math.cos(obliquity) * ray + math.sin(obliquity) * lean
        target = ray * self.uniform(sight.distance_m)
        return target, normal, float(generator.uniform(-np.pi, np.pi))

    def _place_arm(self, rim: np.ndarray, hidden: float) -> list[Solid]:
        """Return an arm from a random side that hides the part `hidden` of a rim, `(P, 3)`."""
        generator, middle = self.generator, rim.mean(0)
        ray = middle / np.linalg.norm(middle)
        # The arm comes in from a random side.
        angle = generator.uniform(-np.pi, np.pi)
        sideways = build_frame(ray, float(angle))[:, 0]
        # Between the camera and the rim, nearer to the rim: an arm at the lens would hide everything.
        # Chosen by hand; not searched.
        nearness = float(generator.uniform(0.45, 0.8))
        parts = self._build_arm(nearness * middle, ray, sideways)

        def push(way: float) -> list[Solid]:
            return [move_solid(part, np.eye(3), -way * sideways) for part in parts]

        # The size of the rim as it looks at the arm's distance.
        size = float(np.linalg.norm(rim - middle, axis=1).max()) * nearness
        if hidden <= 0:
            # Beyond the rim by a margin, and up to three sizes more.
            return push(-_CLEAR * size - generator.uniform(0.0, 3.0) * size)
        low, high = -2.0 * size, 2.0 * size
        # The hidden part grows with the push, so bisection finds it.
        for _ in range(_BISECTIONS):
            between = (low + high) / 2
            is_far_enough = _measure_covered_share(push(between), rim, 1.0) >= hidden
            low, high = (low, between) if is_far_enough else (between, high)
        return push(high)

    def _build_arm(self, start: np.ndarray, ray: np.ndarray, sideways: np.ndarray) -> list[Solid]:
        """Return the arm on the side `sideways`, its edge on the line of sight through `start`."""
        generator, along = self.generator, np.cross(ray, sideways)
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
            flat = np.stack([sideways, along, np.cross(sideways, along)], 1)
            half = np.array([wide, length, thick])
            boom: Solid = Box("arm", SolidPose(flat, place.center_m), half, (paint,))
        else:
            boom = Cylinder("arm", place, wide, length, (paint,))
        beside = SolidPose(turn, start + 2.3 * wide * sideways + 0.08 * ray)
        hose = Cylinder("arm", beside, 0.025, length, (steel,))
        # The chisel leans towards the camera, as a tool over the block does.
        leaning = build_frame(0.8 * ray + 0.6 * along, 0.0)
        chisel_pose = SolidPose(leaning, start + 3.2 * wide * sideways + 0.1 * along)
        chisel = Cylinder("arm", chisel_pose, 0.04, 0.25, (steel,))
        return [boom, hose, chisel]

    def _draw_material(
        self, brightness: float, contrast: float, texel_m: float, tint: float = 0.06
    ) -> Material:
        """Return a material of about this brightness, of a random pattern and a slight tint."""
        generator = self.generator
        color = brightness * (1.0 + tint * generator.standard_normal(3))
        pattern = int(generator.integers(NUM_TEXTURES))
        shift = generator.uniform(0, TEXTURE_SIDE, 2)
        color = tuple(np.clip(color, 0.01, 0.95).tolist())
        return Material(color, contrast, texel_m, pattern, tuple(shift.tolist()))

    def _draw_ground_and_backdrop(self, lowest_m: float) -> tuple[PlaneSolid, PlaneSolid]:
        """Return ground and backdrop."""
        around, generator, down = self._kind.around, self.generator, self._down
        bright = self.uniform(around.ground_brightness)
        soil = self._draw_material(bright, generator.uniform(0.15, 0.4), 0.002, 0.12)
        bright = generator.uniform(0.2, 0.6)
        wall = self._draw_material(bright, generator.uniform(0.1, 0.3), 0.006, 0.1)
        ground = PlaneSolid("ground", SolidPose(build_frame(-down, 0.0), down * lowest_m), (soil,))
        level = np.array([0.0, 0.0, 1.0]) - down * down[2]
        level /= np.linalg.norm(level)
        behind = level * self.uniform(around.backdrop_m)
        backdrop = PlaneSolid("ground", SolidPose(build_frame(-level, 0.0), behind), (wall,))
        return ground, backdrop

    def _draw_clutter(self, block: DrilledBlock | None, lowest_m: float) -> list[Solid]:
        """Return things on the ground, neither in front of a rim nor inside the block."""
        rig, generator, down = self._rig, self.generator, self._down
        wanted, found = self.integer(self._kind.around.clutter), []
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
            stuff = self._draw_material(bright, generator.uniform(0.05, 0.3), 0.001, 0.25)
            thing = Box("clutter", SolidPose(tilt, place), half, (stuff,))
            if block:
                away_m = np.linalg.norm(place - block.pose.center_m)
                if away_m < np.linalg.norm(half) + np.linalg.norm(block.half_m):
                    continue
            # Clutter must not change the labels of the holes.
            if block and any(
                compute_hidden_share([thing], block, hole) > 0 for hole in block.holes
            ):
                continue
            found.append(thing)
        return found

    def _draw_light(self, target: np.ndarray) -> Light:
        """Return sun and sky, and unseen things that throw shadows on the face."""
        ranges, generator = self._kind.light, self.generator
        elevation = self.uniform(ranges.elevation_rad)
        azimuth = generator.uniform(-np.pi, np.pi)
        frame = build_frame(-self._down, 0.0)
        level = math.cos(elevation)
        toward = [level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)]
        to_sun = frame @ toward
        shade = []
        for _ in range(self.integer(ranges.shadows)):
            # About 3 m towards the sun, out of sight of the camera.
            toward = to_sun + 0.3 * generator.standard_normal(3)
            beam = build_frame(toward, float(generator.uniform(-np.pi, np.pi)))
            beside = beam[:, :2] @ generator.uniform(-0.25, 0.25, 2)
            half = np.array([generator.uniform(0.03, 0.25), 1.5, 0.02])
            dark = self._draw_material(0.3, 0.1, 0.01)
            pose = SolidPose(beam, target + beside + 3.0 * to_sun)
            shade.append(Box("clutter", pose, half, (dark,)))
        sun, ambient = self.uniform(ranges.sun), self.uniform(ranges.ambient)
        return Light(to_sun, sun, ambient, tuple(shade))

    def _draw_exposure(
        self, light: Light, normal: np.ndarray, target: np.ndarray
    ) -> tuple[CameraExposure, float]:
        """Return the exposure, set for the lit face without dust, and the level of light."""
        ranges = self._kind.light
        # The exposure is set for the face, as a camera's own control would.
        lit = light.ambient + light.sun * max(0.0, float(normal @ light.to_sun))
        face = lit * float(np.mean(self._kind.block.brightness))
        # Each factor is as likely as any other.
        level = math.exp(self.uniform((math.log(ranges.level[0]), math.log(ranges.level[1]))))
        # Lambert and Beer: transmission over the distance of the target.
        extinction = -math.log(self.uniform(ranges.transmission)) / float(target[2])
        exposure = CameraExposure(
            gain=self.uniform(ranges.exposure) / face * level,
            extinction_per_m=extinction,
            airlight=self.uniform(ranges.airlight) * (light.ambient + light.sun * _GREY),
            **{name: self.uniform(getattr(ranges, name)) for name in DRAWN},
        )
        return exposure, level


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
    if (outward @ rim.mean(0)) >= 0:
        return 1.0
    # Slightly less than 1, so that the face itself does not hide its rim.
    return _measure_covered_share([solid for solid in solids if solid is not block], rim, 0.999)


def _measure_covered_share(solids: Sequence[Solid], rim: np.ndarray, way: float) -> float:
    """Return the part of points `(P, 3)` before which a solid lies, up to `way` of the line of sight."""
    shut = np.zeros(len(rim), bool)
    for solid in solids:
        shut |= solid.hit(np.zeros(3), rim.astype(np.float32)).t < way
    return float(shut.mean())
