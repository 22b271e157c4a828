"""The camera's place from points that the chisel has touched and the camera has seen; needs no board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from perception.calibrate import rigid

FREEDOM = 4.0
"""Of Student's t, as in `hand_eye`."""
TRIPLES = 300
OUTSIDE = float(chi2.ppf(0.999, 3))
FEWEST = 4
STEPS = 60


@dataclass(frozen=True)
class Points:
    """`N` points, each known twice.

    Attributes:
        in_camera_m: As seen, `(N, 3)`.
        in_base_m: The tool's tip there, `(N, 3)`.
        cov_m2: Covariance of each as seen, `(N, 3, 3)` in the camera's frame: mostly along the
            sight.
    """

    in_camera_m: np.ndarray
    in_base_m: np.ndarray
    cov_m2: np.ndarray

    def part(self, chosen: np.ndarray) -> Points:
        """Returns the chosen points."""
        return Points(self.in_camera_m[chosen], self.in_base_m[chosen], self.cov_m2[chosen])

    def away_m(self, place: np.ndarray) -> np.ndarray:
        """Returns how far the tip was from where a camera at `place`, `(4, 4)`, sees each point, `(N, 3)` in the base frame."""
        return self.in_base_m - (self.in_camera_m @ place[:3, :3].T + place[:3, 3])

    def kabsch(self) -> np.ndarray:
        """Returns the camera's place, `(4, 4)`, that makes the sum of squared distances least (Kabsch, 1976)."""
        middle, there = self.in_camera_m.mean(0), self.in_base_m.mean(0)
        turn = rigid.nearest_rotation((self.in_base_m - there).T @ (self.in_camera_m - middle))
        return rigid.pose(turn, there - turn @ middle)


@dataclass(frozen=True)
class Fit:
    """What came out.

    Attributes:
        base_from_camera: The camera, `(4, 4)`.
        cov: Covariance of a small motion of it in its own frame, `(6, 6)`.
        factor: The tip is this many times less exact than was assumed, 1 or more.
        away_m: How far the tip was from where the camera sees each point, `(N, 3)` in the base
            frame.
        used: Which points were believed in the end, `(N,)` bool.
    """

    base_from_camera: np.ndarray
    cov: np.ndarray
    factor: float
    away_m: np.ndarray
    used: np.ndarray


def fit(points: Points, tip_std_m: float) -> Fit | None:
    """Returns the camera's place; `None` where there are too few points to contradict each other.

    Args:
        points: What was touched.
        tip_std_m: Standard deviation of the tip in each direction.
    """
    count = len(points.in_camera_m)
    if count < FEWEST:
        return None
    generator = np.random.default_rng(0)
    groups = [
        np.arange(count),
        *(generator.choice(count, 3, replace=False) for _ in range(TRIPLES)),
    ]
    places = [points.part(group).kabsch() for group in groups]
    place = places[
        int(np.argmin([np.median(np.linalg.norm(points.away_m(one), axis=1)) for one in places]))
    ]
    # half of the points may be wrong: the median says how exact the others are
    distance = _weighed(points, place, tip_std_m, None)[0]
    std_m = tip_std_m * np.sqrt(max(1.0, np.median(distance) / chi2.ppf(0.5, 3)))
    place = _refined(points, place, std_m, None)
    used = _weighed(points, place, std_m, None)[0] <= OUTSIDE
    used = used if used.sum() >= FEWEST else np.ones(count, bool)
    good, full = points.part(used), np.ones(int(used.sum()))
    place = _refined(good, place, std_m, full)
    distance, normal, _ = _weighed(good, place, std_m, full)
    excess = max(1.0, float(distance.sum()) / max(3.0 * used.sum() - 6.0, 1.0))
    cov = excess * np.linalg.pinv(normal, hermitian=True)
    return Fit(place, cov, float(std_m / tip_std_m * np.sqrt(excess)), points.away_m(place), used)


def width_m(in_base_m: np.ndarray) -> float:
    """Returns how far points, `(N, 3)`, spread across the line that fits them best, standard deviation; 0 lets them turn."""
    return float(
        np.linalg.svd(in_base_m - in_base_m.mean(0), compute_uv=False)[1] / np.sqrt(len(in_base_m))
    )


def _weighed(
    points: Points, place: np.ndarray, tip_std_m: float, fixed: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns squared distances in standard deviations, and the normal equations of a small motion of the camera."""
    away = points.away_m(place) @ place[:3, :3]  # in the camera's frame
    information = np.linalg.inv(points.cov_m2 + tip_std_m**2 * np.eye(3))
    distance = np.einsum("ni,nij,nj->n", away, information, away)
    weight = (FREEDOM + 3) / (FREEDOM + distance) if fixed is None else fixed
    slopes = np.concatenate(
        [np.broadcast_to(-np.eye(3), (len(away), 3, 3)), rigid.crossing(points.in_camera_m)], 2
    )
    weighted = np.swapaxes(slopes, 1, 2) @ (weight[:, None, None] * information)
    return distance, (weighted @ slopes).sum(0), (weighted @ away[..., None]).sum(0)[:, 0]


def _refined(
    points: Points, place: np.ndarray, tip_std_m: float, fixed: np.ndarray | None
) -> np.ndarray:
    for _ in range(STEPS):
        _, normal, gradient = _weighed(points, place, tip_std_m, fixed)
        step = -np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
        place = rigid.moved(place, step)
        if np.abs(step).max() < 1e-10:
            break
    return place
