"""The guard: who may send what, and when nothing is sent."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from composed import MACHINE
from desk import DBC
from hypothesis import given, settings
from hypothesis import strategies as st

from brokk_rl.errors import ConfigError
from deploy.bus.description import BusDescription
from deploy.kernel.guard import (
    CommandRequest,
    Guard,
    GuardDecision,
    GuardInput,
    GuardState,
    GuardTrip,
)
from deploy.kernel.limits import FlowLimits, GuardLimits, JointBounds, TargetLimits
from deploy.kernel.plausibility import PlausibilityFilter

BODY = JointBounds((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0), (0.5, 0.5, 0.5), (False, True, False), 0.2)
FLOW = FlowLimits(tolerance=0.02, settle_s=0.04, num_messages=2, lever_scale=1.5)
TARGET = TargetLimits(
    age_s=600.0, jump_m=0.05, settle_s=0.5, seen_s=5.0, face_step_m=0.15, face_radius_m=1.0, contact_m=0.1,
)  # fmt: skip
LIMITS = GuardLimits(
    max_command=0.8, max_rate_1_s=5.0, max_reversals_1_s=3, max_starts_1_s=30, overrun=0.001, neutral=0.05,
    stop_margin=0.1, stop_release=0.05, speed_margin=1.0, coast_s=0.1, reaction_s=0.02, joints_s=0.15, page_s=0.08,
    vigilance_s=60.0, answer_s=10.0, flow=FLOW, target=TARGET,
    levers_s=0.16, status_s=0.17, request_s=0.18, ignored_s=0.3, controls_s=0.19, round_trip_s=0.14, gap_s=0.2, jump_margin=3.0,
    jump_slack=0.01, range_slack=0.2, num_jumps=3, envelope=None, observer=None,
)  # fmt: skip
WELL = GuardInput(
    q=(0.0, 0.0, 1.0), joints_age_s=0.01, joints_plausible=True, trusted=True, levers_age_s=0.01, lever=0.0, deadman=True,
    status_age_s=0.01, estop=False, bus_up=True, alone=True, followed=True, feedback_age_s=0.01, controls_age_s=0.01,
    round_trip_s=0.03, page_age_s=0.0, present_age_s=math.inf, described=True, observed=GuardTrip.NONE,
)  # fmt: skip
RELEASED = replace(WELL, deadman=False)
STILL = (0.0, 0.0, 0.0)
DT = 0.02


class Hand:
    """A guard whose clock goes on by `DT` with each decision."""

    def __init__(self, limits: GuardLimits = LIMITS) -> None:
        self.guard, self.now_s = Guard(limits, BODY, None), 100.0

    def decide(
        self,
        seen: GuardInput = WELL,
        u: tuple[float, ...] | None = STILL,
        armed: bool = True,
        **change: Any,
    ) -> GuardDecision:
        self.now_s += change.pop("dt", DT)
        age_s = change.pop("age_s", 0.0)
        request = None if u is None else CommandRequest(u, age_s)
        return self.guard.decide(self.now_s, armed, replace(seen, **change), request)

    def active(self) -> Hand:
        """Goes the way an operator goes: arm, release, press."""
        self.decide(RELEASED, dt=0.01)
        assert self.decide(RELEASED).state is GuardState.READY
        assert self.decide(WELL).state is GuardState.ACTIVE
        return self


class Fence:
    """An envelope that withholds what moves the first joint, and halves the rest."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []

    def limit_command(self, *asked: Any) -> tuple[tuple[float, ...], bool]:
        self.asked.append(asked)
        u = asked[0]
        return (STILL, True) if u[0] else (tuple(one / 2 for one in u), False)


