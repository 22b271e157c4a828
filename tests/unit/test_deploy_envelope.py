"""Envelope of the arm: distances against MuJoCo's own, and what the guard does with them."""

from __future__ import annotations

import itertools
import json
import math
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from composed import MACHINE, option

import brokk_rl.sim
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from brokk_rl.sim import shapes
from brokk_rl.sim.shapes import describe_shapes
from deploy import guard_setup
from deploy.checks.envelope import Envelope, measure_segment_to_box
from deploy.checks.shapes import MachineShapes, read_machine_shapes
from deploy.kernel.limits import EnvelopeLimits, Numbers, StayOutBox
from deploy.kernel.under_way import CommandsUnderWay

GUARD = option("guard", "default")
LIMITS = GUARD.envelope
SHIPPED = resolve_package_path(LIMITS.shapes)
SHAPES = read_machine_shapes(SHIPPED, MACHINE)
assert SHAPES is not None
MJCF = Path(brokk_rl.sim.__file__).parent / "assets" / "brokk170.xml"
BODIES = ("undercarriage", *(f"{name}_link" for name in MACHINE.joint_names))
WALL = StayOutBox(lower_m=(1.0, 1.4, 0.2), upper_m=(4.0, 1.6, 2.5))
HOME = np.array(MACHINE.home)
STILL = (0.0,) * 5
DT_S = 0.025
SPEED = np.array([joint.max_speed.value for joint in MACHINE.joints])


def measure_clearance(envelope: Envelope, q: np.ndarray) -> np.ndarray:
    """Return the distance between arm and obstacles, `(B,)`, in m."""
    return envelope._measure_pairs(q, np.inf).min(1, initial=np.inf)


def build_envelope(**change: object) -> Envelope:
    return make_envelope(replace(LIMITS, **change), SHAPES)


def make_envelope(
    limits: EnvelopeLimits, shapes: MachineShapes, machine: Machine = MACHINE
) -> Envelope:
    return Envelope(limits, machine, shapes, GUARD.speed_margin, GUARD.reaction_s)


def limit(envelope: Envelope, u: Numbers, q: np.ndarray, face: Numbers | None = None) -> Any:
    """The command within the envelope for an arm at rest."""
    faces = None if face is None else (face,)
    return envelope.limit_command(u, tuple(q), STILL, faces, is_seen=True)


def draw_poses(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(MACHINE.lower, MACHINE.upper, (count, 5))


def find_distance_m(
    model: mujoco.MjModel, q: np.ndarray, arm: list[int], other: list[int]
) -> float:
    """Least distance of two sets of geoms, link by link as the envelope checks them."""
    data = mujoco.MjData(model)
    data.qpos[:5] = q
    mujoco.mj_kinematics(model, data)
    link = {model.body(name).id: number - 1 for number, name in enumerate(BODIES)} | {0: -1}
    least = math.inf
    for a in arm:
        for b in other:
            if link[int(model.geom_bodyid[a])] - link[int(model.geom_bodyid[b])] >= 2:
                least = min(least, mujoco.mj_geomDistance(model, data, a, b, 20.0, None))
    return least


def read_spec() -> mujoco.MjSpec:
    """The MJCF with the axes of the machine's file; it holds none of its own."""
    spec = mujoco.MjSpec.from_file(str(MJCF))
    for joint in MACHINE.joints:
        spec.joint(joint.name).axis = joint.body.axis
    return spec


def add_ground_and_wall(spec: mujoco.MjSpec) -> None:
    lower, upper = np.array(WALL.lower_m), np.array(WALL.upper_m)
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(name="ground", type=box, size=[30, 30, 5], pos=[0, 0, -5])
    size, middle = (upper - lower) / 2, (lower + upper) / 2
    spec.worldbody.add_geom(name="wall", type=box, size=size, pos=middle)


def build_own_model() -> tuple[mujoco.MjModel, list[int], list[int]]:
    """The envelope's own shapes as a MuJoCo model, its arm and its obstacles."""
    spec = read_spec()
    for geom in list(spec.geoms):
        spec.delete(geom)
    add_ground_and_wall(spec)
    kinds = mujoco.mjtGeom
    for number, one in enumerate(SHAPES.arm):
        body = spec.body(BODIES[one.link + 1])
        place = {"size": [one.radius_m, 0, 0], "fromto": [*one.begin_m, *one.end_m]}
        body.add_geom(name=f"arm{number}", type=kinds.mjGEOM_CAPSULE, **place)
    for number, one in enumerate(SHAPES.body):
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, one.rotation.flatten())
        values = {"name": f"body{number}", "pos": one.center_m, "quat": quat}
        if one.radius_m:
            size, kind = [one.radius_m, one.half_m[2], 0], kinds.mjGEOM_CAPSULE
            if not one.half_m.any():
                size, kind = [one.radius_m, 0, 0], kinds.mjGEOM_SPHERE
        else:
            size, kind = one.half_m, kinds.mjGEOM_BOX
        spec.body(BODIES[one.link + 1]).add_geom(type=kind, size=size, **values)
    model = spec.compile()
    names = [model.geom(number).name for number in range(model.ngeom)]
    arm = [number for number, name in enumerate(names) if name.startswith("arm")]
    return model, arm, [number for number in range(model.ngeom) if number not in arm]


