"""Logic of the bus process: what is sent and when, from the guard's decisions to the last zero."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composed import MACHINE
from sender import BUS, DBC_TEXT, LIMITS, Sender, build_other_bus

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import BusDescription
from deploy.checks.envelope import Envelope
from deploy.checks.observer import Observer
from deploy.kernel.bus_logic import LAST_ZEROS, BusInputs, BusLogic, is_armed
from deploy.kernel.guard import NOTHING_OBSERVED, GuardState, GuardTrip, Observation
from deploy.kernel.limits import GuardLimits
from deploy.kernel.protection import MessageFault
from deploy.kernel.target_check import SeenTarget
from deploy.runtime.operator_state import OperatorControls, PageSignal, RequestedCommand

U = np.array([0.2, 0.0, -0.2, 0.0, 0.1])


def build_controls(t_s: float, armed: bool = True, armed_t_s: float = 0.0) -> OperatorControls:
    return OperatorControls(t_s, armed, armed_t_s, False, 0.0, False)


class Loop:
    """Logic, gateway and remote on one clock; requests, switches and stop as they are set."""

    def __init__(
        self,
        commands: bool = True,
        bus: BusDescription = BUS,
        envelope: Envelope | None = None,
        observer: Observer | None = None,
        needs_page: bool = False,
        limits: GuardLimits = LIMITS,
    ) -> None:
        self.envelope = envelope
        self.target: SeenTarget | None = None
        self.sender = Sender(bus)
        self.bus = bus
        self.logic = BusLogic(bus, MACHINE, limits, self.envelope, observer, commands, needs_page)
        self.sender.receiver = self.logic.receiver
        self.armed, self.armed_s, self.stop_s = True, 0.0, None
        self.u: np.ndarray | None = U
        self.page_age_s: float | None = None
        self.present_s = 900.0
        self.request_age_s, self.controls_age_s = 0.0, 0.0
        self.bus_up, self.missed, self.follows = True, 3, True
        self.sent: list[tuple[float, str, dict[str, float]]] = []

    @property
    def now_s(self) -> float:
        return self.sender.now_s

    def cycle(self, dt_s: float = 0.01, *left_out: str) -> list[CanFrame]:
        """Let 10 ms go by, with all messages, and decide."""
        self.sender.go(dt_s, *left_out)
        return self.decide()

    def decide(self) -> list[CanFrame]:
        now_s = self.now_s
        inputs = BusInputs(
            controls=build_controls(now_s - self.controls_age_s, self.armed, self.armed_s),
            page=self.build_page(now_s),
            request=None
            if self.u is None
            else RequestedCommand(now_s - self.request_age_s, self.u),
            target=self.target,
        )
        frames = self.logic.decide(now_s, self.bus_up, inputs, self.missed)
        self.note(frames)
        return frames

    def build_page(self, now_s: float) -> PageSignal | None:
        if self.page_age_s is None and self.stop_s is None:
            return None
        return PageSignal(now_s - (self.page_age_s or 0.0), self.stop_s or -1.0, self.present_s)

    def note(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            layout = self.bus.by_id[frame.frame_id]
            values = self.bus.decode(layout, frame.data)
            self.sent.append((self.now_s, layout.name, values))
            if layout.name == "ValveCmd" and self.follows:
                for joint in MACHINE.joint_names:  # the gateway follows
                    self.sender.values[f"Flow_{joint}"] = values[f"Command_{joint}"]

    def go(self, seconds: float, *left_out: str) -> None:
        for _ in range(round(seconds * 100)):
            self.cycle(0.01, *left_out)

    def commands(self) -> list[tuple[float, dict[str, float]]]:
        return [(t_s, values) for t_s, name, values in self.sent if name == "ValveCmd"]

    def get_active(self) -> Loop:
        self.sender.values["DeadMan"] = 0
        self.go(0.3)
        self.sender.values["DeadMan"] = 1
        self.go(0.3)
        assert self.state is GuardState.ACTIVE
        self.sent.clear()
        return self

    @property
    def state(self) -> GuardState:
        return self.logic.decision.state

    @property
    def trip(self) -> GuardTrip:
        return self.logic.decision.trip


@pytest.fixture
def loop() -> Loop:
    return Loop().get_active()


def values_of(u: np.ndarray) -> dict[str, Any]:
    return {f"Command_q{j + 1}": pytest.approx(value, abs=2.1e-3) for j, value in enumerate(u)}


def test_commands_go_out_with_their_cycle_time_counted_and_stamped(loop: Loop) -> None:
    loop.go(0.4)
    commands = loop.commands()
    assert np.diff([t_s for t_s, _ in commands]) == pytest.approx(0.02)
    counters = [values["Counter"] for _, values in commands]
    assert all((after - before) % 16 == 1 for before, after in itertools.pairwise(counters))
    for t_s, values in commands:
        assert values["CommandMode"] == 1 and values.items() >= values_of(U).items()
        assert (t_s + 40.0 - values["Stamp"]) % 1.024 <= 0.017
    beats = [(t_s, values) for t_s, name, values in loop.sent if name == "PcHeartbeat"]
    assert np.diff([t_s for t_s, _ in beats]) == pytest.approx(0.1)
    assert all(values["PcState"] == 3 and values["Overruns"] == 3 for _, values in beats)
    assert len(commands) == 20 and len(beats) == 4


def test_a_late_cycle_keeps_the_phase_and_sends_no_burst(loop: Loop) -> None:
    loop.sender.go(0.09)
    frames = loop.decide()
    assert len([one for one in frames if one.frame_id == BUS.command.frame_id]) == 1
    loop.sent.clear()
    loop.go(0.2)
    times = [t_s for t_s, _ in loop.commands()]
    # one command is made up for, half a cycle later; the others keep their phase
    assert np.diff(times)[1:] == pytest.approx(0.02) and len(times) <= 11


def test_half_a_cycle_early_is_on_time_and_more_is_not(loop: Loop) -> None:
    for early_s, is_due in ((0.0045, True), (0.0055, False)):
        while not (loop.sent and loop.sent[-1][0] == loop.now_s and loop.commands()):
            loop.cycle()
        loop.sender.go(0.01)
        loop.decide()
        before = len(loop.commands())
        loop.sender.now_s += 0.01 - early_s
        loop.decide()
        assert (len(loop.commands()) > before) == is_due
        loop.sender.now_s += early_s
        loop.go(0.1)
        loop.sent.clear()


def test_many_missed_cycles_fit_into_the_heartbeat(loop: Loop) -> None:
    loop.missed = 10_000
    loop.go(0.1)
    assert loop.sent[-1][2].get("Overruns", 4095) == 4095
    assert any(name == "PcHeartbeat" for _, name, _ in loop.sent)


def test_zero_goes_out_at_once_and_does_not_wait_for_its_turn(loop: Loop) -> None:
    loop.cycle()
    if loop.sent and loop.sent[-1][0] != loop.now_s:
        loop.cycle()
    assert loop.sent[-1][0] == loop.now_s, "a command has just gone out"
    loop.sent.clear()
    loop.u = np.full(5, np.nan)
    loop.cycle()
    (at_s, values), *_ = loop.commands()
    assert at_s == loop.now_s and values.items() >= values_of(np.zeros(5)).items()
    assert values["CommandMode"] == 0 and loop.trip is GuardTrip.REQUEST_INVALID
    assert loop.cycle() == [], "once; then with the cycle time, which keeps its phase"


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("LeverState", {"DeadMan": 0}),
        ("LeverState", {"Lever_right_theta": -0.3}),
        ("LeverState", {"RemoteOn": 0}),
        ("MachineStatus", {"EStop": 1}),
        ("JointPos2", {"Valid_q4": 0}),
    ],
)
def test_a_message_that_ends_a_motion_asks_for_a_decision_at_once(
    loop: Loop, message: str, changes: dict[str, float]
) -> None:
    loop.sender.now_s += 0.003
    assert loop.logic.take(loop.sender.build(message), loop.now_s) == (None, False)
    loop.sender.now_s += 0.001
    assert loop.logic.take(loop.sender.build(message, **changes), loop.now_s) == (None, True)
    assert any(loop.decide()) and not any(loop.logic.decision.u)  # type: ignore[union-attr]


def test_where_nothing_moves_no_message_needs_haste() -> None:
    for loop in (Loop(), Loop(commands=False)):
        frame = loop.sender.build("MachineStatus", EStop=1)
        assert loop.logic.take(frame, loop.now_s) == (None, False)
        loop.go(0.5)
        frame = loop.sender.build("MachineStatus", EStop=1)
        assert loop.logic.take(frame, loop.now_s) == (None, False)


def test_the_fault_of_a_message_is_told(loop: Loop) -> None:
    frame = loop.sender.build("JointPos1")
    wrong = CanFrame(frame.frame_id, frame.data[:-1])
    assert loop.logic.take(wrong, loop.now_s) == (MessageFault.LENGTH, False)
    assert loop.logic.take(wrong, loop.now_s) == (MessageFault.LENGTH, True), "trust is lost"


def test_switches_that_grow_old_latch_and_have_to_be_left_by_hand(loop: Loop) -> None:
    loop.controls_age_s = 0.07
    loop.go(0.05)
    assert loop.state is GuardState.ACTIVE
    loop.controls_age_s = 0.09
    loop.cycle()
    assert loop.state is GuardState.LATCHED and loop.trip is GuardTrip.CONTROLS_STALE
    loop.controls_age_s = 0.0
    loop.go(0.3)
    assert loop.state is GuardState.LATCHED
    loop.get_active()


def test_disarming_sends_zero_a_few_times_and_then_nothing(loop: Loop) -> None:
    loop.cycle()
    loop.armed = False
    loop.sent.clear()
    loop.cycle()
    assert loop.commands()[0][0] == loop.now_s, "the first at once"
    loop.go(1.0)
    zeros = loop.commands()
    assert len(zeros) == LAST_ZEROS == 5 and loop.state is GuardState.SILENT
    for _, values in zeros:
        assert values["CommandMode"] == 0 and values.items() >= values_of(np.zeros(5)).items()
    assert zeros[-1][0] - zeros[0][0] <= 0.1 + 1e-9
    loop.sent.clear()
    loop.go(0.3)
    assert loop.sent == []


@pytest.mark.parametrize(
    ("controls", "stopped_s", "armed"),
    [
        (None, -math.inf, False),
        (None, 1.0, False),
        (build_controls(9.0, False, 5.0), -math.inf, False),
        (build_controls(9.0, True, 5.0), -math.inf, True),
        (build_controls(9.0, True, 5.0), 4.9, True),
        (build_controls(9.0, True, 5.0), 5.0, False),
        (build_controls(9.0, True, 5.0), 5.1, False),
        (build_controls(9.0, False, 5.0), 4.9, False),
    ],
)
def test_who_is_armed(controls: OperatorControls | None, stopped_s: float, armed: bool) -> None:
    assert is_armed(controls, stopped_s) is armed


def test_a_stop_that_was_read_once_is_not_taken_back_by_an_earlier_one_or_by_none(
    loop: Loop,
) -> None:
    loop.armed_s = loop.now_s - 1.0
    loop.stop_s = loop.now_s
    loop.cycle()
    for stop_s in (None, loop.now_s - 2.0):
        loop.stop_s = stop_s
        loop.go(0.3)
        assert loop.state is GuardState.SILENT


def test_without_switches_nothing_is_ever_sent() -> None:
    loop = Loop()
    loop.sender.go(0.3)
    inputs = BusInputs(None, None, RequestedCommand(loop.now_s, U), None)
    assert loop.logic.decide(loop.now_s, True, inputs, 0) == []
    assert loop.state is GuardState.SILENT and loop.logic.end(loop.now_s, 0) == []


def test_a_loop_that_never_commands_sends_nothing_whatever_it_is_asked() -> None:
    loop = Loop(commands=False)
    loop.sender.values["DeadMan"] = 0
    loop.go(0.3)
    loop.sender.values["DeadMan"] = 1
    loop.go(0.5)
    assert loop.sent == [] and loop.state is GuardState.SILENT
    assert loop.trip is GuardTrip.NOT_ARMED and loop.logic.end(loop.now_s, 0) == []


def test_at_the_end_zero_goes_out_once_more_at_once(loop: Loop) -> None:
    loop.cycle()
    loop.cycle()
    loop.sent.clear()
    frames = loop.logic.end(loop.now_s + 0.001, 9)
    loop.note(frames)
    (_, values), *_ = loop.commands()
    assert values["CommandMode"] == 0 and values.items() >= values_of(np.zeros(5)).items()
    assert loop.trip is GuardTrip.BUS_DOWN and loop.state is GuardState.LATCHED
    assert Loop().logic.end(1000.0, 0) == [], "nothing was ever sent"


def test_requests_reach_the_guard_with_their_age(loop: Loop) -> None:
    loop.request_age_s = 0.079
    loop.go(0.05)
    assert loop.state is GuardState.ACTIVE
    loop.request_age_s = 0.081
    loop.cycle()
    assert loop.trip is GuardTrip.REQUEST_STALE
    loop.request_age_s = 0.0
    loop.get_active()
    loop.u = None
    loop.cycle()
    assert loop.trip is GuardTrip.REQUEST_STALE
    loop.u, loop.request_age_s = U, 0.0
    loop.get_active()
    loop.request_age_s = math.inf  # withdrawn
    loop.cycle()
    assert loop.trip is GuardTrip.REQUEST_STALE


def test_a_bus_that_is_down_is_told_to_the_guard_and_to_the_others(loop: Loop) -> None:
    loop.bus_up = False
    loop.cycle()
    assert loop.trip is GuardTrip.BUS_DOWN
    state = loop.logic.build_state(loop.now_s, False, 11)
    assert not state.bus_up and state.guard is GuardState.LATCHED and state.missed == 11
    assert loop.logic.build_state(loop.now_s, True, 11).bus_up


def test_own_commands_that_come_back_are_known(loop: Loop) -> None:
    for _ in range(10):
        for frame in loop.cycle():
            assert loop.logic.take(frame, loop.now_s) == (None, False)
    assert loop.state is GuardState.ACTIVE
    assert loop.logic.receiver.build_guard_input(loop.now_s, True, 0.0).alone


def test_a_bus_without_a_heartbeat_gets_none(tmp_path: Any) -> None:
    bus = build_other_bus(tmp_path, DBC_TEXT.replace("PcHeartbeat", "OtherName"))
    loop = Loop(bus=bus).get_active()
    loop.go(0.3)
    assert {name for _, name, _ in loop.sent} == {"ValveCmd"}


class Probe:
    """Notes what an observer is given, and finds what it is told to."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, list[float], list[float]]] = []
        self.observation, self.due, self.forgotten, self.cleared = NOTHING_OBSERVED, True, 0, 0

    def is_due(self, now_s: float) -> bool:
        return self.due

    def update(self, now_s: float, q: np.ndarray, u: np.ndarray, may_touch: bool) -> None:
        self.may_touch = may_touch
        self.seen.append((now_s, q.tolist(), u.tolist()))

    def forget(self) -> None:
        self.forgotten += 1

    def clear(self) -> None:
        self.cleared += 1


