"""Camera mounts, fixed or on driven axes on the base or a link of the machine, and their next view.

A mount has a position, `(A,)`: one number for each axis. `locate` turns it into the camera's pose.
Frames of machine and mount have x forward, y left and z up; the camera's own follow the optical
convention.

Axes: `A` numbers of a position, `V` views, `J` joints; anything may stand before `A` and `J`.

A view is worth what its frames would tell. The frames count from the camera's arrival on, as far as
the hole is in the picture and the planned motion of the arm, as capsules, leaves it in sight. Each
would measure the centre with the noise of stereo at that distance. Their information joins that of
the present estimate, which ages meanwhile. The view with the smallest expected variance is chosen.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import CameraView, TrackedHole
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_link_pose, compute_tool_kinematics, rotate_about_axis
from brokk_rl.machine import Machine
from brokk_rl.spec import Count, NonNegative, Positive, spec
from perception.calibrate.transforms import span_plane
from perception.render.stereo_camera import StereoRig, build_camera_pose

BASE = "base"
"""Name of the frame that stands still."""


@spec
class MountError:
    """Error of the camera's believed pose, 1 sigma in each direction.

    Attributes:
        shared_m: Shift that is the same from everywhere: of the calibration.
        shared_rad: Turn likewise.
        view_m: Shift that is drawn anew with each arrival: play, encoders, a tripod's placing.
        view_rad: Turn likewise.
    """

    shared_m: NonNegative
    shared_rad: NonNegative
    view_m: NonNegative
    view_rad: NonNegative

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of a small motion of the camera in its own coordinates, `(6, 6)`, m and rad."""
        shift, turn = np.hypot(self.shared_m, self.view_m), np.hypot(self.shared_rad, self.view_rad)
        return np.diag([shift, shift, shift, turn, turn, turn]) ** 2

    def draw(self, generator: np.random.Generator, kind: Literal["shared", "view"]) -> np.ndarray:
        """Return a small motion of the camera in its own coordinates, `(6,)`, m and rad."""
        shift, turn = getattr(self, f"{kind}_m"), getattr(self, f"{kind}_rad")
        return generator.standard_normal(6) * [shift, shift, shift, turn, turn, turn]


@spec
class MountAxis:
    """One driven axis, in the frame of the axis before it.

    Attributes:
        kind: `hinge` turns about it, `slide` moves along it.
        axis: Unit vector.
        origin_m: Origin of the axis.
        lower: Lowest position, rad or m.
        upper: Highest.
        start: First.
        max_speed: Rad/s or m/s.
        num_views: Positions between which is chosen, spread evenly.
    """

    kind: Literal["hinge", "slide"]
    axis: tuple[float, float, float]
    origin_m: tuple[float, float, float]
    lower: float
    upper: float
    start: float
    max_speed: Positive
    num_views: Count

    def check(self) -> None:
        if abs(float(np.linalg.norm(self.axis)) - 1.0) > 1e-6:
            raise ConfigError(f"axis: {self.axis} is not a unit vector")
        if not self.lower <= self.start <= self.upper or self.lower == self.upper:
            raise ConfigError(
                "start: expected lower <= start <= upper and lower below upper, got "
                f"{self.lower}, {self.start} and {self.upper}"
            )

    def step(self, position: np.ndarray) -> np.ndarray:
        """Return the motion of the axis at positions, `(…,)`, as `(…, 4, 4)`."""
        found = np.zeros((*position.shape, 4, 4))
        found[...] = np.eye(4)
        found[..., :3, 3] = self.origin_m
        if self.kind == "slide":
            found[..., :3, 3] += position[..., None] * np.array(self.axis)
        else:
            found[..., :3, :3] = rotate_about_axis(np.array(self.axis), position)
        return found


@spec
class AxesMount:
    """Carry the camera on driven axes, on the base or on a link of the machine.

    Without axes it is fixed.

    Attributes:
        link: `base`, or the joint of the machine whose link carries it.
        axes: Axes by name, from the link to the camera.
        position_m: Camera in the frame of the last axis.
        yaw_rad: Its turn about that frame's z axis.
        pitch_rad: How far it looks down there.
        settle_s: Time after a motion until pictures are sharp.
        error: Error of the believed pose.
    """

    link: str
    axes: dict[str, MountAxis]
    position_m: tuple[float, float, float]
    yaw_rad: float
    pitch_rad: float
    settle_s: NonNegative
    error: MountError

    def build(self, machine: Machine) -> CameraMount:
        """Return the mount on a machine."""
        if self.link != BASE:
            compute_link_pose(machine, machine.home, self.link)  # refuses an unknown link
        return CameraMount(self, machine)