def test_distances_are_those_of_mujoco() -> None:
    model, arm, other = build_own_model()
    envelope = build_envelope(stay_out={"wall": WALL})
    poses = draw_poses(40)
    found = measure_clearance(envelope, poses)
    expected = np.array([find_distance_m(model, q, arm, other) for q in poses])
    clear = expected > 1e-3
    assert clear.sum() >= 15 and (~clear).sum() >= 5
    assert found[clear] == pytest.approx(expected[clear], abs=2e-5)
    assert (found[~clear] < 1.1e-3).all() and found[~clear].min() < -0.1


def test_shapes_enclose_what_mujoco_draws_and_little_more() -> None:
    spec = read_spec()
    add_ground_and_wall(spec)
    model = spec.compile()
    bodies = model.geom_bodyid.tolist()
    arm = [number for number, body in enumerate(bodies) if body > model.body("q1_link").id]
    other = [number for number in range(model.ngeom) if number not in arm]
    envelope = build_envelope(stay_out={"wall": WALL})
    poses = draw_poses(25, seed=1)
    found = measure_clearance(envelope, poses)
    expected = np.array([find_distance_m(model, q, arm, other) for q in poses])
    assert (found <= expected + 2e-5)[expected > 0.0].all()
    assert (found <= 2e-5)[expected <= 0.0].all()
    # The widest link has its cylinders 0.2 m beside its axis.
    clear = expected > 0.02
    assert clear.sum() >= 8 and (expected[clear] - found[clear]).max() < 0.25


def test_distances_beyond_interest_may_be_left_out_but_no_near_one_is_missed() -> None:
    # Without the undercarriage, near whose turntable the boom always is.
    posts = {}
    for number, (x, y) in enumerate(((1.5, 0.3), (2.0, -0.8), (2.6, 0.9), (1.2, 1.6))):
        low = (x, y, 1.0)
        posts[str(number)] = StayOutBox(lower_m=low, upper_m=(x + 0.05, y + 0.05, 1.05))
    limits = replace(LIMITS, stay_out=posts, ground_m=None)
    envelope = make_envelope(limits, replace(SHAPES, body=()))
    poses = draw_poses(1500, seed=4)
    exact = measure_clearance(envelope, poses)
    for near_m in (0.05, 0.4):
        # One by one, as in a cycle: what is left out depends on the pose.
        each = [envelope._measure_pairs(q[None], near_m) for q in poses[:400]]
        found = np.array([one.min(initial=np.inf) for one in each])
        near = exact[:400] <= near_m
        assert near.sum() > 9 and found[near] == pytest.approx(exact[:400][near], abs=1e-12)
        far = ~near
        assert (found[far] > near_m).all() and np.isinf(found[far]).any()
    nothing = make_envelope(replace(LIMITS, ground_m=None), replace(SHAPES, body=()))
    assert np.isinf(measure_clearance(nothing, poses[:3])).all()