def test_the_envelope_has_the_last_word_and_hears_of_what_is_under_way() -> None:
    hand, fence = Hand(), Fence()
    hand.guard = Guard(LIMITS, BODY, fence)  # type: ignore[arg-type]
    hand.active()
    assert fence.asked == []
    faces = ((2.0, 0.1, 0.8),)
    for u, expected, trip, way_s in (
        ((0.0, 0.0, 0.08), (0.0, 0.0, 0.04), GuardTrip.NONE, 0.0),
        ((0.08, 0.0, 0.0), STILL, GuardTrip.ENVELOPE, 0.04 * DT),
    ):
        hand.now_s += DT
        request = CommandRequest(u, 0.0, GuardTrip.NONE, faces, True)
        decision = hand.guard.decide(hand.now_s, True, WELL, request)
        assert decision == GuardDecision(GuardState.ACTIVE, expected, trip, GuardTrip.NONE)
        assert fence.asked[-1] == (u, WELL.q, (0.0, 0.0, pytest.approx(way_s)), faces, True)


def test_nothing_is_sent_until_somebody_arms_it_on_purpose() -> None:
    hand = Hand()
    for seen in (WELL, RELEASED, WELL):
        decision = hand.decide(seen, (0.5, 0.0, 0.5), armed=False)
        assert decision.state is GuardState.SILENT and not decision.sends and decision.u == STILL
    assert decision.trip is GuardTrip.NOT_ARMED


def test_what_is_wrong_is_said_in_silence_too() -> None:
    hand = Hand()
    hand.decide(armed=False)
    assert hand.decide(armed=False, estop=True).trip is GuardTrip.ESTOP


def test_arming_alone_moves_nothing_and_neither_does_a_dead_man_held_from_the_start() -> None:
    hand = Hand()
    hand.decide(WELL)
    decision = hand.decide(WELL, (0.5, 0.0, 0.0))
    assert decision.state is GuardState.LATCHED
    assert decision.sends
    assert decision.u == STILL
    assert decision.trip is GuardTrip.NOT_ARMED


def test_a_released_dead_man_is_zero_in_the_same_cycle_and_may_be_pressed_again() -> None:
    hand = Hand().active()
    hand.decide(u=(0.1, 0.0, 0.0))
    decision = hand.decide(RELEASED, (0.1, 0.0, 0.0))
    assert decision.state is GuardState.READY
    assert decision.u == STILL
    assert decision.trip is GuardTrip.DEADMAN
    assert hand.decide(u=(0.1, 0.0, 0.0)).state is GuardState.ACTIVE
    assert hand.decide(u=(0.05, 0.0, 0.0)).u == (0.05, 0.0, 0.0)


WRONG = [
    ({"bus_up": False}, GuardTrip.BUS_DOWN),
    ({"dt": LIMITS.gap_s + 0.001}, GuardTrip.TIME_GAP),
    ({"dt": -0.001}, GuardTrip.TIME_GAP),
    ({"estop": True}, GuardTrip.ESTOP),
    ({"trusted": False}, GuardTrip.CHANNEL_INVALID),
    ({"described": False}, GuardTrip.DESCRIPTION),
    ({"observed": GuardTrip.JOINT_TURNED}, GuardTrip.JOINT_TURNED),
    ({"status_age_s": LIMITS.status_s + 0.001}, GuardTrip.STATUS_STALE),
    ({"levers_age_s": LIMITS.levers_s + 0.001}, GuardTrip.LEVERS_STALE),
    ({"joints_age_s": LIMITS.joints_s + 0.001}, GuardTrip.JOINTS_STALE),
    ({"joints_age_s": math.nan}, GuardTrip.JOINTS_STALE),
    ({"joints_plausible": False}, GuardTrip.JOINTS_INVALID),
    ({"q": (0.0, math.nan, 0.0)}, GuardTrip.JOINTS_INVALID),
    ({"alone": False}, GuardTrip.SECOND_SENDER),
    ({"lever": LIMITS.neutral + 0.001}, GuardTrip.LEVER),
    ({"lever": math.nan}, GuardTrip.LEVER),
]
ASKED = [
    (None, 0.0, GuardTrip.REQUEST_STALE),
    ((0.1, 0.0, 0.0), LIMITS.request_s + 0.001, GuardTrip.REQUEST_STALE),
    ((0.1, 0.0, 0.0), -LIMITS.request_s - 0.001, GuardTrip.REQUEST_STALE),
    ((math.nan, 0.0, 0.0), 0.0, GuardTrip.REQUEST_INVALID),
    ((1.002, 0.0, 0.0), 0.0, GuardTrip.REQUEST_INVALID),
    ((0.0, 0.0, -1.002), 0.0, GuardTrip.REQUEST_INVALID),
    ((0.1, 0.0), 0.0, GuardTrip.REQUEST_INVALID),
    ((0.1, 0.1, 0.0), 0.0, GuardTrip.REQUEST_EXCLUSIVE),
    ((0.0, -0.1, 1e-9), 0.0, GuardTrip.REQUEST_EXCLUSIVE),
]


