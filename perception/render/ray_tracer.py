"""Ray tracer: surface, depth and radiance at each pixel.

Every pixel has one exact ray through its centre, which gives depth and masks. Colour comes from
that ray where the pixel shows one surface, filtered to the pixel's size, and from `OVER` x `OVER`
rays where edges of solids, rims or shadows cross it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from perception.calibrate.transforms import span_plane
from perception.render.solids import Solid
from perception.segment.window import Window

OVER = 4
CHUNK = 1 << 17
"""Rays at a time, so that their data stay in the cache; chosen by hand."""
FAR_M = 80.0
NEAREST_M = 0.05
"""Nearer points are not in the picture of a camera."""
NOTHING = -1


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion, looking along z of the left camera's coordinates.

    Attributes:
        width: Pixels.
        height: Pixels.
        focal_px: Focal length.
        origin_m: Centre of projection.
        axis_px: Pixel of the optical axis; `None`: the picture's middle. A part of a picture has it
            elsewhere.
    """

    width: int
    height: int
    focal_px: float
    origin_m: np.ndarray
    axis_px: tuple[float, float] | None = field(default=None, kw_only=True)

    @property
    def matrix(self) -> np.ndarray:
        """Camera matrix, `(3, 3)`; pixel centres lie at integers."""
        x, y = self.axis_px or ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.array([[self.focal_px, 0, x], [0, self.focal_px, y], [0, 0, 1.0]])

    def crop(self, part: Window) -> Pinhole:
        """Return the camera that reads out a part of the picture alone."""
        x, y = part.crop_matrix(self.matrix)[:2, 2].tolist()
        return replace(self, width=part.width, height=part.height, axis_px=(x, y))

    def project(self, point_m: np.ndarray) -> np.ndarray:
        """Return the pixels, `(…, 2)`, of points, `(…, 3)`, in front of the camera."""
        away = point_m - self.origin_m
        center = self.matrix[:2, 2]
        return self.focal_px * away[..., :2] / away[..., 2:] + center

    def is_inside(self, points_m: np.ndarray, border_px: float) -> bool:
        """Return whether all points, `(N, 3)`, lie in the picture, so far from its border."""
        if points_m[:, 2].min() < NEAREST_M:
            return False
        pixel = self.project(points_m)
        last = np.array([self.width, self.height]) - 1 - border_px
        return bool((pixel >= border_px).all() and (pixel <= last).all())

    def rays(self, pixel: np.ndarray) -> np.ndarray:
        """Return directions with z = 1, `(M, 3)` float32, through pixels, `(M, 2)`."""
        flat = (pixel - self.matrix[:2, 2]) / self.focal_px
        # z = 1: the ray's parameter is then the depth along z.
        return np.concatenate([flat, np.ones((len(flat), 1))], 1).astype(np.float32)


@dataclass(frozen=True)
class Light:
    """Sunlight, or a lamp far away, and light from everywhere.

    Attributes:
        to_sun: Unit vector to it, `(3,)`, camera coordinates.
        sun: Its strength on a surface that faces it.
        ambient: Strength of the light from everywhere.
        shade: Solids that throw shadows though they are not seen.
    """

    to_sun: np.ndarray
    sun: float
    ambient: float
    shade: tuple[Solid, ...] = ()


@dataclass(frozen=True)
class RenderedView:
    """Surfaces that rays meet, without noise: rays of a picture, `(h, w)`, or any others, `(M,)`.

    Attributes:
        depth_m: Along z, float32; of a picture NaN where nothing is.
        solid: Number of the solid, int16, `NOTHING` for none.
        part: Part of the solid, int16.
        mouth: The ray goes through the rim of a hole, bool.
        radiance: Linear light, `(…, 3)` float32; of a picture over each pixel.
        sunlit: Sunlight falls there, bool.
    """

    depth_m: np.ndarray
    solid: np.ndarray
    part: np.ndarray
    mouth: np.ndarray
    radiance: np.ndarray
    sunlit: np.ndarray

    @property
    def label(self) -> np.ndarray:
        """A number for each surface, lit or not: where it changes, there is an edge."""
        # Powers of two keep the four parts of the label apart.
        label = self.solid.astype(np.int32) * 4096 + self.part * 4 + self.mouth * 2 + self.sunlit
        return label.astype(np.int32)