def test_a_fast_arm_that_would_pass_the_surface_is_slowed() -> None:
    envelope = build_envelope(ground_m=None)
    q = np.array([0.0, -0.9, 0.2, 0.9, 0.77])
    rest = q + np.array([0.0, 0.0, 1.2, 0.0, 0.0])
    here, there = envelope.locate_tip(np.stack([q, rest]))
    assert here[2] - there[2] > 1.0
    u = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    way = q + np.linspace(0.0, 1.0, 5)[:, None] * (rest - q)
    heights = envelope.locate_tip(way)[:, 2]
    # Between two of the places, nearer to neither of them than the zone is wide.
    gap = int(np.argmax(-np.diff(heights)))
    middle = (heights[gap] + heights[gap + 1]) / 2
    assert heights[gap] - middle > LIMITS.face_near_m
    tip = envelope.locate_tip(way)[gap]
    assert envelope._find_slowdown(u, q, rest, [(tip[0], tip[1], middle)]) < 0.9
    assert envelope._find_slowdown(u, q, rest, [(tip[0], tip[1] + 3.0, middle)]) == 1.0
    # Beyond the place of rest nothing is slowed.
    below = float(heights.min()) - LIMITS.face_near_m - 0.02
    assert envelope._find_slowdown(u, q, rest, [(there[0], there[1], below)]) == 1.0


def test_the_tip_is_where_mujoco_has_it() -> None:
    model = read_spec().compile()
    data, poses = mujoco.MjData(model), draw_poses(5)
    for q, tip in zip(poses, build_envelope().locate_tip(poses), strict=True):
        data.qpos[:5] = q
        mujoco.mj_kinematics(model, data)
        assert tip == pytest.approx(data.site("tip").xpos, abs=1e-9)


def test_distance_of_a_segment_to_a_box_is_the_least_of_all_its_points() -> None:
    draw = np.random.default_rng(2)
    begin, end = draw.uniform(-2, 2, (2, 300, 3))
    # Along a side, a point, and within the box, too.
    begin[:20, 0] = end[:20, 0]
    begin[20:30] = end[20:30]
    begin[30:40], end[30:40] = 0.1 * begin[30:40], 0.1 * end[30:40]
    half = draw.uniform(0.3, 1.0, (300, 3))
    t = np.linspace(0.0, 1.0, 4001)[:, None, None]
    points = begin + t * (end - begin)
    beyond = np.maximum(np.abs(points) - half, 0.0)
    expected = np.linalg.norm(beyond, axis=-1).min(0)
    found = measure_segment_to_box(begin, end, half)
    assert found.clip(0.0) == pytest.approx(expected, abs=2e-3)
    assert (found <= expected + 1e-9).all()
    assert (found[30:40] < -0.2).all()
    # How deep: the way out of the deepest of all points.
    inside = expected == 0.0
    depth = (half[inside] - np.abs(points[:, inside])).min(-1).max(0)
    assert inside.sum() > 50 and found[inside] == pytest.approx(-depth.clip(0.0), abs=2e-3)


def test_a_command_that_leads_nowhere_is_not_withheld() -> None:
    at = HOME.copy()
    at[0] = MACHINE.upper[0]
    # The ground so high that the arm is always too near.
    clear_m = float(measure_clearance(build_envelope(ground_m=0.7), at[None])[0])
    envelope = build_envelope(ground_m=0.7 + clear_m - LIMITS.margin_m / 2)
    outward = (1.0, 0.0, 0.0, 0.0, 0.0)
    assert 0.0 < measure_clearance(envelope, at[None])[0] < LIMITS.margin_m
    assert limit(envelope, outward, at) == (outward, False)


