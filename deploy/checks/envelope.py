"""Envelope of the arm: distance to ground, undercarriage and stay-out boxes, and speed at the face.

Pure: numpy, no file, no clock. The shapes come from `deploy.checks.shapes` once at start.

A command takes effect after the dead time, so the guard looks ahead to where the arm comes to rest
(`deploy.kernel.under_way`). A command is withheld where it brings any part of the arm, at that place
of rest, nearer to any obstacle than `margin_m`. One that leads away from all of them passes, so that
nobody is caught; inside an obstacle only such commands pass. Near the work surface all joints are
slowed alike, and everywhere while the camera does not see that surface.

Axes: `B` poses, `C` capsules, `K` boxes, `P` pairs of both, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.kinematics import LinkChain
from brokk_rl.machine import Machine
from deploy.checks.shapes import BASE, MachineShapes, RoundedBox
from deploy.kernel.limits import EnvelopeLimits, Numbers

APART = 2
"""Difference of link numbers from which two links are checked; neighbours always touch."""
NUM_PLACES = 5
"""Places on the way to rest at which the speed of the tip is computed. Chosen by hand: at 1 m/s
they are 0.2 m apart, as wide as the zone at the work surface."""
WIDE_M = 1e3
"""Half width of the ground."""
ROUNDING_M = 1e-9
"""Rounding error of a distance that does not change."""


class Envelope:
    """Commands limited by the distance of the arm to obstacles and to the work surface.

    Args:
        limits: Distances and speeds.
        machine: Chain, speeds, limits and dead time.
        shapes: Of the machine.
        speed_margin: Speed over the machine's fastest that the look ahead assumes.
        reaction_s: Time for which a command acts before it can be taken back.
    """

    def __init__(
        self,
        limits: EnvelopeLimits,
        machine: Machine,
        shapes: MachineShapes,
        speed_margin: float,
        reaction_s: float,
    ) -> None:
        self._speed, self._reaction_s = machine.max_speed * speed_margin, reaction_s
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
        self._held = False

    def limit_command(
        self,
        u: Numbers,
        q: Numbers,
        under_way_s: Numbers,
        faces_in_base_m: Sequence[Numbers] | None,
        is_seen: bool,
    ) -> tuple[Numbers, bool]:
        """Return the command within the envelope, and whether it was withheld.

        Args:
            u: Command, `(J,)`.
            q: Joint positions, `(J,)`.
            under_way_s: Time integral of the commands that have not acted yet, `(J,)`.
            faces_in_base_m: Points of the work surface; `None` where the command has no borehole.
            is_seen: Whether the camera sees that surface.
        """
        if not any(u):
            self._held = False
            return u, False
        wanted, at = np.array(u), np.array(q)
        rest = at + self._speed * np.array(under_way_s)
        further = rest + self._speed * wanted * self._reaction_s
        poses = np.clip(np.stack([rest, further]), self._lower, self._upper)
        margin_m = self._limits.margin_m + (self._limits.release_m if self._held else 0.0)
        before_m, after_m = self._measure_pairs(poses, margin_m)
        self._held = bool(((after_m < margin_m) & (after_m < before_m - ROUNDING_M)).any())
        if self._held:
            return (0.0,) * len(u), True
        if faces_in_base_m is None:
            return u, False
        slowdown = self._find_slowdown(wanted, at, poses[0], faces_in_base_m if is_seen else ())
        return tuple((wanted * slowdown).tolist()), False

    def _measure_pairs(self, q: np.ndarray, near_m: float) -> np.ndarray:
        """Return the distances of the pairs that may be nearer than `near_m`, `(B, P)`, in m.

        A pair whose enclosing balls are further apart in all poses is left out.
        """
        rotation, at_m = self._place_links(q)
        turn, place_m = rotation[:, self._arm], at_m[:, self._arm]
        ends_m = np.einsum("bcij,cej->bcei", turn, self._ends_m) + place_m[:, :, None]
        held = rotation[:, self._fixed]
        frames = held @ self._rotations
        centers_m = np.einsum("bkij,kj->bki", held, self._centers_m) + at_m[:, self._fixed]
        apart_m = ends_m[:, self._capsule] - centers_m[:, self._box, None]
        bound_m = np.linalg.norm(apart_m.mean(2), axis=-1) - self._ball_m
        near = (bound_m <= near_m).any(0)
        local_m = np.einsum("bpei,bpij->bpej", apart_m[:, near], frames[:, self._box[near]])
        distance_m = measure_segment_to_box(local_m[:, :, 0], local_m[:, :, 1], self._half_m[near])
        return distance_m - self._radius_m[near]

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

    def _find_slowdown(
        self, u: np.ndarray, q: np.ndarray, rest: np.ndarray, faces_in_base_m: Sequence[Numbers]
    ) -> float:
        """Return the factor, at most 1, that keeps the tip's speed near the work surface.

        Without a point of that surface it may be anywhere.
        """
        limits = self._limits
        # The command acts somewhere between here and the place of rest.
        way = q + np.linspace(0.0, 1.0, NUM_PLACES)[:, None] * (rest - q)
        step = self._max_speed * u * self._reaction_s / 2
        tips_m = self.locate_tip(np.concatenate([way, way - step, way + step]))
        tips_m, back_m, on_m = tips_m.reshape(3, NUM_PLACES, 3)
        if faces_in_base_m and not any(self._is_near(tips_m, one) for one in faces_in_base_m):
            return 1.0
        speed_m_s = float(np.linalg.norm(on_m - back_m, axis=1).max()) / self._reaction_s
        return limits.face_speed_m_s / max(speed_m_s, limits.face_speed_m_s)

    def _is_near(self, tips_m: np.ndarray, face_in_base_m: Numbers) -> bool:
        """Return whether the tip comes near the work surface around a point of it.

        Args:
            tips_m: The tip on its way to rest, `(N, 3)`.
            face_in_base_m: The point, `(3,)`.
        """
        limits = self._limits
        normal, off_m = np.array(limits.face_normal), tips_m - np.array(face_in_base_m)
        height_m = off_m @ normal
        aside_m = np.linalg.norm(off_m - height_m[:, None] * normal, axis=1)
        near = (np.abs(height_m) <= limits.face_near_m) & (aside_m <= limits.face_radius_m)
        # A fast arm passes the surface between two places.
        passes = (height_m[1:] * height_m[:-1] < 0) & (aside_m[1:] <= limits.face_radius_m)
        return bool(near.any() or passes.any())


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
        Distances, `(…,)`; negative where a segment is inside, by how deep it lies (`measure_depth`).
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
    distance = np.linalg.norm(nearest - nearest.clip(-half_m, half_m), axis=-1)
    inside = distance == 0.0
    if inside.any():
        half_m = np.broadcast_to(half_m, begin_m.shape)
        depth_m = measure_depth(begin_m[inside], end_m[inside], half_m[inside])
        distance[inside] = -depth_m
    return distance


def measure_depth(begin_m: np.ndarray, end_m: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """Return how deep segments lie in boxes around the origin: the way out of their deepest point.

    The depth of a point is the least of six functions that are linear along the segment. The
    largest depth is at an end of the segment, or where two of these functions cross.

    Args:
        begin_m: Beginnings, `(K, 3)`.
        end_m: Ends, `(K, 3)`.
        half_m: Half lengths of the boxes, `(K, 3)`.

    Returns:
        Depths, `(K,)`; 0 where a segment does not enter.
    """
    along = end_m - begin_m
    offset = np.concatenate([half_m - begin_m, half_m + begin_m], -1)
    slope = np.concatenate([-along, along], -1)
    first, second = np.triu_indices(6, 1)
    steeper = slope[:, second] - slope[:, first]
    apart = offset[:, first] - offset[:, second]
    t = np.divide(apart, steeper, out=np.zeros_like(apart), where=steeper != 0.0).clip(0.0, 1.0)
    ends = np.tile([0.0, 1.0], (len(t), 1))
    t = np.concatenate([t, ends], -1)[:, :, None]
    depth_m = (offset[:, None] + t * slope[:, None]).min(-1).max(-1)
    return depth_m.clip(0.0)


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
