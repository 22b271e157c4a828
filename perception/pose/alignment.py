"""Direct stereo alignment of the face's plane: the warp by which both pictures agree best.

A stereo matcher answers for each pixel with the bias of its sub-pixel step. Where a whole face is
one plane, only three numbers are to be found from all its pixels (Lucas and Kanade 1981, with the
plane's homography as the warp). Pixels inside a rim that disagree by that warp lie deeper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from brokk_rl.signals import Frame
from perception.ellipse import conic
from perception.pose.plane import FacePlane, compute_inverse_depth, compute_upper_median
from perception.robust_fit import (
    TUKEY,
    compute_biweight,
    compute_psi_slope,
    estimate_sandwich_covariance,
    estimate_spread,
    number_cells,
)

# Each of these times 0.8 or 1.25 left every count of holes and discs in 8 rendered frames as it was,
# and changed their median error by 0.4 mm at most. MOST, WIDE_PX, ROUNDS, SETTLED_PX and SATURATED were not varied.
SMOOTH_PX = 1.0
"""Blur of both pictures, px: noise would bias the gradient."""
WINDOW_PX = 31
"""Side of the window whose mean is taken off: vignetting and dust vary slowly."""
MOST = 30_000
"""Pixels compared, about; of more, rows are left out. Limits the time."""
WIDE_PX = 600
"""Width of a part of the picture from which a coarser resolution serves, px: a hole at 1 m takes 58 ms
and not 74, with the same errors."""
ROUNDS, SETTLED_PX = 3, 0.004
"""Largest number of steps, and length of a last one, px: each is about a fifth of the one
before."""
MARGIN_PX, BORDER_PX, SATURATED = 6, 4, 248.0
"""Margin around occluders, where a matcher bleeds, px; margin within the border, where blur mixes
the face with the background, px; grey level of saturation."""
LEAST, LEAST_INSIDE = 200, 24
"""Least pixels for an alignment, and for the comparison of an inside."""
ALIKE = 0.7
"""Least correlation of left and right picture; in haze and in the dark it is still 0.96."""
LARGEST_PX = 1.0
"""Largest shift of the whole face, px; beyond it the alignment has found something else."""


RimParts = tuple[float, tuple[float, float]]


@dataclass(frozen=True)
class StereoPatch:
    """A part of both pictures, blurred and shrunk.

    Attributes:
        left: Part of the left picture, `(h, w)` float32.
        right: Part of the right one with the same rows, `(h, W)` float32.
        shrink: Pixels of the picture to one of these.
        corner: First column and row of `left` in the picture, `(2,)`.
        right_column: First column of `right` in the picture.
        camera_matrix: Camera matrix of the whole picture, `(3, 3)`.
        pull_px: Focal length times baseline, px m: disparity per inverse depth.
        error_per_m: Known error of the disparity, as a plane in inverse depth, `(3,)` 1/m.
    """

    left: np.ndarray
    right: np.ndarray
    shrink: int
    corner: tuple[int, int]
    right_column: int
    camera_matrix: np.ndarray
    pull_px: float
    error_per_m: np.ndarray

    def compared(self) -> tuple[np.ndarray, np.ndarray]:
        """Return columns and rows of the picture that are compared; see `places`."""
        height, width = self.left.shape
        return self.places(np.arange(width), np.arange(0, height, self.stride))

    @property
    def stride(self) -> int:
        """Step between the rows that are compared; columns are kept: disparity is read along rows."""
        return max(1, round(self.left.size / MOST))

    def places(self, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return columns `(1, w)` and rows `(h, 1)` of the picture for those of `left`."""
        # Pixel centres: a shrunk pixel covers `shrink` pixels, and its centre lies between them.
        u, v = (
            (some + 0.5) * self.shrink - 0.5 + corner
            for some, corner in zip((columns, rows), self.corner, strict=True)
        )
        return u[None, :], v[:, None]

    def on_plane(self, u: np.ndarray, v: np.ndarray, m: np.ndarray) -> np.ndarray:
        """Return the columns of `right`, `(h, w)`, that show the points of a plane at `u`, `v` of the left."""
        return (
            u
            - self.pull_px * compute_inverse_depth(m + self.error_per_m, self.camera_matrix, u, v)
            - self.right_column
            + 0.5
        ) / self.shrink - 0.5

    def seen(
        self, u: np.ndarray, v: np.ndarray, row: np.ndarray, m: np.ndarray, picture: np.ndarray
    ) -> np.ndarray:
        """Return a picture like `right`, warped by a plane onto the left one; `row` as `remap` needs it."""
        return cv2.remap(picture, self.on_plane(u, v, m).astype(np.float32), row, cv2.INTER_CUBIC)

    def locate(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return columns and rows of `left` for those of the picture."""
        column, row = (
            (some - corner + 0.5) / self.shrink - 0.5
            for some, corner in zip((u, v), self.corner, strict=True)
        )
        return column, row

    def inside(self, u: np.ndarray, v: np.ndarray, m: np.ndarray) -> np.ndarray:
        """Find points of a plane that the right picture shows too, with room for its gradient."""
        x = self.on_plane(u, v, m)
        # Cubic interpolation and the gradient need three pixels on each side.
        return (x > 3) & (x < self.right.shape[1] - 4)


def crop_pair(
    frame: Frame, gray: np.ndarray, m: np.ndarray, ellipse: np.ndarray, outer: float
) -> StereoPatch | None:
    """Return both pictures around an ellipse `(5,)`, to `outer` radii; `None` without a right one."""
    if frame.right is None or frame.baseline_m is None or frame.right.shape != frame.color.shape:
        return None
    down, across = conic.bound_ellipse(ellipse, ellipse[2] * outer, gray.shape)
    top, bottom, left, right = down.start, down.stop, across.start, across.stop
    # 16 px: less has no room for the window of the means.
    if right - left < 16 or bottom - top < 16:
        return None
    # Rounded up: the part is then at most `WIDE_PX` wide.
    shrink = max(1, -(-(right - left) // WIDE_PX))
    pull_px = float(frame.camera_matrix[0, 0]) * frame.baseline_m
    # The corners bound the disparity, since inverse depth is linear on a plane.
    shift = pull_px * compute_inverse_depth(
        m, frame.camera_matrix, np.array([[left, right]]), np.array([[top], [bottom]])
    )
    # 8 px of room: the plane from depth may be off by a pixel, and interpolation needs some more.
    first = max(0, int(left - shift.max()) - 8 * shrink)
    last = min(gray.shape[1], int(right - shift.min()) + 8 * shrink)
    rows, columns = (bottom - top) // shrink, (right - left) // shrink
    others = (last - first) // shrink
    if others < 16:
        return None
    strip = frame.right[top : top + rows * shrink, first : first + others * shrink]
    partner = cv2.cvtColor(np.ascontiguousarray(strip), cv2.COLOR_RGB2GRAY)
    mine = gray[top : top + rows * shrink, left : left + columns * shrink]
    # Area interpolation keeps the sub-pixel position of edges; nearest pixels would shift them.
    small = [cv2.resize(picture, (size, rows), interpolation=cv2.INTER_AREA) if shrink > 1 else picture
             for picture, size in ((mine, columns), (partner, others))]  # fmt: skip
    one, other = (
        cv2.GaussianBlur(picture.astype(np.float32), (0, 0), SMOOTH_PX) for picture in small
    )
    constant, across, down = frame.disparity_error_px
    error_per_m = np.array([across, down, constant]) / pull_px
    place = (left, top), first, frame.camera_matrix
    return StereoPatch(one, other, shrink, *place, pull_px, error_per_m)


def align_plane(
    both: StereoPatch,
    face: FacePlane,
    frame: Frame,
    allowed: np.ndarray,
    ellipse: np.ndarray,
    inner: float,
    cell_px: int,
) -> FacePlane | None:
    """Return the plane by which both pictures agree best on the face.

    Return `face` where too little of it is visible, `None` where the pictures disagree: the right
    one belongs to another frame, or is shifted.

    Dust, exposure and vignetting vary slowly, so only departures from a window's mean count. Noise
    biases the gradient of a picture: steps by it are too short, and the covariance too small. So
    the gradient of the left picture, whose noise is independent, serves as instrument
    (instrumental variables).

    Args:
        both: The face in both pictures.
        face: Plane from depth, the start.
        frame: Frame with depth.
        allowed: Pixels of the face, `(h, w)` bool.
        ellipse: Rim, `(5,)`.
        inner: Inner limit in radii: nearer, both cameras see different sides of the rim.
        cell_px: Side of the squares within which errors may be correlated.
    """
    on = _find_face_pixels(both, face, frame, allowed, ellipse, inner)
    if np.count_nonzero(on) < LEAST:
        return face
    agreed, likeness, moved_px = _register_pictures(both, face, on, cell_px)
    # Pictures of different scenes correlate little, whatever the plane.
    if likeness < ALIKE:
        return None
    # A step beyond the uncertainty of depth follows another surface, or a repeated pattern.
    largest_px = LARGEST_PX * both.shrink + 3.0 * face.sigma * both.pull_px
    if agreed is None or not np.isfinite(agreed.m).all() or moved_px > largest_px:
        return face
    weights = [np.linalg.inv(one.cov) for one in (face, agreed)]
    cov = np.linalg.inv(weights[0] + weights[1])
    return replace(face, m=cov @ (weights[0] @ face.m + weights[1] @ agreed.m), cov=cov)


def _register_pictures(
    both: StereoPatch, face: FacePlane, on: np.ndarray, cell_px: int
) -> tuple[FacePlane | None, float, float]:
    """Fit the plane by which the pictures agree best at the pixels `on`; see `align_plane`.

    Returns:
        The plane, `None` where the pixels determine none; the correlation of left and warped right
            picture; and the largest shift on the face, px.
    """
    stride, (u, v) = both.stride, both.compared()
    at = np.flatnonzero(on)
    weight = on.astype(np.float32)
    window = (WINDOW_PX, max(3, WINDOW_PX // stride | 1))
    # Not zero: windows without a pixel of the face divide by it.
    counted = np.maximum(cv2.boxFilter(weight, -1, window), 1e-3)
    weight, counted = weight[..., None], counted[..., None]

    def departing(values: np.ndarray) -> np.ndarray:
        """Return two pictures `(h, w, 2)` on the face, less the mean of a window, `(2, P)`."""
        departs = values - cv2.boxFilter(values * weight, -1, window) / counted
        return departs.reshape(-1, 2)[at].T.astype(float)

    # Grey value and its gradient share one filter pass.
    left = cv2.merge([both.left, cv2.Sobel(both.left, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)])
    right = cv2.merge([both.right, cv2.Sobel(both.right, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)])
    mine, instrument = departing(left[::stride])
    height, width = both.left.shape
    row = np.repeat(np.arange(0, height, stride).astype(np.float32)[:, None], width, 1)
    line, column = np.divmod(at, width)
    u_on, v_on = u[0, column], v[line, 0]
    ray = np.linalg.inv(both.camera_matrix) @ np.stack([u_on, v_on, np.ones(len(at))])
    m, seen = face.m, mine
    # Gauss-Newton steps with the warped picture: the plane changes, so the picture is warped
    # anew.
    for _ in range(ROUNDS):
        seen, rise = departing(both.seen(u, v, row, m, right))
        push = np.vstack([ray * (-both.pull_px / both.shrink * rise), -mine])
        heavy = np.vstack([ray * (-both.pull_px / both.shrink * instrument), -mine])
        # Exposure may differ between the cameras by a factor.
        gain = float(np.sqrt((seen @ seen) / max(float(mine @ mine), 1e-9)))
        off = seen - gain * mine
        # The median is robust to occluders that depth did not show; 1e-6 guards a noiseless
        # picture.
        scale = 1.4826 * compute_upper_median(np.abs(off)) + 1e-6
        # Tukey's weights (95 % efficiency for normal errors) leave gross errors out altogether.
        heavy *= compute_biweight(off, TUKEY * scale)
        # The last unknown is the gain, which only has to be estimated along.
        step = np.linalg.lstsq(heavy @ push.T, heavy @ off, rcond=1e-12)[0][:3]
        m = m - step
        # The largest shift on the face decides: a tilt moves its border most.
        if both.pull_px * np.abs(step @ ray).max() < SETTLED_PX:
            break
    likeness = float(seen @ mine) / max(float(np.sqrt((seen @ seen) * (mine @ mine))), 1e-9)
    moved_px = float(both.pull_px * np.abs((m - face.m) @ ray).max())
    # Pixels of one cell share their error; a cell's number joins its row and column, which stay
    # below 10,000.
    cell = (v_on // cell_px).astype(np.int64) * 10_000 + (u_on // cell_px).astype(np.int64)
    slopes = (push[:3] * compute_psi_slope(np.divide(off, TUKEY * scale))).T
    cov = estimate_sandwich_covariance(slopes, heavy[:3].T, off, number_cells(cell))
    return None if cov is None else replace(face, m=m, cov=cov), likeness, moved_px


def _find_face_pixels(
    both: StereoPatch,
    face: FacePlane,
    frame: Frame,
    allowed: np.ndarray,
    ellipse: np.ndarray,
    inner: float,
) -> np.ndarray:
    """Find the places of `both` that show the face in both pictures, `(h, w)` bool.

    See `align_plane` for the arguments.
    """
    stride, (u, v) = both.stride, both.compared()
    pixel = np.ix_(
        np.rint(v[:, 0]).astype(int).clip(0, allowed.shape[0] - 1),
        np.rint(u[0]).astype(int).clip(0, allowed.shape[1] - 1),
    )
    depth = frame.depth_m[pixel]
    radii = conic.measure_radii(ellipse, u, v)
    # Unknown depth is NaN and compares false, which leaves those pixels out.
    with np.errstate(invalid="ignore"):
        # In inverse depth the noise of a matcher is the same at all distances.
        off = np.abs(1.0 / depth - face.inverse_depth(both.camera_matrix, u, v))
        on = allowed[pixel] & (off < 3.0 * face.sigma) & (radii > inner) & (radii < face.extent)
        other = (off > 8.0 * face.sigma).astype(np.uint8)
    # Single far pixels are matching errors; an occluder is wider. With rows left out, three rows
    # would be many.
    other = cv2.morphologyEx(other, cv2.MORPH_OPEN, np.ones((1 if stride > 1 else 3, 3), np.uint8))
    margin = np.ones((2 * round(MARGIN_PX / stride) + 1, 2 * MARGIN_PX + 1), np.uint8)
    on &= (
        # Margins are wide, since a single edge of an occluder outweighs many pixels of grain.
        (cv2.dilate(np.asarray(other), margin) == 0)
        & both.inside(u, v, face.m)
        & (both.left[::stride] < SATURATED)
    )
    # Closed first, so that single missing pixels are no borders.
    whole = cv2.morphologyEx(on.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 5), np.uint8))
    on &= (
        cv2.erode(whole, np.ones((2 * round(BORDER_PX / stride) + 1, 2 * BORDER_PX + 1), np.uint8))
        > 0
    )
    return on


def measure_parallax(
    both: StereoPatch, face: FacePlane, depth_m: np.ndarray, ellipse: np.ndarray, parts: RimParts
) -> tuple[float, float]:
    """Return the difference of both pictures inside an ellipse over that on the face around it.

    Both are aligned by the face's plane. A flat disc looks the same from both cameras, the inside
    of a hole does not. NaN where too little of it is visible. Also return the part of the inside
    that an occluder hides from the right camera alone.

    Args:
        both: Surroundings of the ellipse in both pictures.
        face: Plane of the face.
        depth_m: Depth, `(h, w)`; occluders are left out.
        ellipse: Rim, `(5,)`.
        parts: Outer limit of the inside, and limits of the ring on the face, radii.
    """
    inner, ring = parts
    reach = ring[1] * ellipse[2] / both.shrink
    across, down = (
        (max(0, int(middle - reach)), min(size, int(middle + reach) + 2))
        for middle, size in zip(
            both.locate(ellipse[0], ellipse[1]), both.left.shape[::-1], strict=True
        )
    )
    # The same part serves for both pictures, since their rows correspond.
    part = np.s_[down[0] : down[1], across[0] : across[1]]
    if down[1] <= down[0] or across[1] <= across[0]:
        return float("nan"), 0.0
    u, v = both.places(np.arange(*across), np.arange(*down))
    radii = conic.measure_radii(ellipse, u, v)
    rows, columns = (
        np.rint(some).astype(int).clip(0, most - 1)
        for some, most in zip((v[:, 0], u[0]), depth_m.shape, strict=True)
    )
    depth = depth_m[np.ix_(rows, columns)]
    before = face.find_nearer(depth, both.camera_matrix, u, v).astype(np.uint8)
    shown = both.inside(u, v, face.m) & (cv2.dilate(before, np.ones((5, 5), np.uint8)) == 0)
    # Occlusion by the arm looks like depth: pixels that the right camera cannot see are left out.
    hidden = shown & (radii < inner) & _find_hidden_from_right(both, face, depth_m, u, v)
    covered = float(hidden.sum() / max(np.count_nonzero(shown & (radii < inner)), 1))
    shown &= ~hidden
    within, around = shown & (radii < inner), shown & (radii > ring[0]) & (radii < ring[1])
    if within.sum() < LEAST_INSIDE or around.sum() < LEAST_INSIDE:
        return float("nan"), covered
    row = np.repeat(np.arange(*down, dtype=np.float32)[:, None], across[1] - across[0], 1)
    mine, seen = both.left[part], both.seen(u, v, row, face.m, both.right)
    # Brighter pixels may be an occluder that only the right camera sees there.
    within &= seen < np.median(seen[around])
    if within.sum() < LEAST_INSIDE:
        return float("nan"), covered
    off = mine - seen * (np.median(mine[around]) / max(float(np.median(seen[around])), 1.0))
    # Not below 0.1 grey levels: a saturated face has no scatter at all.
    usual = estimate_spread(off[around] - np.median(off[around]))
    return float(np.std(off[within])) / max(usual, 0.1), covered


def _find_hidden_from_right(
    both: StereoPatch, face: FacePlane, depth_m: np.ndarray, u: np.ndarray, v: np.ndarray
) -> np.ndarray:
    """Find points of a face, `(h, w)`, that an occluder hides from the right camera alone."""
    rows = np.rint(v[:, 0]).astype(int).clip(0, len(depth_m) - 1)
    # Such an occluder lies to their right in the left picture.
    columns = np.arange(max(0, int(u[0, 0])), depth_m.shape[1])
    depth = depth_m[rows, columns[0] :]
    nearer = face.find_nearer(depth, both.camera_matrix, columns[None, :], rows[:, None])
    row, column = np.nonzero(nearer)
    shadow = np.zeros((len(rows), depth_m.shape[1]), np.uint8)
    # A point of the occluder hides the face where both fall on one column of the right picture.
    place = np.rint(columns[column] - both.pull_px / depth[row, column]).astype(int)
    on = (place >= 0) & (place < shadow.shape[1])
    shadow[row[on], place[on]] = 1
    shadow = cv2.dilate(shadow, np.ones((3, 2 * MARGIN_PX + 1), np.uint8))
    away = both.pull_px * face.inverse_depth(both.camera_matrix, u, v)
    seen = np.rint(u - away).astype(int).clip(0, shadow.shape[1] - 1)
    return np.take_along_axis(shadow, seen, 1) > 0