def list_corners(box: dict[str, Any]) -> np.ndarray:
    """Corners of a box, worked by hand."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners = [box["center_m"] + box["rotation"] @ (one * box["half_m"]) for one in signs]
    return np.array(corners)


@pytest.mark.parametrize("end_m", [(2.0, 0.0, 0.0), (1.0, 0.7, -0.5)])
def test_capsules_enclose_boxes_and_balls(end_m: tuple[float, float, float]) -> None:
    draw = np.random.default_rng(3)
    boxes = []
    for number in range(6):
        rotation = np.linalg.qr(draw.normal(size=(3, 3)))[0]
        radius_m = 0.1 if number % 2 else 0.0
        box = {"link": 1, "rotation": rotation, "radius_m": radius_m}
        box["half_m"] = draw.uniform(0.01, 0.2, 3)
        box["center_m"] = draw.uniform(-0.3, 0.3, 3) + np.array([number, 0, 0])
        boxes.append(box)
    capsules = shapes.fit_capsules(boxes, np.array(end_m))
    assert 1 <= len(capsules) <= 2
    for box in boxes:
        inside, corners_m = [], list_corners(box)
        for one in capsules:
            along = one["end_m"] - one["begin_m"]
            t = ((corners_m - one["begin_m"]) @ along / (along @ along)).clip(0, 1)
            off = np.linalg.norm(corners_m - one["begin_m"] - t[:, None] * along, axis=1)
            inside.append((off + box["radius_m"] <= one["radius_m"] + 1e-9).all())
        assert any(inside)


class Arm:
    """An ideal arm with the machine's dead time, faster than its file says, behind an envelope."""

    def __init__(self, envelope: Envelope, q: np.ndarray, faster: float = 1.25) -> None:
        self.envelope, self.q, self.now_s = envelope, q.copy(), 50.0
        self.speed = faster * SPEED
        self.waiting = deque([np.zeros(5)] * round(MACHINE.dead_time_s / DT_S))
        horizon_s = MACHINE.dead_time_s + GUARD.coast_s
        self.under_way = CommandsUnderWay(5, horizon_s)
        self.held, self.least_m = 0, math.inf

    def go(
        self, u: tuple[float, ...], seconds: float, face: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        sent = STILL
        for number in range(round(seconds / DT_S)):
            way_s, faces = self.under_way.integrate(self.now_s), None if face is None else (face,)
            sent, held = self.envelope.limit_command(u, tuple(self.q), way_s, faces, is_seen=True)
            self.under_way.note(self.now_s, sent)
            self.held += held
            self.waiting.append(np.array(sent))
            step = self.waiting.popleft() * self.speed * DT_S
            self.q = np.clip(self.q + step, MACHINE.lower, MACHINE.upper)
            self.now_s += DT_S
            if number % 5:
                continue
            clear_m = float(measure_clearance(self.envelope, self.q[None])[0])
            self.least_m = min(self.least_m, clear_m)
        return sent


def test_the_arm_stops_before_the_ground_and_may_leave_it() -> None:
    arm = Arm(build_envelope(), HOME)
    down = (0.0, 0.0, 1.0, 0.0, 0.0)
    arm.go(down, 8.0)
    assert arm.held > 0
    stopped_m = float(measure_clearance(arm.envelope, arm.q[None])[0])
    assert 0.0 < arm.least_m <= stopped_m < LIMITS.margin_m + 0.1
    held = arm.held
    up = (0.0, 0.0, -1.0, 0.0, 0.0)
    assert arm.go(up, 2.0) == up and arm.held == held
    assert float(measure_clearance(arm.envelope, arm.q[None])[0]) > stopped_m + 0.02


def test_without_ground_nothing_is_withheld() -> None:
    arm = Arm(build_envelope(ground_m=None), HOME)
    arm.go((0.0, 0.0, 1.0, 0.0, 0.0), 3.0)
    assert arm.held == 0 and measure_clearance(build_envelope(ground_m=None), HOME[None]) > 0
    # The boom's foot is always as near to the undercarriage, whatever the height of the ground.
    higher, lower = (
        measure_clearance(build_envelope(ground_m=z), HOME[None])[0] for z in (0.9, 0.8)
    )
    assert higher == pytest.approx(lower - 0.1)


def test_a_stay_out_box_holds_the_slew() -> None:
    arm = Arm(build_envelope(stay_out={"wall": WALL}), HOME)
    arm.go((1.0, 0.0, 0.0, 0.0, 0.0), 6.0)
    assert arm.held > 0 and arm.least_m > 0.0
    free = Arm(build_envelope(), HOME)
    free.go((1.0, 0.0, 0.0, 0.0, 0.0), 6.0)
    assert free.held == 0 and free.q[0] > arm.q[0] + 0.3


@pytest.mark.parametrize("seed", [0, 1])
def test_whatever_is_asked_the_arm_touches_nothing(seed: int) -> None:
    draw = np.random.default_rng(seed)
    arm = Arm(build_envelope(stay_out={"wall": WALL}), HOME)
    for _ in range(10):
        arm.go(tuple(draw.uniform(-1, 1, 5).tolist()), 1.2)
    assert arm.held > 0 and arm.least_m > 0.0


def test_a_withheld_command_passes_again_only_with_more_room() -> None:
    envelope = build_envelope()
    down, at = (0.0, 0.0, 0.02, 0.0, 0.0), HOME.copy()

    def find_angle(clear_m: float) -> float:
        low, high = HOME[2], MACHINE.upper[2]
        for _ in range(40):
            middle = (low + high) / 2
            at[2] = middle
            is_clear = measure_clearance(envelope, at[None])[0] > clear_m
            low, high = (middle, high) if is_clear else (low, middle)
        return low

    begin = find_angle(LIMITS.margin_m - 0.01)
    between = find_angle(LIMITS.margin_m + LIMITS.release_m / 2)
    outside = find_angle(LIMITS.margin_m + LIMITS.release_m + 0.01)
    found = []
    for angle in (between, begin, between, outside, between):
        at[2] = angle
        found.append(limit(envelope, down, at)[1])
    assert found == [False, True, True, False, False]
    at[2] = begin
    assert limit(envelope, down, at)[1]
    # Letting go of the levers forgets it.
    assert limit(envelope, STILL, at) == (STILL, False)
    at[2] = between
    assert not limit(envelope, down, at)[1]


@pytest.mark.parametrize("joint", range(5))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_inside_an_obstacle_only_what_leads_out_passes(joint: int, sign: float) -> None:
    """Boxes around the tip, so that the arm begins in them; the clearance may never shrink."""
    tip_m = build_envelope().locate_tip(HOME[None])[0]
    for half_m in (0.1, 0.4):
        box = StayOutBox(lower_m=tuple(tip_m - half_m), upper_m=tuple(tip_m + half_m))
        arm = Arm(build_envelope(stay_out={"box": box}, ground_m=None), HOME, faster=1.0)
        begin_m = float(measure_clearance(arm.envelope, HOME[None])[0])
        u = np.zeros(5)
        u[joint] = sign
        arm.go(tuple(u.tolist()), 5.0)
        assert begin_m < -0.05 and arm.least_m >= begin_m - 1e-3


def test_a_deep_pair_hides_no_other() -> None:
    """Begun in a box at its elbow, the arm still stops before a wall."""
    elbow = StayOutBox(lower_m=(1.2, -0.3, 1.5), upper_m=(1.6, 0.3, 3.0))
    envelope = build_envelope(stay_out={"elbow": elbow, "wall": WALL}, ground_m=None)
    wall = build_envelope(stay_out={"wall": WALL}, ground_m=None)
    assert measure_clearance(envelope, HOME[None])[0] < -0.05
    arm = Arm(envelope, HOME)
    # Turning away from the box does not deepen it.
    for _ in range(60):
        arm.go((1.0, 0.0, 0.0, 0.0, 0.0), 0.1)
        assert measure_clearance(wall, arm.q[None])[0] > 0.0
    assert arm.held > 0


def test_commands_under_way_count_until_they_have_come_to_rest() -> None:
    horizon_s = MACHINE.dead_time_s + GUARD.coast_s
    under_way = CommandsUnderWay(5, horizon_s)
    under_way.note(10.0, (1.0, 0, 0, 0, 0))
    under_way.note(10.1, (0.5, 0, 0, 0, 0))
    under_way.note(10.3, STILL)
    assert under_way.integrate(10.5) == pytest.approx((0.1 * 1.0 + 0.2 * 0.5, 0, 0, 0, 0))
    for now_s, expected in (
        (10.0 + horizon_s + 0.05, 0.05 + 0.1),
        (10.2 + horizon_s, 0.05),
        (10.4 + horizon_s, 0.0),
    ):
        assert under_way.integrate(now_s)[0] == pytest.approx(expected)
        under_way.note(now_s, STILL)
        assert under_way.integrate(now_s)[0] == pytest.approx(expected)
    for number in range(3000):
        under_way.note(20.0 + 0.01 * number, STILL)
    assert len(under_way._sent) <= horizon_s / 0.01 + 2


def test_while_no_face_is_seen_the_tip_is_slow_everywhere() -> None:
    envelope, u = build_envelope(ground_m=None), (0.0, 0.0, 1.0, 0.0, 0.0)
    far_m = tuple(envelope.locate_tip(HOME[None])[0] - [0.0, 0.0, 3.0])
    assert limit(envelope, u, HOME, far_m) == (u, False)
    sent, held = envelope.limit_command(u, tuple(HOME), STILL, (far_m,), is_seen=False)
    assert sent[2] < 0.5 and not held
    # One that is seen elsewhere counts, too.
    near_m = tuple(envelope.locate_tip(HOME[None])[0])
    assert envelope.limit_command(u, tuple(HOME), STILL, (far_m, near_m), True)[0][2] < 0.5


def test_near_the_work_surface_the_tip_is_slow() -> None:
    envelope = build_envelope(ground_m=None)
    q = np.array([0.0, -0.9, 0.8, 0.9, 0.77])
    tip = envelope.locate_tip(q[None])[0]
    u = (0.3, 0.0, 1.0, -0.5, 0.2)

    def measure_speed(sent: tuple[float, ...]) -> float:
        step = 1e-4 * SPEED * np.array(sent)
        ends = envelope.locate_tip(np.stack([q - step, q + step]))
        return float(np.linalg.norm(ends[1] - ends[0])) / 2e-4

    assert measure_speed(u) > 2 * LIMITS.face_speed_m_s
    beside = np.array([1.0, 0.0, 0.0])
    near_m, wide_m = LIMITS.face_near_m, LIMITS.face_radius_m
    for face, is_slow in (
        (tip, True),
        (tip + np.array([0.3, 0.2, -near_m + 0.01]), True),
        (tip + np.array([0.0, 0.0, near_m - 0.01]), True),
        (tip + np.array([0.0, 0.0, near_m + 0.01]), False),
        (tip - np.array([0.0, 0.0, near_m + 0.01]), False),
        (tip + (wide_m - 0.01) * beside, True),
        (tip + (wide_m + 0.01) * beside, False),
        (tip + (wide_m - 0.01) * beside + np.array([0.0, 0.0, near_m - 0.01]), True),
    ):
        sent, held = limit(envelope, u, q, tuple(face))
        assert not held
        if is_slow:
            assert measure_speed(sent) == pytest.approx(LIMITS.face_speed_m_s, rel=0.01)
            assert np.array(sent) == pytest.approx(np.array(u) * (sent[2] / u[2]))
        else:
            assert sent == u
    slow = tuple(0.05 * one for one in u)
    assert limit(envelope, slow, q, tuple(tip))[0] == pytest.approx(slow)
    assert limit(envelope, u, q) == (u, False)


def test_the_tip_is_slow_when_it_arrives_not_only_when_it_is_there() -> None:
    envelope = build_envelope(ground_m=None)
    arm = Arm(envelope, np.array([0.0, -0.9, 0.4, 0.9, 0.77]), faster=1.0)
    face = tuple(envelope.locate_tip(arm.q[None])[0] - [0.0, 0.0, 0.7])
    before, fastest, near = envelope.locate_tip(arm.q[None])[0], [], []
    for _ in range(360):
        arm.go((0.0, 0.0, 1.0, 0.0, 0.0), DT_S, face)
        tip = envelope.locate_tip(arm.q[None])[0]
        speed = float(np.linalg.norm(tip - before)) / DT_S
        before = tip
        height = tip[2] - face[2]
        (near if abs(height) < LIMITS.face_near_m else fastest).append(speed)
    assert max(fastest) > 0.5 and near and max(near) < 1.1 * LIMITS.face_speed_m_s


def test_the_shipped_shapes_are_those_of_the_machine() -> None:
    assert json.loads(SHIPPED.read_text()) == json.loads(json.dumps(describe_shapes(MACHINE)))


def test_shapes_of_another_machine_are_none(tmp_path: Path) -> None:
    assert read_machine_shapes(SHIPPED, replace(MACHINE, tool_m=MACHINE.tool_m[::-1])) is None
    renamed = replace(MACHINE, name="other", levers=MACHINE.levers[:-1])
    assert read_machine_shapes(SHIPPED, renamed) is not None
    other = replace(MACHINE, tool_m=MACHINE.tool_m[::-1])
    assert guard_setup.build_envelope(GUARD, other, commands=False) is None
    with pytest.raises(ConfigError, match="holds no shapes of machine brokk170"):
        guard_setup.build_envelope(GUARD, other, commands=True)
    bare = option("machine", "mini_excavator")
    assert guard_setup.build_envelope(GUARD, bare, commands=True) is None
    assert guard_setup.build_envelope(replace(GUARD, envelope=None), MACHINE, True) is None
    assert guard_setup.build_envelope(GUARD, MACHINE, commands=True) is not None


def write_shapes(**change: Any) -> str:
    """Returns the shipped shapes with changes of the first of the arm."""
    content = json.loads(SHIPPED.read_text())
    content["arm"][0].update(change)
    return json.dumps(content)


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", '{"schema": 2}', "[" * 50_000,
        # with these nothing would be withheld
        write_shapes(link="first"), write_shapes(link=17), write_shapes(link=-2), write_shapes(radius_m=-0.1),
        write_shapes(radius_m=math.inf), write_shapes(begin_m=[math.nan, 0.0, 0.0]), write_shapes(end_m=[0.0, 0.0]),
        json.dumps(json.loads(SHIPPED.read_text()) | {"arm": []}), None,
    ],
    ids=range(14),
)  # fmt: skip
def test_shapes_that_cannot_be_read_or_withhold_nothing_are_refused(
    tmp_path: Path, text: str | None
) -> None:
    path = tmp_path / "shapes.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_machine_shapes(path, MACHINE)


def test_a_longer_link_has_longer_capsules() -> None:
    joints = list(MACHINE.joints)
    body = joints[3].body
    longer = replace(body.origin_m[0], value=2.5)
    joints[3] = replace(joints[3], body=replace(body, origin_m=(longer, *body.origin_m[1:])))
    found = describe_shapes(replace(MACHINE, joints=tuple(joints)))["arm"]
    before = describe_shapes(MACHINE)["arm"]
    for link, factor in ((1, 1.0), (2, 2.0), (3, 1.0)):
        ends = []
        for arm in (before, found):
            own = [one["end_m"][0] + one["radius_m"] for one in arm if one["link"] == link]
            ends.append(max(own))
        # Radii stay; the ends of the boxes move with the link.
        assert ends[1] == pytest.approx(factor * ends[0], rel=0.12)


def test_a_stay_out_box_upside_down_is_refused() -> None:
    with pytest.raises(ConfigError, match="lower_m below upper_m"):
        StayOutBox(lower_m=(0.0, 0.0, 1.0), upper_m=(1.0, 1.0, 1.0))
