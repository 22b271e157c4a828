"""Tracking of boreholes over frames: nearest-neighbour association, inverse-variance averaging."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from brokk_rl.contracts.vision import HolePose, TrackedHole
from brokk_rl.errors import ConfigError
from brokk_rl.spec import Count, NonNegative, Positive, spec

SMALLEST_VARIANCE_M2 = 1e-8
"""Variance below which a detection counts no more, (0.1 mm)²: no camera measures better."""


@spec
class VarianceFusion:
    """Average the detections of each hole by their variance, with a limited memory.

    An unseen hole ages: its covariance grows until it is seen again.
    The error of the camera's pose is the same in all frames (`HolePose.shared_m2`): it weighs
    nothing, and averaging does not reduce it.

    Attributes:
        near_m: Detections nearer to each other than this are the same hole.
        memory: Detections, at most, that count against a new one.
        confirm: Detections from which a hole is confirmed.
        stale_s: Age from which a hole is stale.
        forget_s: Age from which a hole is forgotten.
        drift_m_sqrt_s: Standard deviation of each coordinate one second after a detection, by which
            the base may have moved against the hole; it grows with the square root of the time.
    """

    near_m: Positive
    memory: Count
    confirm: Count
    stale_s: Positive
    forget_s: float
    drift_m_sqrt_s: NonNegative

    def check(self) -> None:
        if self.stale_s > self.forget_s:
            raise ConfigError(f"stale_s: {self.stale_s} is above forget_s={self.forget_s}")

    def build(self) -> FusionTracker:
        """Return a tracker that has seen nothing yet."""
        return FusionTracker(self)


@dataclass(frozen=True)
class _Track:
    """A hole that was seen at least once.

    Attributes:
        pose: The last detection, with the averaged centre.
        weight: Inverse of the centre's variance without the shared part, 1/m².
        own_cov_m2: Covariance of the centre without the shared part; its mean variance is
            1 / weight.
        num_frames: Detections so far.
        seen_s: Time of the last one.
    """

    pose: HolePose
    weight: float
    own_cov_m2: np.ndarray
    num_frames: int
    seen_s: float


class FusionTracker:
    """Tracks of the known boreholes, averaged with the settings `VarianceFusion`."""

    def __init__(self, settings: VarianceFusion) -> None:
        self.settings = settings
        self._tracks: dict[int, _Track] = {}
        self._num_names = 0

    def update(self, holes: Sequence[HolePose], t_s: float) -> list[TrackedHole]:
        """Take the holes of the frame at `t_s`; return all known ones by name; see `HoleTracker`."""
        for hole in holes:
            self._add(hole, t_s)
        # A list, since tracks are deleted on the way.
        for name, track in list(self._tracks.items()):
            if t_s - track.seen_s > self.settings.forget_s:
                del self._tracks[name]
        return [self._describe(name, track, t_s) for name, track in self._tracks.items()]

    def _add(self, hole: HolePose, t_s: float) -> None:
        """Average a detection into the nearest track, or begin a new one."""
        shared_m2 = _take_mean_variance(hole.shared_m2)
        # The shared part is no noise of this detection and must not weigh.
        weight = 1.0 / max(SMALLEST_VARIANCE_M2, float(np.trace(hole.cov_m2)) / 3 - shared_m2)
        own_cov_m2 = hole.cov_m2 if hole.shared_m2 is None else hole.cov_m2 - hole.shared_m2
        name = self._find_nearest(hole)
        if name is None:
            self._num_names += 1
            self._tracks[self._num_names] = _Track(hole, weight, own_cov_m2, 1, t_s)
            return
        old = self._age(self._tracks[name], t_s)
        # The cap lets a base that was moved be noticed within a few detections.
        before = min(old.weight, self.settings.memory * weight)
        total = before + weight
        center_m = (before * old.pose.center_m + weight * hole.center_m) / total
        # The cap on the old weight inflates the old covariance by the same factor.
        faded_cov_m2 = old.own_cov_m2 * (old.weight / before)
        own_cov_m2 = (before**2 * faded_cov_m2 + weight**2 * own_cov_m2) / total**2
        # Axis and radius are the newest: they are not averaged.
        pose = replace(hole, center_m=center_m)
        self._tracks[name] = _Track(pose, total, own_cov_m2, old.num_frames + 1, t_s)

    def _age(self, track: _Track, t_s: float) -> _Track:
        """Return a track as it is known at `t_s`: a random walk since its last detection."""
        variance_m2 = self.settings.drift_m_sqrt_s**2 * max(0.0, t_s - track.seen_s)
        weight = 1.0 / (1.0 / track.weight + variance_m2)
        own_cov_m2 = track.own_cov_m2 + variance_m2 * np.eye(3)
        return replace(track, weight=weight, own_cov_m2=own_cov_m2)

    def _find_nearest(self, hole: HolePose) -> int | None:
        """Return the name of the track at the place of a detection, `None` for none."""
        distances_m: dict[int, float] = {}
        for number, track in self._tracks.items():
            away_m = track.pose.center_m - hole.center_m
            distances_m[number] = float(np.linalg.norm(away_m))
        # The nearest track wins: two holes are farther apart than `near_m`.
        name = min(distances_m, key=distances_m.__getitem__, default=None)
        return name if name is not None and distances_m[name] <= self.settings.near_m else None

    def _describe(self, name: int, track: _Track, t_s: float) -> TrackedHole:
        track = self._age(track, t_s)
        shared_m2 = track.pose.shared_m2
        cov_m2 = track.own_cov_m2 if shared_m2 is None else track.own_cov_m2 + shared_m2
        return TrackedHole(
            name=name,
            pose=replace(track.pose, cov_m2=cov_m2),
            # The shared error comes back in: it is part of the position's uncertainty.
            std_m=math.sqrt(1.0 / track.weight + _take_mean_variance(shared_m2)),
            num_frames=track.num_frames,
            seen_s=track.seen_s,
            confirmed=track.num_frames >= self.settings.confirm,
            stale=t_s - track.seen_s > self.settings.stale_s,
        )


def _take_mean_variance(cov_m2: np.ndarray | None) -> float:
    """Return the mean variance of the three coordinates, 0 for `None`."""
    return 0.0 if cov_m2 is None else float(np.trace(cov_m2)) / 3