class CameraMount:
    """Mount of a machine, with the settings `AxesMount`.

    Attributes:
        error: Error of the camera's believed pose.
        start: First position, `(A,)`.
        views: Positions between which is chosen, `(V, A)`, at least one.
    """

    def __init__(self, settings: AxesMount, machine: Machine) -> None:
        self._settings, self._machine = settings, machine
        self._axes = tuple(settings.axes.values())
        self._camera = build_camera_pose(settings.position_m, settings.yaw_rad, settings.pitch_rad)
        self.error = settings.error
        self.start = np.array([axis.start for axis in self._axes])
        grids = []
        for axis in self._axes:
            grids.append(np.linspace(axis.lower, axis.upper, axis.num_views))
        views = list(itertools.product(*grids))
        self.views = np.array(views, float).reshape(len(views), len(self._axes))

    def locate(self, position: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the camera's pose in the base frame, `(…, 4, 4)`.

        Args:
            position: Positions, `(…, A)`.
            q: Joint positions of the machine, `(…, J)`.
        """
        pose = np.eye(4)
        if self._settings.link != BASE:
            pose = compute_link_pose(self._machine, q, self._settings.link)
        for number, axis in enumerate(self._axes):
            pose = pose @ axis.step(np.asarray(position, float)[..., number])
        return pose @ self._camera

    def compute_travel_s(self, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the time from `start`, `(A,)`, to each of `goals`, `(V, A)`; the slowest axis counts."""
        if not self._axes:
            return np.zeros(len(goals))
        speed = np.array([axis.max_speed for axis in self._axes])
        way_s = (np.abs(goals - start) / speed).max(-1)
        return np.where(way_s > 0, way_s + self._settings.settle_s, 0.0)

    def describe(self, position: np.ndarray) -> str:
        """Return a position in words."""
        if not self._axes:
            return "fixed" if self._settings.link == BASE else f"on {self._settings.link}"
        parts = []
        for name, axis, value in zip(self._settings.axes, self._axes, position, strict=True):
            parts.append(f"{name} {value:.2f} {'rad' if axis.kind == 'hinge' else 'm'}")
        return ", ".join(parts)


NUM_RIM_POINTS = 16
"""Points of a rim: a part of it is then known to 6 %."""


class Capsules(NamedTuple):
    """Rods with round ends.

    Attributes:
        start_m: One end of each axis, `(…, K, 3)`.
        end_m: The other.
        radius_m: Radii, `(K,)`.
    """

    start_m: np.ndarray
    end_m: np.ndarray
    radius_m: np.ndarray


@spec
class ArmShape:
    """Thickness of the arm, as pictures and the choice of a view take it.

    Attributes:
        link_m: Radius of the links and of the hammer.
        tool_m: Radius of the chisel.
        chisel_m: Length of the chisel that stands out of the hammer.
    """

    link_m: float
    tool_m: float
    chisel_m: float

    def trace(self, machine: Machine, q: np.ndarray) -> np.ndarray:
        """Return the joints in order, the end of the hammer and the tip, `(…, J + 2, 3)`."""
        arm = compute_tool_kinematics(machine, q)
        hammer_m = arm.tip_in_base_m - self.chisel_m * arm.axis_in_base
        ends_m = np.stack([hammer_m, arm.tip_in_base_m], -2)
        return np.concatenate([arm.joints_in_base_m, ends_m], -2)

    def cover(self, machine: Machine, q: np.ndarray) -> Capsules:
        """Return the arm at `q`, `(…, J)`, as capsules."""
        chain_m = self.trace(machine, q)
        radius_m = np.full(chain_m.shape[-2] - 1, self.link_m)
        radius_m[-1] = self.tool_m
        return Capsules(chain_m[..., :-1, :], chain_m[..., 1:, :], radius_m)


def sample_circle(center_m: np.ndarray, axis: np.ndarray, radius_m: float) -> np.ndarray:
    """Return points on a circle, `(P, 3)`."""
    first, second = span_plane(axis)
    angle = np.linspace(0.0, 2.0 * np.pi, NUM_RIM_POINTS, endpoint=False)[:, None]
    across = np.cos(angle) * first + np.sin(angle) * second
    return center_m + radius_m * across


def compute_visible_share(
    camera_m: np.ndarray, rim_m: np.ndarray, capsules: Capsules
) -> np.ndarray:
    """Return the part of a rim that capsules leave in sight, `(…,)`.

    Args:
        camera_m: Centres of projection, `(…, 3)`.
        rim_m: Points of the rim, `(P, 3)`.
        capsules: What hides it; leading axes broadcast with those of `camera_m`.
    """
    camera = np.asarray(camera_m)[..., None, None, :]
    start_m, end_m = capsules.start_m[..., None, :, :], capsules.end_m[..., None, :, :]
    distance_m = _measure_distance(camera, rim_m[:, None] - camera, start_m, end_m - start_m)
    return (distance_m > capsules.radius_m).all(-1).mean(-1)


def _measure_distance(p: np.ndarray, u: np.ndarray, r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the distance of segments p to p + u from segments r to r + v, `(…,)`.

    Ericson, Real-Time Collision Detection, section 5.1.9.
    """
    w = p - r
    a, b, e = (u * u).sum(-1), (u * v).sum(-1), np.maximum((v * v).sum(-1), 1e-12)
    c, f = (u * w).sum(-1), (v * w).sum(-1)
    denominator = np.maximum(a * e - b * b, 1e-12)
    s = np.clip((b * f - c * e) / denominator, 0.0, 1.0)
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, 1e-12), 0.0, 1.0)
    return np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)


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