def test_the_observer_gets_positions_and_the_mean_flow_of_its_period() -> None:
    probe = Probe()
    loop = Loop(observer=probe).get_active()  # type: ignore[arg-type]
    probe.due = loop.follows = False
    loop.sender.values["Flow_q1"] = 0.2
    loop.go(0.2)
    probe.due = True
    loop.cycle()
    probe.due = False
    probe.seen.clear()
    before, number = loop.logic.receiver.flow_sum.copy(), loop.logic.receiver.flow_number
    for flow in (0.4, 0.8):
        loop.sender.values["Flow_q1"] = flow
        loop.go(0.1)
    mean = (loop.logic.receiver.flow_sum - before) / (loop.logic.receiver.flow_number - number)
    assert not probe.seen and 0.5 < mean[0] < 0.7
    probe.due = True
    loop.decide()
    ((now_s, q, u),) = probe.seen
    assert now_s == loop.now_s and q == pytest.approx(MACHINE.home, abs=1e-3)
    assert u == pytest.approx(mean.tolist())
    # Without news in between the flow is the newest.
    loop.decide()
    assert probe.seen[-1][2][0] == pytest.approx(0.8, abs=0.01)


def test_the_observer_hears_where_the_chisel_may_touch_the_borehole() -> None:
    probe = Probe()
    loop = Loop(observer=probe)  # type: ignore[arg-type]
    tip_m = compute_tool_kinematics(MACHINE, np.array(MACHINE.home)).tip_in_base_m
    for target, may_touch in (
        (SeenTarget(tuple(tip_m), 0.0, ()), True),
        (SeenTarget(tuple(tip_m + 0.5), 0.0, ()), False),
    ):
        loop.target = target
        loop.go(0.1)
        assert probe.may_touch is may_touch


