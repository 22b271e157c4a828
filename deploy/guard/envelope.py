"""Envelope of the arm: distance to ground, undercarriage and stay-out boxes, and speed at the face.

Pure: numpy, no file, no clock. The shapes come from `deploy.guard.shapes` once at start.

A command takes effect after the dead time, so the guard looks ahead to where the arm comes to rest:
commands of the last `dead_time + coast_s` are still under way. A command is withheld where it
brings that place of rest nearer to an obstacle than `margin_m`. A command that leads away passes,
so that nobody is caught. Near the work surface all joints are slowed alike.

Axes: `B` poses, `C` capsules, `K` boxes, `P` pairs of both, `J` joints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from brokk_rl.kinematics import LinkChain
from brokk_rl.machine import Machine
from deploy.guard.limits import EnvelopeLimits, Numbers
from deploy.guard.shapes import BASE, MachineShapes, RoundedBox

APART = 2
"""Difference of link numbers from which two links are checked; neighbours always touch."""
NUM_PLACES = 5
"""Places on the way to rest at which the speed of the tip is computed. Chosen by hand: at 1 m/s
they are 0.2 m apart, as wide as the zone at the work surface."""
WIDE_M = 1e3
"""Half width of the ground."""


class Envelope:
    """Commands limited by the distance of the arm to obstacles and to the work surface.

    Args:
        limits: Distances and speeds.
        machine: Chain, speeds, limits and dead time.
        shapes: Of the machine.
    """

    def __init__(self, limits: EnvelopeLimits, machine: Machine, shapes: MachineShapes) -> None:
        self._limits, self._chain = limits, LinkChain(machine.joints)
        self._tip_m, self._max_speed = machine.tip_m, machine.max_speed
        self._lower, self._upper = machine.lower, machine.upper
        boxes = [*shapes.body, *_build_obstacles(limits)]
        pairs = []
        for c, capsule in enumerate(shapes.arm):
            for k, box in enumerate(boxes):
                if capsule.link - box.link >= APART:
                    pairs.append((c, k))
        self._capsule, self._box = np.array(pairs, int).reshape(-1, 2).T
        self._arm = [capsule.link + 1 for capsule in shapes.arm]
        self._ends_m = np.array([[one.begin_m, one.end_m] for one in shapes.arm]).reshape(-1, 2, 3)
        self._fixed = [box.link + 1 for box in boxes]
        self._centers_m = np.array([box.center_m for box in boxes]).reshape(-1, 3)
        self._rotations = np.array([box.rotation for box in boxes]).reshape(-1, 3, 3)
        self._half_m = np.array([box.half_m for box in boxes]).reshape(-1, 3)[self._box]
        arm_m = np.array([one.radius_m for one in shapes.arm])[self._capsule]
        self._radius_m = arm_m + np.array([box.radius_m for box in boxes])[self._box]
        length_m = np.linalg.norm(self._ends_m[:, 1] - self._ends_m[:, 0], axis=1)
        self._ball_m = length_m[self._capsule] / 2 + self._radius_m
        self._ball_m = self._ball_m + np.linalg.norm(self._half_m, axis=1)
        self._horizon_s = machine.dead_time_s + limits.coast_s
        self._sent: deque[tuple[float, np.ndarray]] = deque()
        self._held = False

    def limit_command(
        self, now_s: float, u: Numbers, q: Numbers, face_in_base_m: Numbers | None
    ) -> tuple[Numbers, bool]:
        """Return the command within the envelope, and whether it was withheld.

        Args:
            now_s: Time of the cycle.
            u: Command, `(J,)`.
            q: Joint positions, `(J,)`.
            face_in_base_m: A point of the work surface; `None` where none is known.
        """
        if not any(u):
            self._held = False
            return u, False
        wanted, at = np.array(u), np.array(q)
        under_way = self._integrate_sent(now_s)
        speed = self._max_speed * self._limits.speed_margin
        rest = at + speed * under_way
        further = rest + speed * wanted * self._limits.reaction_s
        poses = np.clip(np.stack([rest, further]), self._lower, self._upper)
        margin_m = self._limits.margin_m + (self._limits.release_m if self._held else 0.0)
        before_m, after_m = self.measure_clearance(poses, margin_m)
        self._held = bool(after_m < margin_m and after_m < before_m)
        if self._held:
            return (0.0,) * len(u), True
        return tuple(
            (wanted * self._find_slowdown(wanted, at, poses[0], face_in_base_m)).tolist()
        ), False

    def note_sent(self, now_s: float, u: Numbers) -> None:
        """Remember the command that is sent from now on."""
        self._sent.append((now_s, np.array(u)))
        # The oldest one that is kept began before the horizon and lasts into it.
        while len(self._sent) > 1 and self._sent[1][0] <= now_s - self._horizon_s:
            self._sent.popleft()

    def measure_clearance(self, q: np.ndarray, near_m: float = np.inf) -> np.ndarray:
        """Return the distance between arm and obstacles, `(B,)`, in m.

        Infinite without obstacles. Negative where shapes overlap by less than their radii; a
        deeper overlap counts as minus the radii.

        Args:
            q: Joint positions, `(B, J)`.
            near_m: Distance above which a lower bound will do: only pairs whose enclosing balls
                are nearer are computed.
        """
        if not len(self._capsule):
            return np.full(len(q), np.inf)
        rotation, at_m = self._place_links(q)
        turn, place_m = rotation[:, self._arm], at_m[:, self._arm]
        ends_m = np.einsum("bcij,cej->bcei", turn, self._ends_m) + place_m[:, :, None]
        held = rotation[:, self._fixed]
        frames = held @ self._rotations
        centers_m = np.einsum("bkij,kj->bki", held, self._centers_m) + at_m[:, self._fixed]
        apart_m = ends_m[:, self._capsule] - centers_m[:, self._box, None]
        bound_m = np.linalg.norm(apart_m.mean(2), axis=-1) - self._ball_m
        near = (bound_m <= near_m).any(0)
        if not near.any():
            return bound_m.min(1)
        local_m = np.einsum("bpei,bpij->bpej", apart_m[:, near], frames[:, self._box[near]])
        half_m = self._half_m[near]
        distance_m = measure_segment_to_box(local_m[:, :, 0], local_m[:, :, 1], half_m)
        nearest_m = (distance_m - self._radius_m[near]).min(1)
        return np.minimum(nearest_m, bound_m[:, ~near].min(1, initial=np.inf))

    def locate_tip(self, q: np.ndarray) -> np.ndarray:
        """Return the tip of the tool in the base frame for `q`, `(B, J)`: `(B, 3)`."""
        rotation, at_m = self._place_links(q)
        return at_m[:, -1] + rotation[:, -1] @ self._tip_m

    def _place_links(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations and origins of base and links, `(B, 1 + J, 3, 3)` and `(B, 1 + J, 3)`."""
        links = self._chain.place(q)
        base = np.broadcast_to(np.eye(3), (len(q), 1, 3, 3))
        rotation = np.concatenate((base, links.rotation), 1)
        return rotation, np.concatenate((np.zeros((len(q), 1, 3)), links.place_m), 1)

    def _integrate_sent(self, now_s: float) -> np.ndarray:
        """Return the time integral of the commands that are still under way, `(J,)`, in s."""
        total, end_s = np.zeros(len(self._lower)), now_s
        for begin_s, u in reversed(self._sent):
            begin_s = max(begin_s, now_s - self._horizon_s)
            total += u * (end_s - begin_s)
            end_s = begin_s
        return total

    def _find_slowdown(
        self, u: np.ndarray, q: np.ndarray, rest: np.ndarray, face_in_base_m: Numbers | None
    ) -> float:
        """Return the factor, at most 1, that keeps the tip's speed near the work surface."""
        limits = self._limits
        if face_in_base_m is None:
            return 1.0
        # The command acts somewhere between here and the place of rest.
        way = q + np.linspace(0.0, 1.0, NUM_PLACES)[:, None] * (rest - q)
        step = self._max_speed * u * limits.reaction_s / 2
        tips_m = self.locate_tip(np.concatenate([way, way - step, way + step]))
        tips_m, back_m, on_m = tips_m.reshape(3, NUM_PLACES, 3)
        normal, off_m = np.array(limits.face_normal), tips_m - np.array(face_in_base_m)
        height_m = off_m @ normal
        aside_m = np.linalg.norm(off_m - height_m[:, None] * normal, axis=1)
        near = (np.abs(height_m) <= limits.face_near_m) & (aside_m <= limits.face_radius_m)
        # A fast arm passes the surface between two places.
        passes = (height_m[1:] * height_m[:-1] < 0) & (aside_m[1:] <= limits.face_radius_m)
        if not near.any() and not passes.any():
            return 1.0
        speed_m_s = float(np.linalg.norm(on_m - back_m, axis=1).max()) / limits.reaction_s
        return limits.face_speed_m_s / max(speed_m_s, limits.face_speed_m_s)


