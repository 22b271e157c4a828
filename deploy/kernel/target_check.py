"""Limits of the borehole that commands are made for. Pure.

A borehole beyond the arm's reach or the slew's limits, below the ground, too old, off the face that
the camera sees, or one that has just jumped is none: no command is sent for it, and the reason is
said. A new borehole counts once it has stayed where it is for `settle_s`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from deploy.kernel.guard import GuardTrip
from deploy.kernel.limits import Numbers, TargetLimits


@dataclass(frozen=True)
class SeenTarget:
    """The chosen borehole, and what the camera sees now.

    Attributes:
        center_in_base_m: Centre of its rim, `(3,)`.
        age_s: Since it was found.
        seen_in_base_m: Centres of the boreholes that the camera sees now, each a point of the face.
    """

    center_in_base_m: Numbers
    age_s: float
    seen_in_base_m: tuple[Numbers, ...]


class TargetCheck:
    """Check of the chosen borehole.

    Args:
        limits: See there.
        machine: Reach and slew.
        ground_m: Height of the ground in the base frame; `None` where it is not known.
        normal: Normal of the work surface, `(3,)`.
    """

    def __init__(
        self, limits: TargetLimits, machine: Machine, ground_m: float | None, normal: Numbers
    ) -> None:
        self._limits, self._ground_m, self._normal = limits, ground_m, np.array(normal)
        self._machine = machine
        self._root_m, self._reach_m = np.zeros(3), math.inf
        self._slew: tuple[float, float] | None = None
        if machine.has_bodies:
            origins_m = [np.array([one.value for one in body.origin_m]) for body in machine.bodies]
            lengths_m = [float(np.linalg.norm(one)) for one in (*origins_m[1:], machine.tip_m)]
            self._root_m, self._reach_m = origins_m[0], sum(lengths_m)
            first = machine.joints[0]
            if first.kind == "hinge" and tuple(machine.bodies[0].axis) == (0.0, 0.0, 1.0):
                self._slew = float(machine.lower[0]), float(machine.upper[0])
        self._anchor_m, self._since_s = np.full(3, math.nan), math.inf

    def check(self, now_s: float, target: SeenTarget) -> GuardTrip:
        """Return the fault of a borehole, `GuardTrip.NONE` for none."""
        limits, center_m = self._limits, np.array(target.center_in_base_m)
        if not np.isfinite(center_m).all():
            return GuardTrip.TARGET_INVALID
        # NaN, of no borehole before this one, fails the comparison.
        if not np.linalg.norm(center_m - self._anchor_m) <= limits.jump_m:
            self._anchor_m, self._since_s = center_m, now_s
        off_m = center_m - self._root_m
        yaw = math.atan2(off_m[1], off_m[0])
        slew = self._slew
        checks = (
            (abs(target.age_s) <= limits.age_s, GuardTrip.TARGET_OLD),
            (float(np.linalg.norm(off_m)) <= self._reach_m, GuardTrip.TARGET_REACH),
            (slew is None or slew[0] <= yaw <= slew[1], GuardTrip.TARGET_REACH),
            (self._ground_m is None or center_m[2] >= self._ground_m, GuardTrip.TARGET_GROUND),
            (self._is_on_face(center_m, target.seen_in_base_m), GuardTrip.TARGET_FACE),
            (now_s - self._since_s >= limits.settle_s, GuardTrip.TARGET_JUMPS),
        )
        return next((trip for fine, trip in checks if not fine), GuardTrip.NONE)

    def may_touch(self, q: np.ndarray, target: SeenTarget | None) -> bool:
        """Return whether the chisel, at joint positions `(J,)`, may touch the borehole."""
        if target is None or not self._machine.has_bodies:
            return False
        tip_m = compute_tool_kinematics(self._machine, q).tip_in_base_m
        height_m, aside_m = self._measure_from(target.center_in_base_m, tip_m)
        return max(height_m, aside_m) <= self._limits.contact_m

    def _measure_from(self, point_m: Numbers, place_m: np.ndarray) -> tuple[float, float]:
        """Return the height of a place over the face at a point, and its distance along the face."""
        off_m = place_m - np.array(point_m)
        height_m = float(off_m @ self._normal)
        return height_m, float(np.linalg.norm(off_m - height_m * self._normal))

    def _is_on_face(self, center_m: np.ndarray, seen_m: Sequence[Numbers]) -> bool:
        """Return whether a borehole lies on the face of those seen around it."""
        for point_m in seen_m:
            height_m, aside_m = self._measure_from(point_m, center_m)
            if aside_m <= self._limits.face_radius_m and abs(height_m) > self._limits.face_step_m:
                return False
        return True
