"""One target from what is seen frame after frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from brokk_rl.contracts.vision import HolePose, Target
from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

CHI2_3 = 11.34
"""99 % of a chi-square with three degrees of freedom."""


@spec
class Fusion:
    """Weighs what frames say by their covariance, leaves outliers out, says when the target is stale.

    Attributes:
        gate: Squared Mahalanobis distance beyond which a hole is another one, in units of the 99 %
            quantile.
        floor_m: Standard deviation that frames of one place share and that no averaging takes away.
        drift_m: Standard deviation by which the target may move, per square root of a second.
        confirm: Frames that must agree before there is a target.
        stale_s: Age from which nobody should act on it.
        forget_s: Age at which it is forgotten, and another one may take its place.
    """

    gate: float
    floor_m: float
    drift_m: float
    confirm: int
    stale_s: float
    forget_s: float

    def check(self) -> None:
        if not 0 < self.stale_s <= self.forget_s or self.confirm < 1 or self.gate <= 0:
            raise ConfigError(
                f"perception.filter: expected 0 < stale_s <= forget_s, confirm >= 1 and gate > 0, got {self.stale_s}, "
                f"{self.forget_s}, {self.confirm} and {self.gate}"
            )

    def build(self) -> FusionFilter:
        """Returns a filter that has seen nothing yet."""
        return FusionFilter(self)


@dataclass(frozen=True)
class _Track:
    """A place at which holes were seen; covariances are those of the average, without what all frames share."""

    pose: HolePose
    num_frames: int
    seen_s: float
    updated_s: float


class FusionFilter:
    """See `Fusion`. Follows several places; the target is the one that most frames speak for."""

    def __init__(self, settings: Fusion) -> None:
        self.settings = settings
        self._tracks: list[_Track] = []

    def reset(self) -> None:
        """Forgets everything."""
        self._tracks = []

    def update(self, poses: Sequence[HolePose], t_s: float) -> Target | None:
        """Takes the holes seen at `t_s`; returns the target; see `TargetFilter`."""
        s = self.settings
        tracks = [track for track in self._tracks if t_s - track.seen_s <= s.forget_s]
        tracks = [self._drifted(track, t_s) for track in tracks]
        free = list(range(len(tracks)))
        for pose in sorted(map(_own, poses), key=lambda pose: -pose.score):
            distances = {k: self._distance(tracks[k].pose, pose) for k in free}
            best = min(distances, key=distances.__getitem__, default=None)
            if best is not None and distances[best] <= s.gate * CHI2_3:
                tracks[best] = _fused(tracks[best], pose, t_s)
                free.remove(best)
            else:
                tracks.append(_Track(pose, 1, t_s, t_s))
        self._tracks = tracks
        known = [track for track in tracks if track.num_frames >= s.confirm]
        if not known:
            return None
        track = max(known, key=lambda track: (track.num_frames, track.pose.score))
        age_s = t_s - track.seen_s
        pose = track.pose
        pose = replace(
            pose, cov_m2=pose.cov_m2 + np.eye(3) * s.floor_m**2 + _or_zero(pose.shared_m2),
            axis_cov_rad2=pose.axis_cov_rad2 + _or_zero(pose.shared_rad2),
        )  # fmt: skip
        return Target(pose, track.num_frames, age_s, age_s > s.stale_s)

    def _drifted(self, track: _Track, t_s: float) -> _Track:
        grown = track.pose.cov_m2 + np.eye(3) * self.settings.drift_m**2 * max(
            t_s - track.updated_s, 0.0
        )
        return replace(track, pose=replace(track.pose, cov_m2=grown), updated_s=t_s)

    def _distance(self, first: HolePose, second: HolePose) -> float:
        """Returns the squared Mahalanobis distance between two centres."""
        apart = second.center_m - first.center_m
        shared = first.cov_m2 + second.cov_m2 + np.eye(3) * self.settings.floor_m**2
        return float(apart @ np.linalg.solve(shared, apart))


def _own(pose: HolePose) -> HolePose:
    """Returns a pose with what is its own of its covariances: further frames take that away, and not what all of them share."""
    return replace(
        pose,
        cov_m2=pose.cov_m2 - _or_zero(pose.shared_m2),
        axis_cov_rad2=pose.axis_cov_rad2 - _or_zero(pose.shared_rad2),
    )


def _or_zero(cov: np.ndarray | None) -> np.ndarray:
    return np.zeros((3, 3)) if cov is None else cov


def _fused(track: _Track, pose: HolePose, t_s: float) -> _Track:
    """Returns the track with one more frame, weighed by information."""
    before, tiny = track.pose, np.eye(3) * 1e-12
    gain = before.cov_m2 @ np.linalg.inv(before.cov_m2 + pose.cov_m2 + tiny)
    center = before.center_m + gain @ (pose.center_m - before.center_m)
    cov = (np.eye(3) - gain) @ before.cov_m2 @ (np.eye(3) - gain).T + gain @ pose.cov_m2 @ gain.T
    w = (
        1.0 / max(float(np.trace(before.axis_cov_rad2)), 1e-12),
        1.0 / max(float(np.trace(pose.axis_cov_rad2)), 1e-12),
    )
    part = w[1] / (w[0] + w[1])
    axis = (1 - part) * before.axis + part * pose.axis
    axis_cov = (1 - part) ** 2 * before.axis_cov_rad2 + part**2 * pose.axis_cov_rad2
    number = track.num_frames + 1
    fused = HolePose(
        center_m=center,
        axis=axis / np.linalg.norm(axis),
        radius_m=before.radius_m + (pose.radius_m - before.radius_m) / number,
        cov_m2=(cov + cov.T) / 2,
        axis_cov_rad2=axis_cov,
        frame=pose.frame,
        score=max(before.score, pose.score),
        t_s=t_s,
        shared_m2=pose.shared_m2,
        shared_rad2=pose.shared_rad2,
    )
    return _Track(fused, number, t_s, t_s)