@pytest.mark.parametrize(("change", "trip"), WRONG, ids=str)
def test_anything_wrong_is_zero_in_the_same_cycle_and_latches_until_release_and_press(
    change: dict[str, Any], trip: GuardTrip
) -> None:
    hand = Hand().active()
    hand.decide(u=(0.1, 0.0, 0.1))
    decision = hand.decide(u=(0.1, 0.0, 0.1), **change)
    assert decision.state is GuardState.LATCHED
    assert decision.u == STILL
    assert decision.trip is trip
    assert decision.cause is trip
    again = hand.decide(u=(0.1, 0.0, 0.1))
    assert again.state is GuardState.LATCHED and again.u == STILL and again.trip is trip
    assert hand.decide(RELEASED).state is GuardState.READY
    pressed = hand.decide(WELL)
    assert pressed.state is GuardState.ACTIVE and pressed.cause is GuardTrip.NONE


@pytest.mark.parametrize(
    "change", [change for change, _ in WRONG if "dt" not in change] + [{"deadman": False}], ids=str
)
def test_what_ends_a_motion_is_known_when_it_is_seen_and_nothing_else_needs_haste(
    change: dict[str, Any],
) -> None:
    hand = Hand()
    assert not hand.guard.stops(replace(WELL, **change))  # nothing moves: the next cycle does
    hand.active()
    assert not hand.guard.stops(WELL)
    assert hand.guard.stops(replace(WELL, **change))
    assert hand.decide(u=(0.05, 0.0, 0.0)).u == (0.05, 0.0, 0.0)  # asking decides nothing
    assert hand.decide(u=(0.1, 0.0, 0.0), **change).u == STILL


@pytest.mark.parametrize(("change", "trip"), WRONG, ids=str)
def test_nobody_is_let_out_of_the_latch_while_something_is_wrong(
    change: dict[str, Any], trip: GuardTrip
) -> None:
    hand = Hand()
    hand.decide(RELEASED)
    hand.decide(RELEASED)
    assert hand.decide(RELEASED, **change).state is GuardState.LATCHED
    assert hand.decide(RELEASED, **change).state is GuardState.LATCHED
    assert hand.decide(WELL).trip is trip


@pytest.mark.parametrize(("u", "age_s", "trip"), ASKED, ids=str)
def test_a_request_that_makes_no_sense_is_refused_before_use(
    u: tuple[float, ...] | None, age_s: float, trip: GuardTrip
) -> None:
    hand = Hand().active()
    hand.decide(u=(0.1, 0.0, 0.1))
    decision = hand.decide(u=u, age_s=age_s)
    assert decision.state is GuardState.LATCHED and decision.u == STILL and decision.trip is trip


@pytest.mark.parametrize(
    "change",
    [
        {"dt": LIMITS.gap_s - 1e-9}, {"dt": 0.0}, {"status_age_s": LIMITS.status_s}, {"levers_age_s": LIMITS.levers_s},
        {"joints_age_s": LIMITS.joints_s}, {"lever": LIMITS.neutral}, {"age_s": LIMITS.request_s}, {"u": (1.001, 0.0, -1.001)},
        {"u": (0.0, -0.1, 0.0)}, {"controls_age_s": LIMITS.controls_s}, {"round_trip_s": LIMITS.round_trip_s},
        {"feedback_age_s": LIMITS.status_s}, {"page_age_s": LIMITS.page_s},
    ],
    ids=str,
)  # fmt: skip
def test_what_lies_on_a_limit_is_allowed(change: dict[str, Any]) -> None:
    hand = Hand().active()
    assert hand.decide(**change).state is GuardState.ACTIVE


