"""Proposals from regions of a face: places that look like a hole, whatever their edges.

Arcs of edges find a rim that is seen clearly. A chipped rim, or one half in a shadow, has no long
arcs. Each face is therefore drawn once more as seen from straight ahead, in a coarse scale in which
a hole of known size is a disc of few pixels. A region of that size is proposed where it is dark
all around its border, where the segmenter sees a hole, or where depth is missing or lies behind the
face.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import Ellipse, Masks
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception.pose import plane, rim
from perception.pose.plane_conic import convert_to_gray
from perception.segment.depth_plane import scale_noise

# Chosen by hand on rendered scenes (benchmarks/perception/rims.py).
STEP = 8
"""Pixels of the picture to a sample of depth from which faces are found."""
LEAST = 40
"""Least samples of a face; a hole at 1 m has about 100."""
FACES, TRIALS, JUDGES = 4, 80, 500
"""Most faces of a frame (three of a block, one more); planes tried for each, and samples that
judge them."""
NOISES = 3.0
"""Standard deviations of inverse depth within which a sample lies on a face."""
MOST_PX = 420
"""Largest side of a drawn face, px; of a larger one the scale is coarser. Limits the time."""
VOTING = 0.9, 1.0, 1.1
"""Radii at which an edge votes for a centre: a chipped rim is no circle."""
BLUR, SPREAD = 0.1, 0.18
"""Blur of a face, and of its votes, in radii of a hole."""
EDGE_PX = 2.0
"""Width of an edge on the face; a whole rim of it has a border of 1."""
FAINT, STEADY = 0.3, 0.5
"""Least weight of an edge that votes; gradient that a flat face has anyway, grey levels a px."""
AROUND = 2.0
"""Radii around a pixel within which its gradient is compared with the usual one."""
INSIDE, RING = 0.75, (1.25, 1.75)
"""Radii of the inside of a region, and of the ring of face around it."""
DARKER_PART = 33.0
"""Percentile of a ring with which the inside is compared: half of it may lie in the sun."""
APART = 1.0
"""Least distance of two proposals, in radii."""
ROUND, ON_FACE = 24, 0.8
"""Places around a region at each of six radii where depth is read; least part of the outer ones
that lies on the face: the arm may cover the rest."""


@spec
class FaceRegions:
    """Propose regions of a hole's size on each face: dark ones, those of the hole mask, voids of depth.

    Attributes:
        radius_m: Radius of the holes.
        radius_px: The same in the picture of a face from straight ahead; decides the time.
        noise_per_m: Standard deviation of inverse depth on a face, 1/m.
        border: Least part of a region's border along which brightness rises outwards.
        weak_border: The same for a region that one of the next three shows too.
        darker: Least contrast of inside and ring, over the brightness of the ring.
        hole_mask: Least mean of the segmenter's hole mask inside.
        void: Least part of the inside without depth or behind the face, less that of the ring.
    """

    radius_m: Positive
    radius_px: Annotated[float, Ge(4)]
    noise_per_m: float
    border: float
    weak_border: float
    darker: float
    hole_mask: float
    void: float

    def build(self) -> FaceRegionProposer:
        """Return a proposer."""
        return FaceRegionProposer(self)


class FaceRegionProposer:
    """Proposer of regions with the settings `FaceRegions`; a `perception.contracts.HoleProposer`."""

    def __init__(self, settings: FaceRegions) -> None:
        self.settings = settings

    def propose(self, frame: Frame, masks: Masks) -> list[Ellipse]:
        """Return the ellipses of regions, the likeliest first; see `HoleProposer`."""
        s = self.settings
        gray = convert_to_gray(frame)
        found: list[Ellipse] = []
        noise_per_m = scale_noise(s.noise_per_m, frame)
        for face in find_faces(frame, masks.block > 0.5, noise_per_m, s.radius_m, s.radius_px):
            found += self._propose_on(face, frame, gray, masks)
        kept: list[Ellipse] = []
        # Two faces that meet show the same region twice.
        for one in sorted(found, key=lambda one: -one.score):
            if all(np.hypot(one.x - k.x, one.y - k.y) > APART * k.b for k in kept):
                kept.append(one)
        return kept

    def _propose_on(
        self, face: FacePicture, frame: Frame, gray: np.ndarray, masks: Masks
    ) -> Iterator[Ellipse]:
        """Yield the regions of one face."""
        s = self.settings
        drawn = face.draw(gray)
        border = vote_for_centres(drawn, face.radius_px)
        reach = int(APART * face.radius_px)
        highest = cv2.dilate(border, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        rows, columns = np.nonzero((border == highest) & (border >= s.weak_border))
        if not len(rows):
            return
        on, void = face.measure_depth(
            frame, masks.block > 0.5, rows, columns, scale_noise(s.noise_per_m, frame)
        )
        for number in np.flatnonzero(on >= ON_FACE).tolist():
            row, column = int(rows[number]), int(columns[number])
            share = min(float(border[row, column]), 1.0)
            if share < s.border and void[number] < s.void:
                bright, dark = average_parts(drawn, row, column, face.radius_px)
                is_dark = bright - dark >= s.darker * max(bright, 1.0)
                if not is_dark and self._measure_mouth(face, masks, row, column) < s.hole_mask:
                    continue
            ellipse = face.chart.seen(np.array([*face.place(row, column), s.radius_m]))
            if np.isfinite(ellipse).all():
                yield Ellipse(*map(float, ellipse), rms_px=0.0, coverage=share, score=share)

    def _measure_mouth(self, face: FacePicture, masks: Masks, row: int, column: int) -> float:
        """Return the mean of the hole mask inside a region; 0 without a mask."""
        if masks.hole_mask is None:
            return 0.0
        return average_parts(face.draw(masks.hole_mask), row, column, face.radius_px)[1]


@dataclass(frozen=True)
class FacePicture:
    """A face as seen from straight ahead.

    Attributes:
        chart: Coordinates on its plane, m.
        corner_m: Coordinates of the first pixel, `(2,)`.
        pixel_m: Length of a pixel.
        shape: Rows and columns.
        radius_px: Radius of a hole.
    """

    chart: rim.PlaneChart
    corner_m: np.ndarray
    pixel_m: float
    shape: tuple[int, int]
    radius_px: float

    def place(self, row: float, column: float) -> np.ndarray:
        """Return the coordinates of a pixel on the plane, m, `(2,)`."""
        return self.corner_m + self.pixel_m * np.array([column, row])

    @property
    def into_frame(self) -> np.ndarray:
        """Homography from its pixels to those of the frame, `(3, 3)`."""
        chart, (x, y) = self.chart, self.corner_m
        scale = np.array([[self.pixel_m, 0.0, x], [0.0, self.pixel_m, y], [0.0, 0.0, 1.0]])
        return (
            chart.camera_matrix @ np.column_stack([chart.first, chart.second, chart.origin]) @ scale
        )

    def draw(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture of the frame, `(h, w)`, as it looks on the face; 0 beyond the frame."""
        # The middle of the face decides how many pixels of the frame one of its own covers.
        middle = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
        middle += np.array([[self.shape[1] / 2], [self.shape[0] / 2], [1.0]])
        seen = self.into_frame @ middle
        seen = seen[:2] / seen[2]
        shrink = max(1, int(np.linalg.norm(seen[:, 1:] - seen[:, :1], axis=0).max()))
        # Only the part of the frame that shows the face is shrunk.
        corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]]) * [
            self.shape[1],
            self.shape[0],
            1.0,
        ]
        box = self.into_frame @ corners.T
        box = box[:2] / box[2]
        height, width = picture.shape
        left, top = np.clip(box.min(1).astype(int) - shrink, 0, (width - 1, height - 1))
        right, bottom = np.clip(box.max(1).astype(int) + 2 * shrink, 1, (width, height))
        part = picture[top:bottom, left:right]
        size = max(1, part.shape[1] // shrink), max(1, part.shape[0] // shrink)
        part = part[: size[1] * shrink, : size[0] * shrink]
        if shrink > 1 and min(part.shape) >= shrink:
            # Averages, so that grain does not alias into edges.
            part = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        # Pixel centres lie at whole numbers, so a shrunk pixel's centre lies between pixels.
        half = 0.5 / shrink - 0.5
        shift = np.array(
            [
                [1.0 / shrink, 0.0, half - left / shrink],
                [0.0, 1.0 / shrink, half - top / shrink],
                [0.0, 0.0, 1.0],
            ]
        )
        return cv2.warpPerspective(
            part,
            shift @ self.into_frame,
            self.shape[::-1],
            flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR,
        ).astype(np.float32)

    def measure_depth(
        self,
        frame: Frame,
        mask: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
        noise_per_m: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the part of a ring around pixels `(R,)` that lies on the face, and the void inside.

        The void is the part without depth, or with depth behind the face, less that of the ring.
        """
        angle = np.linspace(0.0, 2 * np.pi, ROUND, endpoint=False)
        radii = self.radius_px * np.array([[0.25], [0.5], [0.75], [1.3], [1.6], [1.9]])
        x = columns[:, None] + (radii * np.cos(angle)).ravel()
        y = rows[:, None] + (radii * np.sin(angle)).ravel()
        seen = np.stack([x, y, np.ones_like(x)], -1) @ self.into_frame.T
        u, v = np.moveaxis(np.rint(seen[..., :2] / seen[..., 2:]).astype(int), -1, 0)
        height, width = mask.shape
        shown = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        u, v = u.clip(0, width - 1), v.clip(0, height - 1)
        here = plane.compute_inverse_depth(self.chart.m, self.chart.camera_matrix, u, v)
        # Unknown depth compares false.
        off = 1.0 / frame.depth_m[v, u] - here
        on = shown & mask[v, u] & (np.abs(off) < 2 * NOISES * noise_per_m)
        void = shown & ~(off > -NOISES * noise_per_m)
        half = x.shape[1] // 2
        return on[:, half:].mean(1), void[:, :half].mean(1) - void[:, half:].mean(1)


def find_faces(
    frame: Frame, mask: np.ndarray, noise_per_m: float, radius_m: float, radius_px: float
) -> list[FacePicture]:
    """Return the planes of the marked pixels `(h, w)` bool, the largest first (RANSAC)."""
    depth = frame.depth_m[STEP // 2 :: STEP, STEP // 2 :: STEP]
    known = mask[STEP // 2 :: STEP, STEP // 2 :: STEP] & np.isfinite(depth)
    row, column = np.nonzero(known)
    inverse = 1.0 / depth[known].astype(float)
    pixels = np.column_stack([column, row]) * STEP + STEP // 2
    rays = np.column_stack([pixels, np.ones(len(row))]) @ np.linalg.inv(frame.camera_matrix).T
    # A fixed seed: the same frame gives the same faces.
    generator, found = np.random.default_rng(0), []
    while len(found) < FACES and len(rays) >= LEAST:
        judges = generator.integers(len(rays), size=min(len(rays), JUDGES))
        triples = generator.integers(len(rays), size=(TRIALS, 3))
        # Points nearly on a line determine no plane.
        triples = triples[np.abs(np.linalg.det(rays[triples])) > 1e-6]
        if not len(triples):
            break
        planes = np.linalg.solve(rays[triples], inverse[triples][..., None])[..., 0]
        off = np.abs(inverse[judges, None] - rays[judges] @ planes.T)
        m = planes[np.argmax(np.count_nonzero(off < NOISES * noise_per_m, axis=0))]
        on = np.abs(inverse - rays @ m) < NOISES * noise_per_m
        # Least squares twice: three points alone are noisy.
        for _ in range(2):
            if np.count_nonzero(on) < LEAST:
                return found
            m = np.linalg.lstsq(rays[on], inverse[on], rcond=None)[0]
            on = np.abs(inverse - rays @ m) < NOISES * noise_per_m
        found.append(_frame_face(rays[on], m, frame.camera_matrix, radius_m, radius_px))
        rays, inverse = rays[~on], inverse[~on]
    return found


def _frame_face(
    rays: np.ndarray, m: np.ndarray, camera_matrix: np.ndarray, radius_m: float, radius_px: float
) -> FacePicture:
    """Return the picture of a plane `m` that holds the points at rays `(P, 3)`."""
    points = rays / (rays @ m)[:, None]
    middle = points.mean(0)
    chart = rim.build_chart(middle / float(m @ middle), m, camera_matrix)
    flat = np.column_stack([(points - chart.origin) @ axis for axis in (chart.first, chart.second)])
    # A margin of a hole's diameter: it may lie at the border of the face.
    low = np.percentile(flat, 1.0, axis=0) - 2.0 * radius_m
    size_m = np.percentile(flat, 99.0, axis=0) + 2.0 * radius_m - low
    pixel_m = max(radius_m / radius_px, float(size_m.max()) / MOST_PX)
    shape = int(size_m[1] / pixel_m) + 1, int(size_m[0] / pixel_m) + 1
    return FacePicture(chart, low, pixel_m, shape, radius_m / pixel_m)


def vote_for_centres(drawn: np.ndarray, radius_px: float) -> np.ndarray:
    """Return the part of a dark disc's border around each pixel of a face, `(h, w)` float32.

    Each edge votes for the centre of the disc on whose border it would lie (Kimme, Ballard and
    Sklansky 1975). Its weight depends on the gradients around it alone: in a shadow the border is
    faint, but as long.
    """
    smooth = cv2.GaussianBlur(drawn, (0, 0), BLUR * radius_px)
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    square = across * across + down * down
    steep = cv2.sqrt(square)
    side = 2 * round(AROUND * radius_px) + 1
    usual = cv2.boxFilter(steep, -1, (side, side))
    weight = square / (square + usual * usual + STEADY**2)
    # Beyond the frame the picture is black: its border is no edge.
    weight[cv2.erode((drawn > 0).view(np.uint8), np.ones((5, 5), np.uint8)) == 0] = 0.0
    votes = np.zeros(drawn.size, np.float32)
    height, width = drawn.shape
    rows, columns = np.nonzero(weight > FAINT)
    weight = weight[rows, columns]
    along_x = across[rows, columns] / steep[rows, columns]
    along_y = down[rows, columns] / steep[rows, columns]
    for factor in VOTING:
        x = np.rint(columns - factor * radius_px * along_x).astype(np.int32)
        y = np.rint(rows - factor * radius_px * along_y).astype(np.int32)
        on = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        votes += np.bincount(y[on] * width + x[on], weight[on], drawn.size).astype(np.float32)
    spread_px = SPREAD * radius_px
    votes = cv2.GaussianBlur(votes.reshape(drawn.shape), (0, 0), spread_px)
    # A whole border has `2 pi radius` pixels in length and `EDGE_PX` across; the blur divides
    # their votes by `2 pi spread²`.
    return votes * (spread_px**2 / (len(VOTING) * radius_px * EDGE_PX))


def average_parts(
    picture: np.ndarray, row: int, column: int, radius_px: float
) -> tuple[float, float]:
    """Return the lower third of a picture in the ring around a place, and its mean inside."""
    reach = int(RING[1] * radius_px) + 1
    top, left = max(0, row - reach), max(0, column - reach)
    part = picture[top : row + reach + 1, left : column + reach + 1]
    y, x = np.ogrid[top : top + part.shape[0], left : left + part.shape[1]]
    radii = np.hypot(y - row, x - column) / radius_px
    ring, inside = part[(radii > RING[0]) & (radii < RING[1])], part[radii < INSIDE]
    return float(np.percentile(ring, DARKER_PART)) if ring.size else 0.0, float(
        inside.mean()
    ) if inside.size else 0.0
