"""Segmentation of the block by depth alone: bounded planes in front of their surroundings.

Inverse depth is the natural coordinate. On a plane `n · P = d` it is linear in the picture,
`1/z = (n / d) · (x, y, 1)` with `(x, y)` the pixel over the focal length, and the noise of a stereo
matcher in it is the same at every distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from brokk_rl.contracts.vision import Masks
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, Positive, spec
from perception.pose.plane import compare_pair


def compute_sight_rays(camera_matrix: np.ndarray, shape: tuple[int, ...], step: int) -> np.ndarray:
    """Return the lines of sight `(x, y, 1)` of the middles of cells of `step` x `step` px, `(h, w, 3)`."""
    rays = np.ones((*shape, 3), np.float32)
    for k, place in enumerate((np.arange(shape[1])[None, :], np.arange(shape[0])[:, None])):
        middle = place * step + step // 2
        rays[..., k] = (middle - camera_matrix[k, 2]) / camera_matrix[k, k]
    return rays


def scale_noise(noise_per_m: float, frame: Frame) -> float:
    """Return the standard deviation of a frame's inverse depth, 1/m, from that of a full match.

    It is that of the pair of `perception.pose.plane.USUAL_PULL_PX_M`, and follows focal length and
    baseline. A coarse match is noisier, but less than its pixels are larger: it averages them. With the
    square root the segmenter finds the block in haze and in the dark as often as before.
    """
    return noise_per_m * compare_pair(frame) * float(np.sqrt(frame.depth_shrink))


@spec
class DepthPlane:
    """Take planes in front of their surroundings for the block; needs depth, no training.

    Attributes:
        width_px: Width of the picture in which planes are looked for.
        min_known: Part of the pixels whose depth must be known; a frame with less is refused.
        noise_per_m: Standard deviation of inverse depth of the usual pair, 1/m; see `scale_noise`.
        num_sigma: Tolerance of a plane in standard deviations.
        num_trials: Planes through three pixels that are tried for each plane kept.
        num_samples: Pixels that judge a trial.
        num_planes: Largest number of planes.
        neighbourhood: Width of the window from which the three pixels are drawn, as a part of the
            picture's width.
        min_area: Smallest face, as a part of the picture.
        min_extent_m: Smallest extent of a face.
        max_extent_m: Largest extent of a face; larger planes are ground or wall.
        max_tilt_rad: Largest angle between the face's normal and the line of sight.
        min_front: Least part of the surroundings behind a piece of a plane that also holds a piece
            larger than a face.
        seed: Of the trials; the same frame always gives the same mask.
    """

    width_px: Count
    min_known: float
    noise_per_m: Positive
    num_sigma: Positive
    num_trials: Count
    num_samples: Count
    num_planes: Count
    neighbourhood: Positive
    min_area: float
    min_extent_m: Positive
    max_extent_m: float
    max_tilt_rad: float
    min_front: float
    seed: int

    def check(self) -> None:
        if self.min_extent_m >= self.max_extent_m:
            raise ConfigError(f"min_extent_m: {self.min_extent_m} is not < {self.max_extent_m}")

    def build(self) -> DepthPlane:
        """Return the segmenter, which is the spec itself."""
        return self

    def segment(self, frame: Frame) -> Masks:
        """Return the mask of the block; there is no hole mask.

        Raises:
            FrameError: too little depth is known.
        """
        height, width = frame.depth_m.shape
        step = max(1, round(width / self.width_px))
        inverse, known = _shrink_depth(frame.depth_m, step)
        if known.mean() < self.min_known:
            raise FrameError(
                f"{frame.name or 'frame'}: depth is known in {known.mean():.1%} of the pixels, "
                f"depth_plane needs {self.min_known:.0%}; check the depth camera, its light "
                "and its range"
            )
        tolerance = self.num_sigma * scale_noise(self.noise_per_m, frame)
        rays = compute_sight_rays(frame.camera_matrix, inverse.shape, step)
        face = _PlaneSearch(self, rays, inverse, known, tolerance).find_faces()
        mask = np.zeros((height, width), np.float32)
        # The last cells may be smaller ones.
        size = (min(len(face[0]) * step, width), min(len(face) * step, height))
        mask[: size[1], : size[0]] = cv2.resize(
            face.astype(np.float32), size, interpolation=cv2.INTER_LINEAR
        )
        return Masks(mask, None)


@dataclass(frozen=True)
class _PlaneSearch:
    """Search for the faces of a block in the depth of one frame.

    Attributes:
        settings: Sizes, and the number of trials.
        rays: Lines of sight of the cells, `(h, w, 3)`.
        inverse: Inverse depth, 1/m, `(h, w)` float32.
        known: Where it is known, `(h, w)` bool.
        tolerance: Of a plane, 1/m.
    """

    settings: DepthPlane
    rays: np.ndarray
    inverse: np.ndarray
    known: np.ndarray
    tolerance: float

    def find_faces(self) -> np.ndarray:
        """Return the cells of all faces, `(h, w)` uint8."""
        face = np.zeros(self.inverse.shape, np.uint8)
        for plane in self._find_planes():
            face |= self._select_faces(plane)
        return face

    def _find_planes(self) -> list[np.ndarray]:
        """Return planes `n / d`, `(3,)`, the best supported first, each of pixels left by those before."""
        s, rays, inverse = self.settings, self.rays, self.inverse
        generator = np.random.default_rng(s.seed)
        found, rest = [], self.known.copy()
        for _ in range(s.num_planes):
            there = np.flatnonzero(rest)
            if len(there) < s.min_area * rest.size:
                break
            trials = self._draw_trials(rest, there, generator)
            judge = there[generator.integers(len(there), size=s.num_samples)]
            off = trials @ rays.reshape(-1, 3)[judge].T - inverse.ravel()[judge]
            votes = np.count_nonzero(np.abs(off) < self.tolerance, axis=1)
            best = int(votes.argmax()) if len(votes) else 0
            if not len(votes) or votes[best] / s.num_samples * len(there) < s.min_area * rest.size:
                break
            found.append(self._refine(trials[best], rest))
            rest &= np.abs(rays @ found[-1].astype(np.float32) - inverse) >= self.tolerance
        return found

    def _draw_trials(
        self, rest: np.ndarray, there: np.ndarray, generator: np.random.Generator
    ) -> np.ndarray:
        """Return planes through three neighbouring pixels of `rest`, at many scales, `(trials, 3)`."""
        count, (height, width) = self.settings.num_trials, rest.shape
        row, column = np.divmod(there[generator.integers(len(there), size=count)], width)
        reach = width * self.settings.neighbourhood * generator.uniform(0.2, 1.0, count)
        shift = np.rint(generator.uniform(-1.0, 1.0, (2, 2, count)) * reach).astype(int)
        corner_rows = np.stack([row, *np.clip(row + shift[0], 0, height - 1)])
        corner_columns = np.stack([column, *np.clip(column + shift[1], 0, width - 1)])
        corners = corner_rows, corner_columns
        # (trials, 3 pixels, 3)
        triples = np.moveaxis(self.rays[corners], 0, 1)
        usable = rest[corners].all(0) & (np.abs(np.linalg.det(triples)) > 1e-5)
        values = self.inverse[corners].T[usable]
        return np.linalg.solve(triples[usable], values[..., None])[..., 0]

    def _refine(self, plane: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Return the least-squares plane of the pixels of `rest` that agree with `plane`."""
        # A quarter of the pixels tells it as well.
        rest = rest[::2, ::2]
        rays, inverse = self.rays[::2, ::2][rest].astype(float), self.inverse[::2, ::2][rest]
        for _ in range(2):
            inside = np.abs(rays @ plane - inverse) < self.tolerance
            plane = np.linalg.lstsq(rays[inside], inverse[inside], rcond=None)[0]
        return plane

    def _select_faces(self, plane: np.ndarray) -> np.ndarray:
        """Return the connected pieces of a plane that can be faces of a block, `(h, w)` uint8."""
        s, known, rays, tolerance = self.settings, self.known, self.rays, self.tolerance
        excess = self.inverse - rays @ plane.astype(np.float32)  # > 0: nearer than the plane
        support = (known & (np.abs(excess) < tolerance)).astype(np.uint8)
        support = cv2.morphologyEx(support, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        support = cv2.morphologyEx(support, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(support, connectivity=4)
        nearer = (known & (excess > tolerance)).astype(np.uint8)
        nearer = np.asarray(cv2.morphologyEx(nearer, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))
        pieces = []
        for label in range(1, count):
            if stats[label, cv2.CC_STAT_AREA] >= s.min_area * support.size:
                pieces.append(_fill_holes((labels == label).astype(np.uint8), nearer))
        pieces = [piece for piece in pieces if piece[::2, ::2].any()]
        faces = np.zeros_like(support)
        # Ground and wall are too large for a face. Pieces that an occluder cuts off from them must
        # also stand in front of their surroundings; a face by itself may have none in sight.
        extents_m = [_measure_extents(piece, plane, rays) for piece in pieces]
        wide = any(extent.prod() > s.max_extent_m**2 for extent in extents_m)
        for piece, extent in zip(pieces, extents_m, strict=True):
            if self._fits(piece, extent, plane) and (
                not wide or _measure_front(piece, excess, known, tolerance) >= s.min_front
            ):
                faces |= piece
        # An arm cuts a face into pieces; the smaller ones have hardly any surroundings but the arm.
        for piece in pieces if faces.any() else ():
            if _measure_extents(faces | piece, plane, rays).max() <= s.max_extent_m:
                faces |= piece
        return faces

    def _fits(self, piece: np.ndarray, extents_m: np.ndarray, plane: np.ndarray) -> bool:
        """Return whether a piece of a plane has the size of a face and is turned to the camera."""
        s = self.settings
        if extents_m.min() < s.min_extent_m or extents_m.max() > s.max_extent_m:
            return False
        sums = cv2.moments(piece, binaryImage=True)
        sight = self.rays[round(sums["m01"] / sums["m00"]), round(sums["m10"] / sums["m00"])]
        tilt_rad = np.arccos(
            np.clip(abs(sight @ plane) / np.linalg.norm(sight) / np.linalg.norm(plane), 0.0, 1.0)
        )
        return bool(tilt_rad <= s.max_tilt_rad)


def _measure_front(
    piece: np.ndarray, excess: np.ndarray, known: np.ndarray, tolerance: float
) -> float:
    """Return the part of a piece's surroundings behind its plane, one half without evidence."""
    near = cv2.dilate(piece, np.ones((5, 5), np.uint8))
    far = cv2.dilate(piece, np.ones((9, 9), np.uint8))
    ring = (far > near) & known
    behind = np.count_nonzero(excess[ring] < -tolerance)
    before = np.count_nonzero(excess[ring] > tolerance)
    doubt = 0.05 * np.count_nonzero(ring) + 1.0
    return (behind + 0.5 * doubt) / (behind + before + doubt)


def _shrink_depth(depth_m: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse depth at the middle of each cell, 1/m, `(h, w)` float32, and its known mask."""
    depth = depth_m[step // 2 :: step, step // 2 :: step]
    known = np.isfinite(depth) & (depth > 0)
    return np.divide(1.0, depth, out=np.zeros(depth.shape, np.float32), where=known), known


def _fill_holes(piece: np.ndarray, nearer: np.ndarray) -> np.ndarray:
    """Fill the gaps of a piece (a hole, lost depth), except where an occluder is."""
    outlines, _ = cv2.findContours(piece, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = cv2.drawContours(np.zeros_like(piece), outlines, -1, 1, cv2.FILLED)
    return np.where(nearer > 0, np.uint8(0), np.asarray(whole, np.uint8))


def _measure_extents(piece: np.ndarray, plane: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the two extents in m that a rectangle with the piece's second moments would have."""
    seen = rays[::2, ::2][piece[::2, ::2] > 0].astype(float)
    points_m = seen / np.maximum(seen @ plane, 1e-6)[:, None]
    # The smallest is the plane's own thickness.
    spread = np.linalg.eigvalsh(np.cov(points_m.T, bias=True))[1:]
    return np.sqrt(12.0 * np.maximum(spread, 0.0))