def test_a_press_is_taken_only_once_there_is_a_fresh_command() -> None:
    hand = Hand().active()
    for _ in range(3):
        decision = hand.decide(RELEASED, u=None)
        assert (decision.state, decision.trip) == (GuardState.LATCHED, GuardTrip.REQUEST_STALE)
    assert hand.decide(RELEASED, u=STILL).state is GuardState.READY
    assert hand.decide(u=STILL).state is GuardState.ACTIVE


def test_disarming_is_silence_at_once() -> None:
    hand = Hand().active()
    hand.decide(u=(0.1, 0.0, 0.0))
    decision = hand.decide(u=(0.1, 0.0, 0.0), armed=False)
    assert decision.state is GuardState.SILENT
    assert decision.u == STILL
    assert decision.cause is GuardTrip.NONE
    assert hand.decide().state is GuardState.LATCHED


def test_commands_grow_by_the_rate_and_end_at_the_limit() -> None:
    hand = Hand().active()
    found = [hand.decide(u=(1.0, 0.0, -1.0)).u for _ in range(10)]
    assert [round(u[0], 6) for u in found] == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.8, 0.8]
    assert [u[2] for u in found] == [-u[0] for u in found]


def test_growth_goes_by_time_not_by_cycles() -> None:
    hand = Hand().active()
    assert hand.decide(u=(1.0, 0.0, 0.0), dt=0.1).u[0] == pytest.approx(0.5)
    assert hand.decide(u=(1.0, 0.0, 0.0), dt=0.001).u[0] == pytest.approx(0.505)


def test_towards_zero_a_command_may_fall_at_once_and_a_reversal_begins_at_zero() -> None:
    hand = Hand().active()
    for _ in range(5):
        hand.decide(u=(0.5, 0.0, 0.5))
    decision = hand.decide(u=(0.2, 0.0, -0.5))
    assert decision.u == (0.2, 0.0, pytest.approx(-0.1))
    assert hand.decide(u=(0.0, 0.0, 0.0)).u == STILL
    assert hand.decide(u=(1.0, 0.0, 0.0)).u[0] == pytest.approx(0.1)


def test_after_a_trip_commands_begin_at_zero_again() -> None:
    hand = Hand().active()
    for _ in range(5):
        hand.decide(u=(0.5, 0.0, 0.0))
    hand.decide(estop=True)
    hand.decide(RELEASED)
    hand.decide(WELL)
    assert hand.decide(u=(0.5, 0.0, 0.0)).u[0] == pytest.approx(0.1)


def test_nothing_moves_further_out_at_a_stop_but_everything_back() -> None:
    hand = Hand().active()
    q = (0.9, 0.0, 0.1)
    assert hand.decide(u=(0.05, 0.0, -0.05), q=q).u == STILL
    for back in (q, (0.95, 0.0, 0.05)):
        assert hand.decide(u=(-0.05, 0.0, 0.05), q=back).u == (-0.05, 0.0, 0.05)
    assert hand.decide(u=(0.05, 0.0, -0.05), q=(0.899, 0.0, 0.101)).u == (0.05, 0.0, -0.05)


WAY = [
    ({"controls_age_s": LIMITS.controls_s + 0.001}, GuardTrip.CONTROLS_STALE),
    ({"controls_age_s": math.nan}, GuardTrip.CONTROLS_STALE),
    ({"controls_age_s": -LIMITS.controls_s - 0.001}, GuardTrip.CONTROLS_STALE),
    ({"feedback_age_s": LIMITS.status_s + 0.001}, GuardTrip.FEEDBACK_STALE),
    ({"feedback_age_s": math.nan}, GuardTrip.FEEDBACK_STALE),
    ({"round_trip_s": LIMITS.round_trip_s + 0.001}, GuardTrip.ROUND_TRIP),
    ({"round_trip_s": math.nan}, GuardTrip.ROUND_TRIP),
    ({"page_age_s": LIMITS.page_s + 0.001}, GuardTrip.PAGE_SILENT),
    ({"page_age_s": -LIMITS.page_s - 0.001}, GuardTrip.PAGE_SILENT),
    ({"described": None}, GuardTrip.DESCRIPTION),
]


