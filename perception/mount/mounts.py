"""Camera mounts: fixed, or on driven axes on the base or a link of the machine.

A mount has a position, `(A,)`: one number for each axis. `locate` turns it into the camera's pose.
Frames of machine and mount have x forward, y left and z up; the camera's own follow the optical
convention.

Axes: `A` numbers of a position, `V` views, `J` joints; anything may stand before `A` and `J`.
"""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_link_pose, rotate_about_axis
from brokk_rl.machine import Machine
from brokk_rl.spec import Count, NonNegative, Positive, spec
from perception.render.stereo_camera import build_camera_pose

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
