"""The comparison of flows and the check of boreholes, by themselves; `test_deploy_logic.py` tries both on the bus."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from composed import MACHINE, option

from brokk_rl.kinematics import compute_tool_kinematics
from deploy.kernel.flow_check import FROM_PC, LEVERS, NOBODY, FlowCheck
from deploy.kernel.guard import GuardTrip
from deploy.kernel.limits import FlowLimits
from deploy.kernel.target_check import SeenTarget, TargetCheck

LIMITS = FlowLimits(tolerance=0.02, settle_s=0.04, num_messages=2, lever_scale=1.5)
ROUND_TRIP_S, UP = 0.15, (0.0, 0.0, 1.0)
STILL = (0.0, 0.0, 0.0)
GUARD = option("guard", "default")


class Valves:
    """A comparison whose clock goes on by 20 ms with each message of feedback."""

    def __init__(self) -> None:
        self.check, self.now_s, self.known_s = FlowCheck(LIMITS, 3, ROUND_TRIP_S), 100.0, 0.03

    def report(
        self, flow: tuple[float, ...], source: int, count: int = 2, estop: bool = False
    ) -> tuple[GuardTrip, int]:
        for _ in range(count):
            self.now_s += 0.02
            self.check.take(self.now_s, flow, source, estop, self.known_s)
        return self.check.fault, self.check.joint


@pytest.mark.parametrize("source", [NOBODY, LEVERS, FROM_PC])
def test_a_flow_at_rest_is_unasked_from_its_second_message_on(source: int) -> None:
    valves = Valves()
    assert (valves.check.fault, valves.check.joint) == (GuardTrip.NONE, -1)
    assert (NOBODY, LEVERS, FROM_PC) == (0, 1, 2), "as the DBC numbers them"
    assert Valves().report((0.0, 0.0, 0.3), source, 1) == (GuardTrip.NONE, -1)
    assert valves.report(STILL, source, 10) == (GuardTrip.NONE, -1)
    assert valves.report((0.0, 0.02, -0.02), source, 5) == (GuardTrip.NONE, -1), "the tolerance"
    assert valves.report((0.0, 0.0, 0.021), source, 1) == (GuardTrip.NONE, -1)
    assert valves.report((0.0, 0.0, 0.021), source, 1) == (GuardTrip.FLOW_UNASKED, 2)
    assert valves.report((0.0, -0.5, 0.3), source) == (GuardTrip.FLOW_UNASKED, 1), "the worst"
    assert valves.report((0.0, -0.3, 0.5), source) == (GuardTrip.FLOW_UNASKED, 2), "the worst"
    assert valves.report(STILL, source, 1) == (GuardTrip.NONE, -1)
    # One message between two right ones is borne.
    valves.report((0.3, 0.0, 0.0), source, 1)
    valves.report(STILL, source, 1)
    assert valves.report((0.3, 0.0, 0.0), source, 1) == (GuardTrip.NONE, -1)


@pytest.mark.parametrize(
    ("flow", "fault"),
    [
        ((0.4, 0.0, -0.2), (GuardTrip.NONE, -1)),
        ((0.419, 0.0, -0.181), (GuardTrip.NONE, -1)),
        ((0.8, 0.0, -0.2), (GuardTrip.FLOW_SCALED, 0)),
        ((0.2, 0.0, -0.2), (GuardTrip.FLOW_SCALED, 0)),
        ((-0.4, 0.0, -0.2), (GuardTrip.FLOW_TURNED, 0)),
        ((0.4, 0.0, 0.2), (GuardTrip.FLOW_TURNED, 2)),
        ((0.4, 0.1, -0.2), (GuardTrip.FLOW_UNASKED, 1)),
        ((0.0, 0.0, -0.2), (GuardTrip.FLOW_SCALED, 0)),
    ],
)
def test_where_the_pc_has_the_valves_they_get_its_commands(
    flow: tuple[float, ...], fault: tuple[GuardTrip, int]
) -> None:
    valves = Valves()
    valves.check.note_command(valves.now_s, (0.4, 0.0, -0.2))
    assert valves.report((0.4, 0.0, -0.2), FROM_PC, 20) == (GuardTrip.NONE, -1)
    assert valves.report(flow, FROM_PC) == fault


@pytest.mark.parametrize(("known_s", "last_s"), [(0.03, 0.07), (0.09, 0.13), (math.inf, 0.19)])
def test_the_last_command_counts_until_it_has_had_its_way(known_s: float, last_s: float) -> None:
    valves = Valves()
    valves.known_s = known_s
    valves.check.note_command(valves.now_s, (0.4, 0.0, 0.0))
    valves.report((0.4, 0.0, 0.0), FROM_PC, 20)
    valves.check.note_command(valves.now_s, STILL)
    begun_s = valves.now_s
    while valves.report((0.4, 0.0, 0.0), FROM_PC, 1)[0] is GuardTrip.NONE:
        assert valves.now_s < begun_s + 0.5
    # Two messages, of 20 ms each, after the command has ended.
    assert valves.now_s - begun_s == pytest.approx(last_s + 0.03, abs=0.011)
    assert valves.check.fault is GuardTrip.FLOW_UNASKED


@pytest.mark.parametrize(
    ("flow", "trip"),
    [
        (0.4, GuardTrip.NONE),
        (0.0, GuardTrip.NONE),  # a dead band
        (0.62, GuardTrip.NONE),
        (0.63, GuardTrip.FLOW_SCALED),
        (-0.03, GuardTrip.FLOW_TURNED),
    ],
)
def test_the_levers_have_a_curve_of_the_makers(flow: float, trip: GuardTrip) -> None:
    valves = Valves()
    valves.check.note_levers(valves.now_s, (0.4, 0.0, 0.0))
    valves.report((0.4, 0.0, 0.0), LEVERS, 20)
    assert valves.report((flow, 0.0, 0.0), LEVERS)[0] is trip
    # Commands do not count there, and levers not where the PC has the valves.
    valves.check.note_command(valves.now_s, (0.0, 0.5, 0.0))
    assert valves.report((0.4, 0.5, 0.0), LEVERS, 20)[0] is GuardTrip.FLOW_UNASKED
    assert valves.report((0.0, 0.5, 0.0), FROM_PC, 20)[0] is GuardTrip.NONE
    assert valves.report((0.4, 0.5, 0.0), FROM_PC)[0] is GuardTrip.FLOW_UNASKED


def test_while_the_valves_change_hands_both_count() -> None:
    valves = Valves()
    valves.check.note_levers(valves.now_s, (0.4, 0.0, 0.0))
    valves.check.note_command(valves.now_s, (0.0, 0.3, 0.0))
    valves.report((0.4, 0.0, 0.0), LEVERS, 20)
    assert valves.report((0.4, 0.3, 0.0), FROM_PC, 3) == (GuardTrip.NONE, -1)
    assert valves.report((0.4, 0.3, 0.0), FROM_PC, 4) == (GuardTrip.FLOW_UNASKED, 0)


def test_at_an_emergency_stop_nothing_is_asked_for() -> None:
    valves = Valves()
    valves.check.note_levers(valves.now_s, (0.4, 0.0, 0.0))
    valves.report((0.4, 0.0, 0.0), LEVERS, 20)
    assert valves.report((0.4, 0.0, 0.0), LEVERS, 3, estop=True) == (GuardTrip.NONE, -1)
    assert valves.report((0.4, 0.0, 0.0), LEVERS, 3, estop=True) == (GuardTrip.FLOW_UNASKED, 0)
    assert valves.report((0.4, 0.0, 0.0), LEVERS, 1) == (GuardTrip.NONE, -1)
    # The next one begins anew.
    assert valves.report((0.4, 0.0, 0.0), LEVERS, 3, estop=True) == (GuardTrip.NONE, -1)


def test_what_is_long_ago_is_forgotten() -> None:
    valves = Valves()
    for _ in range(1000):
        valves.check.note_command(valves.now_s, STILL)
        valves.check.note_levers(valves.now_s, STILL)
        valves.report(STILL, NOBODY, 1)
    for noted in (valves.check._commands, valves.check._levers, valves.check._sources):
        assert len(noted) < 12
    # Feedback that never comes must not fill the memory of a day.
    for _ in range(5000):
        valves.check.note_command(valves.now_s, STILL)
        valves.check.note_levers(valves.now_s, STILL)
    assert len(valves.check._commands) + len(valves.check._levers) <= 2000


def build_check(ground_m: float | None = 0.0) -> TargetCheck:
    return TargetCheck(GUARD.target, MACHINE, ground_m, UP)


def name_fault(
    center_m: tuple[float, ...],
    age_s: float = 0.0,
    seen_m: tuple[tuple[float, ...], ...] = (),
    check: TargetCheck | None = None,
) -> GuardTrip:
    """The fault of a borehole that has stayed for long."""
    made = check or build_check()
    target = SeenTarget(center_m, age_s, seen_m)
    made.check(0.0, target)
    return made.check(GUARD.target.settle_s, target)


def find_reach_m() -> float:
    """Length of the stretched arm from the slew axis: 0.25, 0.28 m to the boom, its links, the tool."""
    lengths_m = []
    for joint in MACHINE.joints[1:]:
        lengths_m.append(math.hypot(*(one.value for one in joint.body.origin_m)))
    return sum(lengths_m) + math.hypot(*MACHINE.tip_m)


def test_reach_is_that_of_the_stretched_arm_within_the_slew() -> None:
    first = MACHINE.joints[0]
    height_m, reach_m = first.body.origin_m[2].value, find_reach_m()
    for yaw in (0.0, 1.5, -1.5):
        ahead = math.cos(yaw), math.sin(yaw)
        for length_m, trip in ((-0.01, GuardTrip.NONE), (0.01, GuardTrip.TARGET_REACH)):
            length_m += reach_m
            center_m = (ahead[0] * length_m, ahead[1] * length_m, height_m)
            assert name_fault(center_m) is trip
    for yaw, trip in (
        (first.upper.value - 0.01, GuardTrip.NONE),
        (first.upper.value + 0.01, GuardTrip.TARGET_REACH),
        (first.lower.value + 0.01, GuardTrip.NONE),
        (first.lower.value - 0.01, GuardTrip.TARGET_REACH),
    ):
        assert name_fault((2.5 * math.cos(yaw), 2.5 * math.sin(yaw), 0.7)) is trip


def test_without_bodies_or_a_slew_there_is_no_such_limit() -> None:
    bare = option("machine", "mini_excavator")
    check = TargetCheck(GUARD.target, bare, None, UP)
    assert name_fault((-50.0, 0.0, -3.0), check=check) is GuardTrip.NONE
    joints = list(MACHINE.joints)
    body = joints[0].body
    for change in ({"body": replace(body, axis=(0.0, 1.0, 0.0))}, {"kind": "slide"}):
        joints[0] = replace(MACHINE.joints[0], **change)
        other = TargetCheck(GUARD.target, replace(MACHINE, joints=tuple(joints)), None, UP)
        assert name_fault((-2.5, 0.0, 0.7), check=other) is GuardTrip.NONE


def test_ground_age_and_numbers() -> None:
    age_s = GUARD.target.age_s
    assert name_fault((2.5, 0.0, 0.0)) is GuardTrip.NONE
    assert name_fault((2.5, 0.0, -0.001)) is GuardTrip.TARGET_GROUND
    assert name_fault((2.5, 0.0, -0.001), check=build_check(None)) is GuardTrip.NONE
    for age, trip in ((age_s, GuardTrip.NONE), (age_s + 1.0, GuardTrip.TARGET_OLD)):
        assert name_fault((2.5, 0.0, 0.7), age) is name_fault((2.5, 0.0, 0.7), -age) is trip
    for number in range(3):
        center_m = [2.5, 0.0, 0.7]
        center_m[number] = math.nan
        assert name_fault(tuple(center_m)) is GuardTrip.TARGET_INVALID


def test_a_borehole_lies_on_the_face_of_those_around_it() -> None:
    center_m, step_m = (2.5, 0.0, 0.7), GUARD.target.face_step_m
    radius_m = GUARD.target.face_radius_m
    for side in (1.0, -1.0):
        near = (2.5, side * (radius_m - 0.01))
        assert name_fault(center_m, 0.0, ((*near, 0.7 + side * (step_m - 0.01)),)) is GuardTrip.NONE
        off_m = (*near, 0.7 + side * (step_m + 0.01))
        assert name_fault(center_m, 0.0, (off_m,)) is GuardTrip.TARGET_FACE
        on_m = (2.4, 0.0, 0.7)
        assert name_fault(center_m, 0.0, (on_m, off_m)) is GuardTrip.TARGET_FACE
        far_m = (2.5, side * (radius_m + 0.01), 0.7 + side * (step_m + 0.01))
        assert name_fault(center_m, 0.0, (far_m,)) is GuardTrip.NONE


def test_a_borehole_counts_once_it_has_stayed() -> None:
    check, settle_s, jump_m = build_check(), GUARD.target.settle_s, GUARD.target.jump_m

    def look(now_s: float, y_m: float) -> GuardTrip:
        return check.check(now_s, SeenTarget((2.5, y_m, 0.7), 0.0, ()))

    assert look(10.0, 0.0) is look(10.0 + settle_s - 0.01, 0.0) is GuardTrip.TARGET_JUMPS
    assert look(10.0 + settle_s, 0.0) is GuardTrip.NONE
    assert look(11.0, jump_m - 0.001) is GuardTrip.NONE
    # Counted from where it stood first: it may not creep away.
    assert look(11.1, jump_m + 0.001) is GuardTrip.TARGET_JUMPS
    assert look(11.1 + settle_s, jump_m + 0.001) is GuardTrip.NONE


def test_the_chisel_may_touch_from_just_above_the_rim_downwards_near_the_axis() -> None:
    check, q, contact_m = build_check(), np.array(MACHINE.home), GUARD.target.contact_m
    tip_m = compute_tool_kinematics(MACHINE, q).tip_in_base_m
    for off_m, may_touch in (
        ((0.0, 0.0, -0.9 * contact_m), True),
        ((0.0, 0.9 * contact_m, 0.5), True),
        ((0.0, 0.0, -1.1 * contact_m), False),
        ((1.1 * contact_m, 0.0, 0.5), False),
        ((math.nan, math.nan, math.nan), False),
    ):
        target = SeenTarget(tuple(tip_m + off_m), 0.0, ())
        assert check.may_touch(q, target) is may_touch
    assert not check.may_touch(q, None)
    bare = option("machine", "mini_excavator")
    here = SeenTarget(tuple(tip_m), 0.0, ())
    assert not TargetCheck(GUARD.target, bare, None, UP).may_touch(q, here)
