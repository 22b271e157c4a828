"""Belief about the focal length of a pair by the rims of a session; holes are stated no surer.

A focal length that is too long by a factor stretches the depth of a pair by it. Faces that are seen
straight on show nothing of that, rims on tilted faces do: they are round with the right one alone.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, Share, spec

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