@pytest.mark.parametrize(("change", "trip"), WAY, ids=str)
def test_old_switches_and_feedback_and_an_unknown_way_latch_but_matter_only_where_something_is_sent(
    change: dict[str, Any], trip: GuardTrip
) -> None:
    hand = Hand()
    hand.decide(armed=False)
    assert hand.decide(armed=False, **change).trip is GuardTrip.NOT_ARMED
    hand.decide(RELEASED)
    assert hand.decide(RELEASED, **change).state is GuardState.LATCHED
    hand.active()
    hand.decide(u=(0.1, 0.0, 0.1))
    decision = hand.decide(u=(0.1, 0.0, 0.1), **change)
    assert (decision.state, decision.u, decision.trip) == (GuardState.LATCHED, STILL, trip)
    assert hand.decide(u=(0.1, 0.0, 0.1)).cause is trip
    assert hand.decide(estop=True, **change).trip is GuardTrip.ESTOP, "what is worse is said"


@pytest.mark.parametrize("name", ["INVALID", "OLD", "REACH", "GROUND", "FACE", "JUMPS"])
def test_a_borehole_beyond_its_limits_latches(name: str) -> None:
    hand = Hand().active()
    for trip in (GuardTrip.NONE, GuardTrip[f"TARGET_{name}"]):
        request = CommandRequest((0.1, 0.0, 0.1), 0.0, trip)
        hand.now_s += DT
        decision = hand.guard.decide(hand.now_s, True, WELL, request)
        assert decision.trip is trip and any(decision.u) == (trip is GuardTrip.NONE)
    assert decision.state is GuardState.LATCHED


def test_a_joint_leaves_rest_so_often_in_a_second_and_no_more() -> None:
    """A dead-man that bounces at 10 Hz, and a policy that asks for 1, 0, 1, 0."""
    limits = replace(LIMITS, max_starts_1_s=3)
    for bounces in (True, False):
        hand, sent = Hand(limits).active(), []
        for number in range(100):
            rests = number % 5 == 0
            u = STILL if rests and not bounces else (0.05, 0.0, 0.0)
            sent.append(hand.decide(RELEASED if rests and bounces else WELL, u))
        values = [one.u[0] for one in sent]
        starts = [k for k in range(1, 100) if values[k] and not values[k - 1]]
        assert 6 <= len(starts) <= 7, "three a second"
        assert GuardTrip.PULSES in {one.trip for one in sent}


def test_a_joint_ends_its_way_outward_so_early_that_it_rests_before_its_stop() -> None:
    limits = replace(LIMITS, max_command=1.0, speed_margin=1.3)
    hand, under_way, q = Hand(limits).active(), [0.0] * 10, 0.3
    for _ in range(200):
        under_way.append(hand.decide(u=(1.0, 0.0, 0.0), q=(q, 0.0, 1.0)).u[0])
        q += 1.3 * 0.5 * DT * under_way.pop(0)  # the dead time of 0.2 s
    assert 0.7 < q < BODY.upper[0] - LIMITS.stop_margin and not any(under_way[-5:])
    assert hand.decide(u=(-0.05, 0.0, 0.0), q=(q, 0.0, 1.0)).u[0] == -0.05


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_joint_that_is_withheld_at_its_stop_needs_more_room_to_go_on(side: float) -> None:
    limits = replace(LIMITS, max_command=1.0, max_rate_1_s=1000.0, speed_margin=1.3)
    hand, u = Hand(limits).active(), (side, 0.0, 0.0)
    for _ in range(20):
        assert hand.decide(u=u).u == u

    def passes(under_way_s: float, off: float) -> bool:
        """Whether the command passes so far before the place from which it is withheld."""
        edge = 0.9 - 0.5 * 1.3 * (under_way_s + limits.reaction_s) - off
        return hand.decide(u=u, q=(side * edge, 0.0, 1.0)).u == u

    # Dead time and coasting are 0.3 s; while nothing is sent less and less is under way.
    assert passes(0.30, 0.01)
    assert not passes(0.30, -0.01)
    assert not passes(0.28, 0.01) and not passes(0.26, limits.stop_release - 0.01)
    assert passes(0.24, limits.stop_release + 0.01)