class Tracer:
    """Draw solids in a light, from any camera.

    Args:
        solids: All that can be seen; bars in a block come after it.
        light: How it is lit.
        sky: Radiance where nothing is, RGB.
    """

    def __init__(
        self, solids: Sequence[Solid], light: Light, sky: tuple[float, float, float]
    ) -> None:
        self.solids, self.light, self.sky = tuple(solids), light, np.array(sky, np.float32)
        self._casters = []
        for solid in (*solids, *light.shade):
            if solid.corners_m is not None:
                self._casters.append(Caster(solid, light.to_sun))

    def view(self, camera: Pinhole) -> RenderedView:
        """Return the ideal picture of `camera`."""
        size = (camera.height, camera.width)
        # Bands of rows, so that the rays of one band stay in the cache.
        rows = max(1, CHUNK // camera.width)
        columns = np.arange(camera.width, dtype=np.float64)
        bands = []
        for top in range(0, camera.height, rows):
            ys = np.arange(top, min(top + rows, camera.height), dtype=np.float64)
            pixel = np.stack(np.broadcast_arrays(columns[None], ys[:, None]), -1).reshape(-1, 2)
            bands.append(self._shoot(camera, pixel))
        joined = {}
        for one in fields(RenderedView):
            values = np.concatenate([getattr(band, one.name) for band in bands])
            joined[one.name] = values.reshape(*size, *values.shape[1:])
        whole = RenderedView(**joined)
        radiance = whole.radiance.reshape(-1, 3)
        # Only pixels at edges are oversampled: everywhere else one ray is enough.
        edges = np.flatnonzero(_find_edges(whole.label).ravel())
        # Centres of the sub-pixels, relative to the pixel's centre.
        corners = np.stack(np.meshgrid(*[np.arange(OVER)] * 2), -1).reshape(-1, 2)
        offsets = (corners + 0.5) / OVER - 0.5
        for part in np.array_split(edges, max(1, len(edges) * OVER**2 // CHUNK)):
            pixel = np.stack([part % camera.width, part // camera.width], 1)[:, None] + offsets
            fine = self._shoot(camera, pixel.reshape(-1, 2)).radiance
            radiance[part] = fine.reshape(len(part), OVER**2, 3).mean(1)
        # NaN, as a camera reports missing depth.
        whole.depth_m[whole.solid == NOTHING] = np.nan
        return whole

    def _cast(
        self, origin_m: np.ndarray, direction: np.ndarray, camera: Pinhole | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        count = len(direction)
        t, solid = np.full(count, FAR_M, np.float32), np.full(count, NOTHING, np.int16)
        part, mouth = np.zeros(count, np.int16), np.zeros(count, bool)
        for number, thing in enumerate(self.solids):
            rows = _select_rays(thing, camera, direction)
            hits = thing.hit(origin_m, direction if rows is None else direction[rows])
            # Only hits nearer than those so far; the order of the solids does not matter.
            nearer = np.flatnonzero(hits.t < (t if rows is None else t[rows]))
            if not len(nearer):
                continue
            to = nearer if rows is None else rows[nearer]
            t[to], solid[to], part[to] = hits.t[nearer], number, hits.part[nearer]
            if hits.mouth is not None:
                mouth[to] = hits.mouth[nearer]
            elif thing.role != "block":  # a bar inside a hole is still seen through its rim
                mouth[to] = False
        return t, solid, part, mouth

    def _shoot(self, camera: Pinhole, pixel: np.ndarray) -> RenderedView:
        direction = camera.rays(pixel)
        t, solid, part, mouth = self._cast(camera.origin_m, direction, camera)
        radiance = np.broadcast_to(self.sky, (len(t), 3)).copy()
        lit = np.zeros(len(t), bool)
        # Points in float32: a scene of 80 m is then exact to some micrometres.
        point = camera.origin_m.astype(np.float32) + t[:, None] * direction
        for number, thing in enumerate(self.solids):
            rows = np.flatnonzero(solid == number)
            if len(rows):
                radiance[rows], lit[rows] = self._shaded(
                    thing, point[rows], part[rows], direction[rows], t[rows] / camera.focal_px
                )
        return RenderedView(t, solid, part, mouth, radiance, lit)

    def _shaded(
        self,
        thing: Solid,
        point: np.ndarray,
        part: np.ndarray,
        direction: np.ndarray,
        pixel_m: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the radiance of points of one solid, `(M, 3)`, and which are sunlit, `(M,)`."""
        surface = thing.surface(point, part, self.light.to_sun)
        # Surfaces have two sides; the one towards the camera is seen.
        along = np.einsum("ij,ij->i", surface.normal, direction)
        away = np.sign(along)
        facing = np.abs(along) / np.sqrt(np.einsum("ij,ij->i", direction, direction))
        slope = surface.normal @ self.light.to_sun.astype(np.float32) * -away
        lit = slope > 0
        if surface.sunlit is not None:
            lit &= surface.sunlit
        for caster in self._casters:
            # A solid's own shadow is already in the slope of its surface.
            if lit.any() and caster.solid is not thing:
                caster.darken(point, lit)
        bright = self.light.ambient * (1.0 if surface.openness is None else surface.openness)
        bright = bright + self.light.sun * np.where(lit, slope, 0.0)
        albedo = np.empty((len(part), 3), np.float32)
        # Obliquely seen texture is filtered more, but not without bound.
        size_m = pixel_m / np.sqrt(np.maximum(facing, 0.1))
        for number in np.flatnonzero(np.bincount(part)):
            rows = np.flatnonzero(part == number)
            material = thing.materials[min(int(number), len(thing.materials) - 1)]
            albedo[rows] = material.albedo(surface.uv_m[rows], size_m[rows])
        return albedo * bright[:, None].astype(np.float32), lit


class Caster:
    """A solid that throws a shadow; only points within its silhouette from the sun are tested."""

    def __init__(self, solid: Solid, to_sun: np.ndarray) -> None:
        self.solid, self._to_sun = solid, to_sun.astype(np.float32)
        self._across = np.stack(span_plane(to_sun), 1).astype(np.float32)
        # The silhouette's box is a cheap test before the exact one.
        corners = solid.corners_m @ self._across  # type: ignore[operator]
        self._low, self._high = corners.min(0).astype(np.float32), corners.max(0).astype(np.float32)

    def darken(self, point: np.ndarray, lit: np.ndarray) -> None:
        """Clear `lit`, `(M,)` bool, at the points, `(M, 3)`, that the solid shades."""
        x, y = point @ self._across[:, 0], point @ self._across[:, 1]
        within = (x > self._low[0]) & (x < self._high[0]) & (y > self._low[1]) & (y < self._high[1])
        rows = np.flatnonzero(lit & within)
        if len(rows):
            sun = np.broadcast_to(self._to_sun, (len(rows), 3))
            lit[rows[np.isfinite(self.solid.hit(point[rows], sun).t)]] = False


def _select_rays(thing: Solid, camera: Pinhole | None, direction: np.ndarray) -> np.ndarray | None:
    """Return the rays within the box around a solid's corners in the picture, `None` for all."""
    corners = thing.corners_m
    if camera is None or corners is None:
        return None
    away = corners - camera.origin_m
    # A solid that reaches behind the camera has no box in the picture.
    if (away[:, 2] < 0.05).any():
        return None
    flat = away[:, :2] / away[:, 2:]
    # A little larger than the box, for rounding.
    low, high = flat.min(0) - 1e-5, flat.max(0) + 1e-5
    x, y = direction[:, 0], direction[:, 1]
    return np.flatnonzero((x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]))


def _find_edges(label: np.ndarray) -> np.ndarray:
    """Return the pixels next to another label, and their neighbours, `(h, w)` bool."""
    edge = np.zeros(label.shape, np.uint8)
    down, right = label[1:] != label[:-1], label[:, 1:] != label[:, :-1]
    edge[1:] |= down
    edge[:-1] |= down
    edge[:, 1:] |= right
    edge[:, :-1] |= right
    return edge.astype(bool)