def test_the_first_period_of_the_observer_has_the_mean_of_its_own_messages() -> None:
    probe = Probe()
    probe.due = False
    loop = Loop(observer=probe)  # type: ignore[arg-type]
    loop.follows = False
    loop.sender.values["Flow_q1"] = 0.2
    loop.go(0.1)
    probe.due = True
    loop.decide()
    (_, _, u) = probe.seen[0]
    assert loop.logic.receiver.flow_number > 2
    assert u[0] == pytest.approx(0.2, abs=0.005)


def test_an_observed_fault_latches_with_its_joint_and_a_released_dead_man_clears_it() -> None:
    probe = Probe()
    loop = Loop(observer=probe).get_active()  # type: ignore[arg-type]
    cleared = probe.cleared
    loop.cycle()
    assert probe.cleared == cleared
    probe.observation = Observation(GuardTrip.JOINT_STILL, 3)
    loop.cycle()
    assert loop.state is GuardState.LATCHED and loop.trip is GuardTrip.JOINT_STILL
    state = loop.logic.build_state(loop.now_s, True, 0)
    assert state.observed_joint == 4
    probe.observation = NOTHING_OBSERVED
    loop.sender.values["DeadMan"] = 0
    loop.go(0.05)
    assert probe.cleared > cleared and loop.state is GuardState.READY
    state = loop.logic.build_state(loop.now_s, True, 0)
    assert state.observed_joint == 0