def test_who_holds_the_dead_man_for_long_is_asked_and_has_to_answer() -> None:
    hand = Hand().active()
    prompts: list[float] = []
    for number in range(4000):
        decision = hand.decide(u=(0.0, 0.0, 0.0))
        prompts += [number * DT] if decision.prompt else []
        if decision.state is not GuardState.ACTIVE:
            break
    assert decision.cause is GuardTrip.VIGILANCE
    assert prompts[0] == pytest.approx(60.0, abs=0.1) and number * DT == pytest.approx(70, abs=0.1)
    hand.active()
    for number in range(6000):
        present_age_s = max(0.0, number * DT - 65.0) if number * DT > 65.0 else math.inf
        decision = hand.decide(present_age_s=present_age_s)
        assert decision.state is GuardState.ACTIVE
    hand.active()
    for number in range(6000):
        decision = hand.decide(RELEASED if number % 2500 == 2499 else WELL)
        assert decision.state is not GuardState.LATCHED and not decision.prompt


def test_a_joint_changes_its_direction_so_often_in_a_second_and_no_more() -> None:
    hand = Hand().active()
    sent = []
    for number in range(20):
        value = 0.05 if number % 2 == 0 else -0.05
        sent.append(hand.decide(u=(value, 0.0, 0.05), dt=0.05).u)
    # three changes, of which the first is forgotten a second later
    assert [u[0] for u in sent[:4]] == [0.05, -0.05, 0.05, -0.05]
    assert {u[0] for u in sent[4:]} == {0.0, -0.05} and all(u[2] == 0.05 for u in sent)
    assert hand.decide(u=(0.0, 0.0, 0.05), dt=0.06).u[0] == 0.0
    # the first change was 1.01 s ago, the second 0.99 s and then 1.01 s
    assert hand.decide(u=(0.05, 0.0, 0.05), dt=0.05).u[0] == 0.05
    assert hand.decide(u=(-0.05, 0.0, 0.05), dt=0.03).u[0] == 0.0
    assert hand.decide(u=(-0.05, 0.0, 0.05), dt=0.02).u[0] == -0.05


@pytest.mark.parametrize("first", [0.05, -0.05])
def test_a_direction_is_remembered_through_zero_and_the_first_is_no_change(first: float) -> None:
    hand = Hand().active()
    for value in (first, 0.0, -first, 0.0, first, 0.0, -first):
        assert hand.decide(u=(value, 0.0, 0.0), dt=0.02).u[0] == value
    assert hand.decide(u=(first, 0.0, 0.0), dt=0.02).u[0] == 0.0
    assert hand.decide(u=(-first, 0.0, 0.0), dt=0.02).u[0] == -first


def test_numbers_of_the_states_mean_what_the_description_says() -> None:
    bus = BusDescription(DBC, MACHINE)
    choices = bus._messages["PcHeartbeat"].get_signal_by_name("PcState").choices
    described = {number: str(name) for number, name in choices.items()}
    assert {one.value: one.name.lower() for one in GuardState} == described
    assert [one.sends for one in GuardState] == [False, True, True, True]


def test_the_exclusive_joint_moves_alone() -> None:
    hand = Hand().active()
    assert hand.decide(u=(0.0, 0.05, 0.0)).u == (0.0, 0.05, 0.0)
    assert hand.decide(u=(0.05, 0.0, 0.05)).u == (0.05, 0.0, 0.05)


numbers = st.one_of(st.floats(-1.5, 1.5), st.sampled_from([0.0, math.nan, math.inf, -math.inf]))
cycles = st.fixed_dictionaries(
    {
        "dt": st.floats(0.0, 0.25),
        "armed": st.sampled_from([True] * 9 + [False]),
        "u": st.one_of(st.none(), st.tuples(numbers, st.sampled_from([0.0, 0.0, 0.5]), numbers)),
        "age_s": st.floats(0.0, 0.2),
        "deadman": st.booleans(),
        "estop": st.sampled_from([False] * 9 + [True]),
        "lever": st.sampled_from([0.0] * 9 + [0.3]),
        "joints_age_s": st.floats(0.0, 0.16),
        "q": st.tuples(st.floats(-1.2, 1.2), st.floats(-2, 2), st.floats(-0.2, 3.2)),
    }
)