def measure_segment_to_box(
    begin_m: np.ndarray, end_m: np.ndarray, half_m: np.ndarray
) -> np.ndarray:
    """Return the distance of segments to boxes around the origin, along the axes.

    The squared distance along a segment is convex and piecewise quadratic; its slope is piecewise
    linear with corners where the segment passes a side of the box. The root of the slope is exact.

    Args:
        begin_m: Beginnings, `(…, 3)`.
        end_m: Ends, `(…, 3)`.
        half_m: Half lengths of the boxes, `(…, 3)`.

    Returns:
        Distances, `(…,)`; 0 where they touch.
    """
    along = end_m - begin_m
    safe = np.where(along == 0.0, 1.0, along)
    corners = np.concatenate([(half_m - begin_m) / safe, (-half_m - begin_m) / safe], -1)
    # A segment along a side never passes it.
    corners = np.where(np.concatenate([along, along], -1) == 0.0, 0.0, corners.clip(0.0, 1.0))
    ends = np.zeros((*corners.shape[:-1], 1))
    t = np.sort(np.concatenate([ends, corners, ends + 1.0], -1), -1)
    points = begin_m[..., None, :] + t[..., None] * along[..., None, :]
    beyond = points - points.clip(-half_m[..., None, :], half_m[..., None, :])
    slope = (beyond * along[..., None, :]).sum(-1)
    # The slope only grows: the least distance lies between its last negative corner and the next.
    last = ((slope < 0.0).sum(-1, keepdims=True) - 1).clip(0, t.shape[-1] - 2)
    low, high = np.take_along_axis(slope, last, -1), np.take_along_axis(slope, last + 1, -1)
    part = np.where(high > low, -low / np.where(high > low, high - low, 1.0), 0.0).clip(0.0, 1.0)
    first, second = np.take_along_axis(t, last, -1), np.take_along_axis(t, last + 1, -1)
    nearest = begin_m + (first + part * (second - first)) * along
    return np.linalg.norm(nearest - nearest.clip(-half_m, half_m), axis=-1)


def _build_obstacles(limits: EnvelopeLimits) -> Sequence[RoundedBox]:
    """Return ground and stay-out boxes in the base frame."""
    found = []
    if limits.ground_m is not None:
        lower = (-WIDE_M, -WIDE_M, limits.ground_m - 2.0 * WIDE_M)
        found.append((lower, (WIDE_M, WIDE_M, limits.ground_m)))
    found += [(box.lower_m, box.upper_m) for box in limits.stay_out.values()]
    boxes = []
    for lower, upper in found:
        low, high = np.array(lower), np.array(upper)
        boxes.append(RoundedBox(BASE, (low + high) / 2, np.eye(3), (high - low) / 2, 0.0))
    return boxes