def test_who_only_listens_is_told_of_a_fault_for_ten_seconds() -> None:
    probe = Probe()
    loop = Loop(commands=False, observer=probe)  # type: ignore[arg-type]
    loop.sender.values["DeadMan"] = 0
    loop.go(0.3)
    probe.observation = Observation(GuardTrip.JOINT_DRIFTS, 2)
    loop.go(9.9)
    assert probe.cleared == 0 and loop.trip is GuardTrip.JOINT_DRIFTS
    loop.go(0.3)
    assert probe.cleared > 0


def test_without_an_envelope_no_ground_is_known_and_faces_lie_level() -> None:
    for limits, known in ((LIMITS, True), (replace(LIMITS, envelope=None), False)):
        loop = Loop(limits=limits)
        loop.target = SeenTarget((2.5, 0.1, -0.1), 0.0, ())
        loop.go(1.0)
        below = loop.logic.build_state(loop.now_s, True, 0).target is GuardTrip.TARGET_GROUND
        assert below is known
        loop.target = SeenTarget((2.5, 0.1, 0.75), 0.0, ((2.5, 0.6, 0.75),))
        loop.go(1.0)
        assert loop.logic.build_state(loop.now_s, True, 0).target is GuardTrip.NONE


@pytest.mark.parametrize("missing", ["JointPos1", "ValveFeedback"])
def test_the_observer_begins_anew_where_its_values_are_missing(missing: str) -> None:
    probe = Probe()
    loop = Loop(observer=probe).get_active()  # type: ignore[arg-type]
    probe.forgotten = 0
    loop.go(LIMITS.joints_s - 0.03, missing)
    assert probe.forgotten == 0
    loop.go(0.06, missing)
    count = len(probe.seen)
    assert probe.forgotten > 0
    loop.go(0.05, missing)
    assert len(probe.seen) == count


