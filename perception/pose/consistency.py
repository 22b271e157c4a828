"""Consistency of a hole with its surroundings, and the belief about the focal length that follows.

The ring around a hole lies on the plane that was fitted to its face, and its rim is a circle of the
known radius on that plane.

A focal length that is too long by a factor stretches the depth of a pair by it. Faces that are seen
straight on show nothing of that, rims on tilted faces do: they are round with the right one alone.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.contracts.vision import Ellipse, Rejection
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, Share, spec
from perception.ellipse import conic
from perception.pose import plane, rim
from perception.pose.plane import FacePlane, FaceSupport
from perception.pose.rim import PlaneChart
from perception.robust_fit import TUKEY, compute_biweight, estimate_spread, fit_linear

SIZE = "radius of a rim by depth over that of the holes"
RING_KNOWN = "pixels with depth in the ring around it"
RING_ON_FACE = "part of the ring around it that lies on its face"
NEARER = "part of the inside that is nearer than the face"
STRETCH = "focal length by the roundness of the rim"
EXPLANATIONS = {
    RING_KNOWN: "the ring around it has hardly any depth: dark, near, or no texture?",
    RING_ON_FACE: "its surroundings are larger than its face. Is the block in the mask?",
    NEARER: "its inside is nearer than the face. Something stands there.",
    STRETCH: "it is round with K over this factor. K is that of another resolution or lens.",
    SIZE: "it is round, of another size: baseline_m, unit of depth, K, or perception.pose.radius_m?",
}
"""Explanation and remedy for each reason."""
LEAST_SLOPE, LEAST_EDGES = 0.07, 30
"""Squared slope of a face, 15 degrees, from which the shape of a rim tells the focal length; edges
from which its seven numbers are determined."""
REACH = 0.1
"""Departure from a circle within which its edges are looked for, in radii: a focal length that is
wrong by a fifth on a face at 45 degrees."""
NEARBY, DOUBTED = 0.05, 0.02
"""Logarithm of the factor up to which a rim's shape is linear in it, and that from which other factors
are tried: by 0.85 the linear one of far rims was 1.05 to 1.09."""
TRIALS, AS_ROUND = ((0.7, 0.1), (0.08, 0.02)), 0.3
"""Reach and step of the factors that are tried, and largest part of the oval that the best of them
may leave."""
BESIDE = (1.15, 1.45)
"""Radii of an ellipse at which occluders of its rim are searched."""


def check_ring(
    points: FaceSupport,
    face: FacePlane,
    limits: tuple[float, float],
    is_aligned: bool,
    ellipse: Ellipse,
) -> Rejection | None:
    """Return why the innermost ring is not on the face, `None` where it is.

    A plane that was grown outwards may have left the ring where it began: the surroundings of a
    block, a belt, were taken for its face.

    Args:
        points: Depth around the ellipse.
        face: Its plane.
        limits: Outer radius of the ring in radii of the ellipse, and least part of it on the face.
        is_aligned: Both pictures agree on the plane, so that a ring without depth is no doubt.
        ellipse: The candidate.
    """
    ring = points.radii < limits[0]
    number = int(np.count_nonzero(ring))
    if number < plane.LEAST // 2:
        if is_aligned:
            return None
        return Rejection("pose", RING_KNOWN, float(number), plane.LEAST / 2, ellipse)
    off = np.abs(points.inverse[ring] - points.rays[ring] @ face.m)
    share = float(np.mean(off < plane.TUKEY * face.sigma))
    if share < limits[1]:
        return Rejection("pose", RING_ON_FACE, share, limits[1], ellipse)
    return None


def measure_stretch(
    light: np.ndarray, chart: PlaneChart, face: FacePlane, row: np.ndarray
) -> tuple[float, float] | None:
    """Return the focal length over that with which a rim is round on its face, and its deviation.

    A focal length that is too long by a factor stretches the depth of a pair by it, so that a round
    rim on a tilted face becomes longer along its slope.

    Args:
        light: Light, `(h, w)` float32.
        chart: Coordinates on the face, with the focal length in doubt.
        face: The face.
        row: The rim as it is seen, `(5,)`.

    Returns:
        The factor and the standard deviation of its logarithm; `None` where the tilt is too small
        to tell, or too few edges are seen.
    """
    ray = np.linalg.solve(chart.camera_matrix, np.array([row[0], row[1], 1.0]))
    cosine = float(face.normal @ ray) / float(np.linalg.norm(ray))
    if 1.0 / cosine**2 - 1.0 < LEAST_SLOPE:
        return None
    # A rim that is not round departs from its circle by a part of its size.
    reach_px = max(rim.NARROW_PX, REACH * float(np.sqrt(row[2] * row[3])))
    profiles = rim.find_profile_edges(light, row, reach_px, chart)
    if profiles is None:
        return None
    known = np.isfinite(profiles.edges[..., 0])
    rows = np.flatnonzero(known.any(1))
    if len(rows) < LEAST_EDGES:
        return None
    # The steepest edge of each profile; the robust fit leaves out those that are not the rim's.
    steepest = np.argmax(np.where(known, profiles.strength, -1.0), axis=1)
    pixels = profiles.pixels[rows, steepest[rows]]

    def expand(logarithm: float) -> tuple[np.ndarray, np.ndarray]:
        """Return waves around the middle of edges, `(n, 7)`, and the distances of those, m, `(n,)`.

        The focal length is that of the chart over the factor of this logarithm.
        """
        factor = float(np.exp(logarithm))
        matrix = chart.camera_matrix.copy()
        matrix[[0, 1], [0, 1]] /= factor
        m = face.m * [1.0, 1.0, factor]
        ray = np.linalg.solve(matrix, np.array([row[0], row[1], 1.0]))
        flat = rim.build_chart(ray / (m @ ray), m, matrix)
        away = flat.flat(pixels)
        # The line of sight lies above the steepest direction of the face.
        angle = np.arctan2(away[:, 1], away[:, 0])
        angle = angle - np.arctan2(flat.second @ ray, flat.first @ ray)
        waves = [np.ones(len(angle))]
        for number in (1, 2, 3):
            waves += [np.cos(number * angle), np.sin(number * angle)]
        return np.column_stack(waves), np.linalg.norm(away, axis=1)

    waves, distance_m = expand(0.0)
    floor_m = 1e-3 * float(np.median(distance_m))
    solution, cov = fit_linear(waves, distance_m, floor_m)
    away_m = distance_m - waves @ solution
    # The waves hold any oval, so that edges of something else are the same by all focal lengths.
    weight = compute_biweight(away_m, TUKEY * max(estimate_spread(away_m), floor_m))

    def measure_oval(logarithm: float) -> np.ndarray:
        """Return how oval weighted edges are, along the slope of the face and diagonally, in radii."""
        waves, distance_m = expand(logarithm)
        heavy = waves.T * weight
        solution = np.linalg.lstsq(heavy @ waves, heavy @ distance_m, rcond=None)[0]
        return solution[3:5] / solution[0]

    oval, std = solution[3:5] / solution[0], float(np.sqrt(cov[3, 3]) / solution[0])
    rise = (measure_oval(NEARBY)[0] - oval[0]) / NEARBY
    if not abs(rise) > 1e-3:
        return None
    logarithm = -oval[0] / rise
    # Neighbouring edges share their error.
    pixel_m = float(np.median(profiles.pixel_m))
    alike_m = rim.ALIKE_PX * pixel_m + rim.ALIKE_M
    perimeter_m = conic.compute_perimeter(row[2], row[3]) * pixel_m
    num_alike = max(alike_m * len(profiles.pixel_m) / perimeter_m, 1.0)
    std *= float(np.sqrt(num_alike) / abs(rise))
    # Beyond, two tilts show the same length along the slope; only one shows a circle.
    if abs(logarithm) > DOUBTED:
        logarithm, least = 0.0, np.inf
        for reach, step in TRIALS:
            sizes = {}
            for trial in logarithm + np.arange(-reach, reach + step / 2, step):
                sizes[float(trial)] = float(np.linalg.norm(measure_oval(trial)))
            logarithm = min(sizes, key=sizes.__getitem__)
            least = sizes[logarithm]
        # Edges of something else are round with no focal length.
        if least > AS_ROUND * np.linalg.norm(oval):
            return None
    return float(np.exp(logarithm)), std


def measure_tilt_doubt(chart: PlaneChart, face: FacePlane) -> float:
    """Return the deviation of the logarithm of `measure_stretch` that a face's own tilt leaves.

    A rim is stretched by an error of the tilt times its tangent, and by that of the logarithm times
    its squared sine.
    """
    ray = chart.origin / np.linalg.norm(chart.origin)
    uphill = ray - float(ray @ face.normal) * face.normal
    sine = float(np.linalg.norm(uphill))
    uphill /= sine
    tilt_std_rad = float(np.sqrt(uphill @ face.normal_cov_rad2() @ uphill))
    return tilt_std_rad / (sine * float(np.sqrt(1.0 - sine**2)))


def measure_hidden_part(face: FacePlane, row: np.ndarray, frame: Frame) -> float:
    """Return the part of a rim on a face, near an ellipse `(5,)`, that an occluder hides.

    Searched at two radii: the ellipse may be smaller than the rim, and depth is often unknown at
    the edge of an occluder.
    """
    height, width = frame.depth_m.shape
    # A step of 5 degrees.
    nearer = np.zeros(72, bool)
    for scale in BESIDE:
        points = conic.sample_ellipses(
            (row * [1.0, 1.0, scale, scale, 1.0])[None],
            np.linspace(0.0, 2 * np.pi, 72, endpoint=False),
        )[0][0]
        column, line = np.rint(points).astype(int).T
        on = (column >= 0) & (column < width) & (line >= 0) & (line < height)
        depth = frame.depth_m[line.clip(0, height - 1), column.clip(0, width - 1)]
        nearer |= on & face.find_nearer(depth, frame.camera_matrix, *points.T)
    return float(nearer.mean())


GRID = np.linspace(-1.5, 1.5, 601)
"""Logarithms of the factor that are told apart: up to 4.5, in steps of 0.005."""
IMPOSSIBLE = 1e-300
"""Density in place of 0, whose logarithm is finite."""
SAME_RIM = 0.5
"""Distance of two ellipses over the semi-axis of one up to which they show the same rim."""


@spec
class FocalDoubt:
    """Doubt about a focal length before any rim was measured, and about one measurement.

    Attributes:
        wrong: Probability that it is wrong.
        slip_std: Standard deviation of the logarithm of the factor if it is wrong.
        gross: Probability that a measurement follows something else.
        widened: Factor on the stated deviation of a measurement.
        least_std: Standard deviation that comes on top.
        sure: Probability from which a wrong one is named; it stays named while it is likelier wrong.
        factor: Least factor of a wrong one: no slip is smaller, and a calibration errs by less.
    """

    wrong: Share
    slip_std: Positive
    gross: Share
    widened: Positive
    least_std: Positive
    sure: Share
    factor: Positive


class FocalBelief:
    """Probability of each factor on the focal length of one camera, by all rims that it showed."""

    def __init__(self, doubt: FocalDoubt) -> None:
        self._doubt = doubt
        self._camera: tuple[object, ...] = ()
        self._is_right = self._slip = np.zeros(0)
        self._rims: list[tuple[np.ndarray, int]] = []
        self._is_named = False

    def begin(self, frame: Frame) -> None:
        """Forget everything where a frame is of another camera than the last one."""
        # Parts of a picture have principal points of their own.
        camera = (frame.camera_matrix[0, 0], frame.camera_matrix[1, 1], frame.baseline_m)
        if camera == self._camera:
            return
        self._camera, self._rims, self._is_named = camera, [], False
        doubt = self._doubt
        slip = np.exp(-0.5 * (GRID / doubt.slip_std) ** 2)
        slip[np.abs(GRID) < np.log(doubt.factor)] = IMPOSSIBLE
        self._slip = np.log(doubt.wrong * slip / slip.sum())
        self._is_right = np.log(1.0 - doubt.wrong)

    def learn(
        self, ellipse: np.ndarray, camera_matrix: np.ndarray, logarithm: float, std: float
    ) -> None:
        """Take what a rim `(5,)` shows: the logarithm of the factor and its standard deviation.

        A rim that was seen `n` times before counts `1 / (n + 1)`: its frames share their error.
        """
        place_px = ellipse[:2] - camera_matrix[:2, 2]
        weight = 1.0 / (self._count_views(place_px, float(ellipse[2])) + 1)
        self._slip = self._slip + weight * self._compare(logarithm - GRID, std)
        self._is_right = self._is_right + weight * self._compare(np.array(logarithm), std)

    @property
    def std(self) -> float:
        """Root mean square of the logarithm of the factor."""
        return float(np.sqrt(self._weigh() @ GRID**2))

    def find_slip(self) -> float | None:
        """Return the likeliest factor if the focal length is surely wrong, else `None`."""
        probability = self._weigh()
        self._is_named = float(probability.sum()) > (0.5 if self._is_named else self._doubt.sure)
        return float(np.exp(GRID[np.argmax(probability)])) if self._is_named else None

    def _weigh(self) -> np.ndarray:
        """Return the probability of each wrong factor of the grid; the rest is that of a right one."""
        largest = max(float(self._slip.max()), float(self._is_right))
        slip = np.exp(self._slip - largest)
        return slip / (slip.sum() + np.exp(self._is_right - largest))

    def _compare(self, off: np.ndarray, std: float) -> np.ndarray:
        """Return the log-likelihood of a measurement that is off by this much."""
        doubt = self._doubt
        std = float(np.hypot(doubt.widened * std, doubt.least_std))
        density = np.exp(-0.5 * (off / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
        anywhere = 1.0 / (GRID[-1] - GRID[0])
        return np.log((1.0 - doubt.gross) * density + doubt.gross * anywhere)

    def _count_views(self, place_px: np.ndarray, size_px: float) -> int:
        """Return how often the rim at a place was seen before, and count this time."""
        for number, (before_px, count) in enumerate(self._rims):
            if np.linalg.norm(before_px - place_px) < SAME_RIM * size_px:
                self._rims[number] = (place_px, count + 1)
                return count
        self._rims.append((place_px, 1))
        return 0


def compute_focal_covariances(
    center_m: np.ndarray, normal: np.ndarray, std: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return covariances of a hole's centre and normal by that of the focal length's logarithm.

    The pair's depth grows with it, what lies across does not.
    """
    ahead = np.array([0.0, 0.0, 1.0])
    moved_m = std * center_m[2] * ahead
    turned = std * normal[2] * (ahead - normal[2] * normal)
    return np.outer(moved_m, moved_m), np.outer(turned, turned)