@settings(max_examples=200, deadline=None)
@given(st.lists(cycles, max_size=40))
def test_whatever_happens_the_guard_keeps_its_promises(story: list[dict[str, Any]]) -> None:
    hand, before, state, pressed = Hand(), STILL, GuardState.SILENT, False
    for cycle in story:
        dt = cycle["dt"]
        decision = hand.decide(WELL, **cycle)
        moved = [value != 0 for value in decision.u]
        assert all(abs(value) <= LIMITS.max_command for value in decision.u)
        assert not (moved[1] and (moved[0] or moved[2]))
        for j, (value, last) in enumerate(zip(decision.u, before, strict=True)):
            grown = abs(value) - (abs(last) if value * last > 0 else 0.0)
            assert grown <= LIMITS.max_rate_1_s * dt + 1e-9
            at = cycle["q"][j]
            lower = BODY.lower[j] + LIMITS.stop_margin
            upper = BODY.upper[j] - LIMITS.stop_margin
            assert not (value > 0 and at >= upper) and not (value < 0 and at <= lower)
        if any(moved):
            assert decision.state is GuardState.ACTIVE and state is GuardState.ACTIVE
            assert cycle["armed"]
            assert cycle["deadman"]
            assert not cycle["estop"]
            assert cycle["lever"] == 0
            assert pressed
            assert cycle["u"] is not None
            assert all(map(math.isfinite, cycle["u"]))
            assert cycle["age_s"] <= LIMITS.request_s
            assert dt <= LIMITS.gap_s and cycle["joints_age_s"] <= LIMITS.joints_s
        if decision.state is GuardState.ACTIVE and state is not GuardState.ACTIVE:
            assert state is GuardState.READY and cycle["deadman"] and not any(moved)
        if decision.state is GuardState.READY:
            assert not cycle["deadman"]
        assert decision.sends == cycle["armed"]
        before, state, pressed = decision.u, decision.state, cycle["deadman"]


def test_a_joint_that_jumps_is_refused_and_three_of_fifty_make_all_implausible() -> None:
    watch = PlausibilityFilter(LIMITS, BODY)
    assert watch.accept(0, 1.00, 0.0)
    assert watch.accept(0, 1.01, 0.0249)  # 0.01 + 3 * 0.5 rad/s * 0.01 s
    for number in (1, 2, 3):
        assert watch.plausible
        assert not watch.accept(0, 1.01 + 0.01 * number, 0.9)
    assert not watch.plausible
    # The first of the three is forgotten after fifty further samples.
    for number in range(47):
        assert watch.accept(0, 1.05 + 0.01 * number, 0.03) and not watch.plausible
    assert watch.accept(0, 2.0, 0.03) and watch.plausible


def test_a_loose_contact_that_spoils_every_second_sample_is_found() -> None:
    watch = PlausibilityFilter(LIMITS, BODY)
    for number in range(5):
        assert watch.plausible
        watch.accept(0, 0.01 * number, 0.5 * (number % 2))
    watch.accept(0, 0.05, 0.5)
    assert not watch.plausible
    # Another joint's samples do not count.
    other = PlausibilityFilter(LIMITS, BODY)
    for joint in (0, 1, 2):
        other.accept(joint, 0.0, 9.0)
    assert other.plausible


def test_a_joint_that_stays_at_its_new_place_is_believed_once_it_could_have_got_there() -> None:
    watch = PlausibilityFilter(LIMITS, BODY)
    watch.accept(2, 0.0, 1.0)
    found = [watch.accept(2, 0.01 * step, 1.5) for step in range(1, 40)]
    assert not any(found[:32]) and all(found[32:])  # (0.5 - 0.01) / 1.5 rad/s = 0.327 s


