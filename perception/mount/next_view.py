"""Choice of the next view: the expected covariance of the hole after some seconds.

A view is worth what its frames would tell. The frames count from the camera's arrival on, as far as
the hole is in the picture and the planned motion of the arm leaves it in sight. Each would measure
the centre with the noise of stereo at that distance. Their information joins that of the present
estimate, which ages meanwhile. The view with the smallest expected variance is chosen.

Axes: `V` views, `T` times of the plan, `J` joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import CameraView, TrackedHole
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec
from perception.mount.mounts import CameraMount
from perception.mount.occlusion import ArmShape, compute_visible_share, sample_circle
from perception.render.stereo_camera import StereoRig

UP = np.array([0.0, 0.0, 1.0])
"""Axis of a hole that was never seen: the task drills from above."""
SMALLEST_VARIANCE_M2 = 1e-10
"""Smallest variance of a belief, (0.01 mm)²: no camera measures better."""
AS_GOOD = 1.05
"""Factor on the smallest expected standard deviation up to which a view is as good. Chosen by hand."""
BELIEF_AFTER_MISS = 0.5
"""Factor on the frames expected from a view after each frame that showed nothing. Chosen by hand."""


@dataclass(frozen=True)
class HoleBelief:
    """Knowledge about the hole that is looked for.

    Attributes:
        center_m: Centre of the rim in the base frame, `(3,)`.
        axis: Unit axis out of the hole, `(3,)`.
        radius_m: Radius.
        cov_m2: Covariance of the centre without the error of the camera's pose, `(3, 3)`.
    """

    center_m: np.ndarray
    axis: np.ndarray
    radius_m: float
    cov_m2: np.ndarray

    @classmethod
    def expect(
        cls, hole: TrackedHole | None, center_m: np.ndarray, radius_m: float, std_m: float
    ) -> HoleBelief:
        """Return the belief about a tracked hole; without one that about a hole drilled from above.

        Args:
            hole: The tracked hole, `None` before it was seen.
            center_m: Where it is expected then, `(3,)`.
            radius_m: Its radius then.
            std_m: Standard deviation of each coordinate then.
        """
        if hole is None:
            return cls(center_m, UP, radius_m, std_m**2 * np.eye(3))
        pose = hole.pose
        shared_m2 = np.zeros((3, 3)) if pose.shared_m2 is None else pose.shared_m2
        # Frames cannot reduce the shared part, and a covariance must stay invertible without it.
        own_m2 = pose.cov_m2 - shared_m2 + SMALLEST_VARIANCE_M2 * np.eye(3)
        return cls(pose.center_m, pose.axis, pose.radius_m, own_m2)


@spec
class ExpectedCovariance:
    """Choose the view with the smallest expected variance of the hole's centre.

    Attributes:
        horizon_s: Time ahead for which frames count; the plan of the arm reaches as far.
        num_times: Times of the plan that are looked at.
        rate_hz: Frames a second that the tracker would get.
        disparity_px: Noise of the disparity of a face, 1 sigma.
        center_px: Noise of a rim's centre in the picture, 1 sigma.
        visible: Part of the rim in sight from which on it is found at all, and from which on
            always.
        tilt_rad: Largest angle between the hole's axis and the line of sight.
        margin: Part of the picture along its border in which no hole is found.
        drift_m_sqrt_s: How an unseen hole ages, as the tracker has it.
        improvement: Part by which the expected standard deviation must be smaller for the camera to
            leave its view.
    """

    horizon_s: Positive
    num_times: Annotated[int, Ge(2)]
    rate_hz: Positive
    disparity_px: Positive
    center_px: Positive
    visible: tuple[float, float]
    tilt_rad: float
    margin: float
    drift_m_sqrt_s: float
    improvement: float

    def check(self) -> None:
        if not 0 <= self.visible[0] < self.visible[1] <= 1:
            raise ConfigError(f"visible: expected 0 <= lowest < highest <= 1, got {self.visible}")


class ViewPlanner:
    """A camera on its mount, moved to the view with the smallest `ExpectedCovariance` of the hole.

    Attributes:
        position: Position of the mount, `(A,)`.
        arrives_s: Time from which pictures are used.
        num_missed: Last frames from this position in which nothing was found: something hides the hole
            that the plan does not know.
        view: The last choice, `None` before the first.
    """

    def __init__(
        self,
        settings: ExpectedCovariance,
        machine: Machine,
        mount: CameraMount,
        rig: StereoRig,
        arm: ArmShape,
    ) -> None:
        self.settings = settings
        self._machine, self._mount, self._rig, self._arm = machine, mount, rig, arm
        self.position, self.arrives_s = mount.start.copy(), -np.inf
        self.num_missed = 0
        self.view: CameraView | None = None

    def aim(self, hole: HoleBelief, plan_q: np.ndarray, t_s: float) -> CameraView:
        """Choose the next view and go there.

        Args:
            hole: The hole.
            plan_q: Joint positions of the arm at `num_times` times from now to `horizon_s`,
                `(T, J)`.
            t_s: Time of the choice.
        """
        s, mount = self.settings, self._mount
        positions = np.concatenate([self.position[None], mount.views])
        travel_s = mount.compute_travel_s(self.position, positions)
        poses = mount.locate(positions[:, None], plan_q[None])
        poses = np.broadcast_to(poses, (len(positions), len(plan_q), 4, 4))
        times_s = np.linspace(0.0, s.horizon_s, len(plan_q))
        found = self.predict_detection(hole, poses, plan_q)
        seen = (found * (times_s >= travel_s[:, None])).mean(1)
        # The present view may be one of the mount's own, too.
        seen[(positions == self.position).all(-1)] *= BELIEF_AFTER_MISS**self.num_missed
        variance_m2 = self._predict_variance(hole, poses, s.rate_hz * s.horizon_s * seen)
        std_m = np.sqrt(variance_m2)
        # Of views that are as good, the one that has the hole in the middle.
        away_m = hole.center_m - poses[:, -1, :3, 3]
        ahead = (poses[:, -1, :3, 2] * away_m).sum(1) / np.linalg.norm(away_m, axis=1)
        is_good = std_m <= AS_GOOD * std_m.min()
        best = int(np.argmax(np.where(is_good, ahead, -np.inf)))
        if std_m[best] > (1.0 - s.improvement) * std_m[0]:
            best = 0
        self.view = CameraView(
            name=mount.describe(positions[best]),
            is_moving=best > 0,
            travel_s=float(travel_s[best]),
            seen_s=float(seen[best]) * s.horizon_s,
            seen_before_s=float(seen[0]) * s.horizon_s,
            horizon_s=s.horizon_s,
            std_m=float(std_m[best]),
            std_before_m=float(std_m[0]),
        )
        if best > 0:
            self.position, self.arrives_s = positions[best], t_s + self.view.travel_s
            self.num_missed = 0
        return self.view

    def predict_detection(
        self, hole: HoleBelief, poses: np.ndarray, plan_q: np.ndarray
    ) -> np.ndarray:
        """Return the probability that a frame shows the hole, `(V, T)`.

        Args:
            hole: The hole.
            poses: Poses of the camera, `(V, T, 4, 4)`.
            plan_q: Joint positions of the arm, `(T, J)`.
        """
        s = self.settings
        rim_m = sample_circle(hole.center_m, hole.axis, hole.radius_m)
        capsules = self._arm.cover(self._machine, plan_q)
        share = compute_visible_share(poses[..., :3, 3], rim_m, capsules)
        least, enough = s.visible
        chance = np.clip((share - least) / (enough - least), 0.0, 1.0)
        return chance * self._is_in_picture(hole, poses)

    def _is_in_picture(self, hole: HoleBelief, poses: np.ndarray) -> np.ndarray:
        """Return whether the hole lies in the picture and is not seen too obliquely, `(V, T)`."""
        s, rig = self.settings, self._rig
        away_m = hole.center_m - poses[..., :3, 3]
        center = np.einsum("...ji,...j->...i", poses[..., :3, :3], away_m)
        depth_m = np.maximum(center[..., 2], 1e-3)
        pixel = rig.left.project(np.concatenate([center[..., :2], depth_m[..., None]], -1))
        size = np.array([rig.width, rig.height])
        inside = ((pixel > s.margin * size) & (pixel < (1.0 - s.margin) * size)).all(-1)
        cosine = -(away_m @ hole.axis) / np.linalg.norm(away_m, axis=-1)
        return inside & (center[..., 2] > 0.05) & (cosine > np.cos(s.tilt_rad))

    def _predict_variance(
        self, hole: HoleBelief, poses: np.ndarray, num_frames: np.ndarray
    ) -> np.ndarray:
        """Return the expected mean variance of the centre after the frames of each view, `(V,)`."""
        s, rig = self.settings, self._rig
        away_m = hole.center_m - poses[:, -1, :3, 3]
        # The distance, not the depth: no view is better for having the hole in a corner.
        range_m = np.linalg.norm(away_m, axis=1)
        ray = away_m / range_m[:, None]
        across_m = s.center_px * range_m / rig.focal_px
        along_m = s.disparity_px * range_m**2 / (rig.focal_px * rig.baseline_m)
        along = ray[:, :, None] * ray[:, None, :]
        precision = along / along_m[:, None, None] ** 2
        precision += (np.eye(3) - along) / across_m[:, None, None] ** 2
        information = num_frames[:, None, None] * precision
        aged_m2 = hole.cov_m2 + s.drift_m_sqrt_s**2 * s.horizon_s * np.eye(3)
        posterior = np.linalg.inv(np.linalg.inv(aged_m2) + information)
        return np.trace(posterior, axis1=1, axis2=2) / 3