def test_the_observer_begins_anew_where_positions_are_not_plausible() -> None:
    probe = Probe()
    loop = Loop(observer=probe).get_active()  # type: ignore[arg-type]
    probe.forgotten = 0
    loop.cycle()
    assert probe.forgotten == 0
    loop.sender.values["Valid_q1"] = 0
    loop.go(0.03)
    assert probe.forgotten > 0


def test_the_envelope_knows_the_faces_and_withholds() -> None:
    class Wall:
        """Withholds whatever comes, and notes the faces."""

        def limit_command(self, u: Any, q: Any, way: Any, faces: Any, is_seen: bool) -> Any:
            self.faces = faces, is_seen
            return (0.0,) * 5, True

    wall, center_m = Wall(), (2.5, 0.1, 0.8)
    loop = Loop(envelope=wall)  # type: ignore[arg-type]
    loop.target = SeenTarget(center_m, 0.0, ((2.2, 0.4, 0.8),))
    loop.go(0.5)
    loop.get_active()
    loop.cycle()
    assert wall.faces == ((center_m, (2.2, 0.4, 0.8)), True)
    assert loop.state is GuardState.ACTIVE and loop.trip is GuardTrip.ENVELOPE
    assert loop.commands()[-1][1]["Command_q1"] == 0.0