@pytest.mark.parametrize(
    ("position", "good"),
    [(1.2, True), (1.2001, False), (-1.2, True), (-1.2001, False), (math.nan, False)],
)
def test_a_position_beyond_the_limits_is_refused(position: float, good: bool) -> None:
    assert PlausibilityFilter(LIMITS, BODY).accept(0, 0.0, position) is good


def test_time_that_runs_backwards_gives_no_room_for_a_jump() -> None:
    watch = PlausibilityFilter(LIMITS, BODY)
    watch.accept(0, 1.0, 0.0)
    assert not watch.accept(0, 0.0, 0.02) and watch.accept(0, 0.0, -0.0099)


@pytest.mark.parametrize(
    "change",
    [
        {"max_command": 0.0}, {"max_command": 1.01}, {"max_rate_1_s": 0.0}, {"gap_s": math.inf}, {"joints_s": 0.0},
        {"levers_s": 0.0}, {"status_s": 0.0}, {"request_s": -1.0}, {"ignored_s": 0.0}, {"jump_slack": 0.0}, {"range_slack": 0.0},
        {"overrun": -0.1}, {"stop_margin": -0.1},
        {"neutral": 0.0}, {"neutral": 1.0}, {"jump_margin": 0.9}, {"num_jumps": 0},
    ],
    ids=str,
)  # fmt: skip
def test_limits_that_make_no_sense_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="|".join(change)):
        replace(LIMITS, **change)


def test_a_gateway_that_does_not_follow_is_noticed() -> None:
    hand = Hand().active()
    for _ in range(3):
        decision = hand.decide(u=(0.05, 0.0, 0.0), dt=0.1 - 1e-9, followed=False)
        assert decision.state is GuardState.ACTIVE
    assert hand.decide(u=(0.05, 0.0, 0.0), followed=True).u == (0.05, 0.0, 0.0)
    for _ in range(3):
        hand.decide(u=(0.05, 0.0, 0.0), dt=0.1, followed=False)
    decision = hand.decide(u=(0.05, 0.0, 0.0), dt=0.01, followed=False)
    assert decision.state is GuardState.LATCHED
    assert decision.u == STILL
    assert decision.cause is GuardTrip.IGNORED


def test_a_gateway_has_all_of_the_time_that_it_is_given_to_follow() -> None:
    hand = Hand(replace(LIMITS, ignored_s=0.25)).active()
    hand.decide(followed=True, dt=0.125)
    for _ in range(2):  # times that binary numbers hold exactly
        assert hand.decide(followed=False, dt=0.125).state is GuardState.ACTIVE
    assert hand.decide(followed=False, dt=0.125).cause is GuardTrip.IGNORED


def test_nobody_needs_to_follow_what_is_not_commanded() -> None:
    hand = Hand()
    for _ in range(100):
        assert hand.decide(RELEASED, followed=False).trip in (GuardTrip.DEADMAN, GuardTrip.TIME_GAP)
    assert hand.decide(WELL, followed=False).state is GuardState.ACTIVE
    assert hand.decide(WELL, estop=True, dt=0.19, followed=False).trip is GuardTrip.ESTOP
    hand.decide(WELL, dt=0.19, followed=False)
    assert hand.decide(RELEASED, followed=False).state is GuardState.READY


def test_what_lies_exactly_on_a_limit_of_time_or_reach_is_allowed() -> None:
    limits = replace(LIMITS, gap_s=0.25, jump_slack=0.25, jump_margin=2.0)  # exact in binary
    hand = Hand(limits)
    hand.now_s = 0.0
    hand.decide(RELEASED, dt=0.25)
    hand.decide(RELEASED, dt=0.25)
    assert hand.decide(WELL, dt=0.25).state is GuardState.ACTIVE
    assert hand.decide(WELL, dt=0.25).trip is GuardTrip.NONE
    watch = PlausibilityFilter(limits, BODY)
    assert watch.accept(0, 0.0, 0.0)
    assert watch.accept(0, 0.25, 0.5)
    assert not watch.accept(0, 0.25, 0.7501)