def test_the_flow_of_levers_is_theirs() -> None:
    loop = Loop(commands=False)
    loop.sender.values |= {"DeadMan": 0, "FlowSource": 1, "Lever_right_theta": 0.4}
    axis = [one.joint for one in MACHINE.levers if (one.side, one.axis) == ("right", "theta")]
    (joint,) = set(axis) - set(MACHINE.exclusive)
    names = [one for one in MACHINE.joint_names if one not in axis]
    for name, flow, fault in (
        (joint, 0.4, GuardTrip.NONE),
        (joint, 0.55, GuardTrip.NONE),
        (joint, 0.8, GuardTrip.FLOW_SCALED),
        (joint, -0.4, GuardTrip.FLOW_TURNED),
        (names[0], 0.4, GuardTrip.FLOW_UNASKED),
    ):
        loop.sender.values |= {f"Flow_{one}": 0.0 for one in MACHINE.joint_names}
        loop.sender.values[f"Flow_{name}"] = flow
        loop.go(0.4)
        assert loop.logic.receiver.found.fault is fault, (name, flow)
    # The levers of a remote that is off ask for nothing.
    loop.sender.values |= {f"Flow_{names[0]}": 0.0, f"Flow_{joint}": 0.4, "RemoteOn": 0}
    loop.go(0.4)
    assert loop.logic.receiver.found.fault is GuardTrip.FLOW_UNASKED


@pytest.mark.parametrize("flow", [0.4, -0.4])
def test_levers_that_nobody_knows_may_ask_for_any_flow_while_they_are_moved(flow: float) -> None:
    sender = Sender(machine=replace(MACHINE, levers=()))
    sender.values |= {"FlowSource": 1, "Lever_right_theta": 0.4, "Flow_q3": flow}
    sender.go(0.4)
    assert sender.receiver.found.fault is GuardTrip.NONE
    sender.values["Lever_right_theta"] = 0.0
    sender.go(0.4)
    assert sender.receiver.found.fault is GuardTrip.FLOW_UNASKED


def test_a_page_that_falls_silent_ends_the_motion_where_one_is_needed() -> None:
    for needs_page in (True, False):
        loop = Loop(needs_page=needs_page)
        loop.page_age_s = 0.0
        loop.get_active()
        loop.page_age_s = 0.079
        loop.cycle()
        assert loop.state is GuardState.ACTIVE
        loop.page_age_s = 0.081
        loop.cycle()
        assert (loop.trip is GuardTrip.PAGE_SILENT) == needs_page
    never = Loop(needs_page=True)
    never.go(0.3)
    assert never.trip is GuardTrip.PAGE_SILENT


def test_a_person_at_the_page_is_there(loop: Loop) -> None:
    loop.page_age_s = 0.0
    loop.go(0.1)
    seen = loop.logic._build_guard_input(loop.now_s, True)
    assert seen.present_age_s == loop.now_s - loop.present_s


TARGETS = [
    ((2.5, 0.0, 0.75), -601.0, (), GuardTrip.TARGET_OLD),
    ((2.5, 0.0, -1.5), 0.0, (), GuardTrip.TARGET_GROUND),
    ((2.5, 0.0, 0.75), 0.0, ((2.2, 0.3, 0.55),), GuardTrip.TARGET_FACE),
]


@pytest.mark.parametrize(("center_m", "age_s", "seen_m", "trip"), TARGETS)
def test_boreholes_have_limits_in_every_mode(
    center_m: Any, age_s: float, seen_m: Any, trip: GuardTrip
) -> None:
    for commands in (True, False):
        loop = Loop(commands)
        loop.target = SeenTarget(center_m, age_s, seen_m)
        loop.go(0.6)
        assert loop.logic.build_state(loop.now_s, True, 0).target is trip


def test_a_borehole_that_jumps_counts_once_it_stays(loop: Loop) -> None:
    loop.target = SeenTarget((2.5, 0.0, 0.75), 0.0, ())
    loop.cycle()
    assert loop.trip is GuardTrip.TARGET_JUMPS
    loop.go(0.5)
    loop.get_active()
    for step_m, trip in ((0.04, GuardTrip.NONE), (0.3, GuardTrip.TARGET_JUMPS)):
        loop.target = SeenTarget((2.5, step_m, 0.75), 0.0, ())
        loop.cycle()
        assert loop.trip is trip
    for number in range(100):  # 15 cm to and fro at 10 Hz
        loop.target = SeenTarget((2.5, 0.15 * (number // 5 % 2), 0.75), 0.0, ())
        loop.cycle()
        assert loop.logic.build_state(loop.now_s, True, 0).target is GuardTrip.TARGET_JUMPS


def test_a_narrower_range_of_a_command_is_kept_and_one_without_zero_is_refused(
    tmp_path: Path,
) -> None:
    line = "SG_ Command_q1 : 0|9@1- (0.004,0) [-1|1]"
    bus = build_other_bus(tmp_path, DBC_TEXT.replace(line, line.replace("[-1|1]", "[-0.1|0.1]")))
    assert bus.identity != BUS.identity
    loop = Loop(bus=bus).get_active()
    loop.go(0.3)
    assert loop.commands()[-1][1]["Command_q1"] == pytest.approx(0.1)
    assert loop.state is GuardState.ACTIVE
    with pytest.raises(ConfigError, match="Command_q1"):
        build_other_bus(tmp_path, DBC_TEXT.replace(line, line.replace("[-1|1]", "[0.2|1]")))
