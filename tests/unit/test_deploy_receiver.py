"""The receiver: what it makes of messages, whose age counts from their stamp."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE
from sender import BUS, DBC_TEXT, DECISION, HOME, PERIODS_S, Sender, build_other_bus

from deploy.bus.can_bus import CanFrame
from deploy.bus.description import BusDescription
from deploy.kernel.guard import GuardTrip
from deploy.kernel.protection import ChannelTrust, MessageFault


@pytest.fixture
def sender() -> Sender:
    made = Sender()
    made.go(0.5)
    return made


def test_before_anything_came_nothing_is_known() -> None:
    seen, state = Sender().seen(), Sender().state()
    ages = (seen.joints_age_s, seen.levers_age_s, seen.status_age_s, seen.feedback_age_s)
    ages += (seen.round_trip_s,)
    assert all(age == math.inf for age in ages)
    assert not (seen.joints_plausible or seen.deadman or seen.estop or seen.followed)
    assert seen.trusted and seen.alone and seen.bus_up
    times = (state.q_t_s, state.flow_t_s, state.levers_t_s, state.status_t_s, state.held_up_s)
    assert times == (0.0,) * 5 and math.isnan(state.oil_c)
    assert (state.frames, state.refused, state.lost, state.flow_number) == (0, 0, 0, 0)


def test_a_remote_that_speaks_before_the_gateway_is_heard_and_is_not_late() -> None:
    sender = Sender()
    # Its dead-man is pressed, and nobody knows the gateway's clock yet.
    sender.send("LeverState")
    assert sender.seen().deadman and sender.state().held_up_s == 0.0


def test_only_valve_feedback_counts_against_the_valves(sender: Sender) -> None:
    sender.values |= {"FlowSource": 0}
    sender.go(0.5)
    sender.send("ValveFeedback", Flow_q1=0.5)
    for _ in range(20):
        sender.send("MachineStatus")
    assert sender.seen().observed is GuardTrip.NONE
    for _ in range(20):
        sender.send("ValveFeedback", Flow_q1=0.5)
    assert sender.seen().observed is GuardTrip.FLOW_UNASKED


def test_what_was_sent_is_what_the_guard_and_the_others_see(sender: Sender) -> None:
    sender.values |= {f"Flow_q{j}": 0.1 * j for j in (1, 3)}
    sender.send("ValveFeedback")
    sender.send("LeverState", Lever_left_theta=0.02, Lever_right_psi=-0.04, ButtonRight=1)
    sender.send("MachineStatus", ExclusiveSelected=1, EStop=0)
    seen, state = sender.seen(0.07), sender.state(bus_up=False)
    assert seen.q == pytest.approx(MACHINE.home, abs=1e-4)
    assert seen.joints_age_s == pytest.approx(0.0, abs=1e-3)
    assert seen.levers_age_s <= 0.009 and seen.status_age_s == pytest.approx(0.0, abs=1e-3)
    assert seen.joints_plausible and seen.trusted and seen.alone and seen.followed and seen.deadman
    assert seen.lever == pytest.approx(0.04) and not seen.estop and seen.bus_up
    assert seen.controls_age_s == 0.07 and seen.round_trip_s == pytest.approx(0.03)
    assert state.flow == pytest.approx([0.1, 0, 0.3, 0, 0], abs=2.1e-3)
    assert state.flow_sum == pytest.approx(state.flow) and state.flow_number == 26
    assert state.flow_t_s == pytest.approx(sender.now_s, abs=0.017)
    assert state.lever == pytest.approx([0.02, 0, 0, -0.04])
    assert state.button_right and state.deadman and state.remote_on and state.exclusive_selected
    assert state.oil_c == 35.0 and not state.estop and not state.bus_up
    assert state.levers_t_s == pytest.approx(sender.now_s, abs=0.009)
    assert state.status_t_s == pytest.approx(sender.now_s, abs=1e-3)
    assert state.q_t_s == pytest.approx(sender.now_s, abs=1e-3) and state.t_s == sender.now_s
    assert state.q == pytest.approx(MACHINE.home, abs=1e-4) and state.q_plausible
    assert (state.guard, state.trip, state.cause) == (DECISION.state, DECISION.trip, DECISION.cause)
    assert state.sent.tolist() == list(DECISION.u) and state.missed == 7
    assert state.trusted and state.alone and state.round_trip_s == pytest.approx(0.03)
    assert state.frames == 50 * 3 + 25 * 3 + 5 + 3
    assert state.refused == 0 and state.held_up_s < 0.017


@pytest.mark.parametrize("axis", ["left_theta", "left_psi", "right_theta", "right_psi"])
@pytest.mark.parametrize("deflection", [0.5, -0.5])
def test_each_lever_counts_to_either_side(sender: Sender, axis: str, deflection: float) -> None:
    sender.send("LeverState", **{f"Lever_{axis}": deflection})
    assert sender.seen().lever == 0.5


def test_a_remote_that_is_off_is_as_good_as_none(sender: Sender) -> None:
    sender.send("LeverState", RemoteOn=0)
    assert sender.seen().levers_age_s == math.inf and not sender.state().remote_on
    sender.send("LeverState", RemoteOn=1)
    assert sender.seen().levers_age_s < 0.01


@pytest.mark.parametrize(
    ("message", "changes", "field"),
    [
        ("LeverState", {"DeadMan": 0}, "deadman"),
        ("MachineStatus", {"FlowSource": 1}, "followed"),
        ("MachineStatus", {"FlowSource": 0}, "followed"),
    ],
)
def test_what_is_no_longer_said_is_no_longer_so(
    sender: Sender, message: str, changes: dict[str, float], field: str
) -> None:
    assert getattr(sender.seen(), field)
    sender.send(message, **changes)
    assert not getattr(sender.seen(), field)


def test_an_emergency_stop_is_seen(sender: Sender) -> None:
    sender.send("MachineStatus", EStop=1)
    assert sender.seen().estop and sender.state().estop


@pytest.mark.parametrize("name", MACHINE.joint_names)
def test_one_joint_called_invalid_makes_all_of_them_implausible(sender: Sender, name: str) -> None:
    before = sender.receiver.q.copy()
    message, position = BUS.message_of(f"Position_{name}"), f"Position_{name}"
    sender.now_s += 0.01
    sender.send(message, **{f"Valid_{name}": 0, position: HOME[position] + 0.002})
    assert not sender.seen().joints_plausible and not sender.state().q_plausible
    assert sender.receiver.q == pytest.approx(before, abs=1e-6), "its position is not used"
    sender.send(message)
    assert sender.seen().joints_plausible


def test_a_jump_is_not_used_and_three_of_them_are_implausible(sender: Sender) -> None:
    for number in range(3):
        sender.now_s += 0.01
        assert sender.seen().joints_plausible, number
        sender.send("JointPos1", Position_q1=HOME["Position_q1"] + 0.5)
        assert sender.seen().q[0] == pytest.approx(MACHINE.home[0], abs=1e-4)
    assert not sender.seen().joints_plausible


@pytest.mark.parametrize("name", list(PERIODS_S))
def test_what_stays_away_grows_old_and_nothing_else_does(sender: Sender, name: str) -> None:
    sender.go(0.3, name)
    seen = sender.seen()
    ages = {"JointPos": seen.joints_age_s, "LeverState": seen.levers_age_s}
    ages["MachineStatus"] = seen.status_age_s
    ages["ValveFeedback"] = seen.feedback_age_s
    for message, age_s in ages.items():
        low, high = (0.29, 0.33) if name.startswith(message) else (0.0, 0.03)
        assert low <= age_s <= high


@pytest.mark.parametrize("late_s", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("name", sorted(set(PERIODS_S) - {"ValveFeedback", "GatewayIdentity"}))
def test_the_delay_of_any_message_is_part_of_its_age(
    sender: Sender, name: str, late_s: float
) -> None:
    sender.go(late_s, name)
    sender.go(0.1, late_s={name: late_s})
    seen = sender.seen()
    age_s = seen.joints_age_s if name.startswith("JointPos") else seen.status_age_s
    age_s = seen.levers_age_s if name == "LeverState" else age_s
    # a message of 20 ms may be that much older, and a stamp by its resolution of 8 ms
    assert late_s - 0.002 <= age_s <= late_s + 0.03
    state = sender.state()
    assert late_s - 0.002 <= state.held_up_s <= late_s + 0.02
    times = {"LeverState": state.levers_t_s, "MachineStatus": state.status_t_s}
    assert sender.now_s - times.get(name, state.q_t_s) == pytest.approx(age_s)
    assert seen.trusted


def test_the_delay_of_the_feedback_is_known_too(sender: Sender) -> None:
    sender.go(0.2, "ValveFeedback")
    sender.go(0.1, late_s={"ValveFeedback": 0.2})
    assert sender.now_s - sender.state().flow_t_s == pytest.approx(0.2, abs=0.04)


def test_a_delay_of_all_messages_stays_known(sender: Sender) -> None:
    late_s = dict.fromkeys(PERIODS_S, 0.3)
    sender.go(2.0, late_s=late_s)
    assert sender.seen().joints_age_s > 0.28


@pytest.mark.parametrize("name", ["LeverState", "JointPos1"])
def test_a_stamp_from_the_future_is_dropped_and_said(sender: Sender, name: str) -> None:
    assert sender.send(name, late_s=-10.3) is MessageFault.EARLY
    sender.go(0.1)
    seen = sender.seen()
    assert seen.trusted and seen.levers_age_s < 0.03 and seen.joints_age_s < 0.02
    assert sender.state().held_up_s < 0.03 and sender.state().refused == 1


def test_a_gateway_whose_clock_is_set_back_is_believed_again_after_a_press(sender: Sender) -> None:
    late_s = dict.fromkeys(PERIODS_S, 0.3)
    sender.go(2.0, late_s=late_s)
    assert sender.seen().joints_age_s > 0.28
    sender.values["DeadMan"] = 0
    sender.go(0.1, late_s=late_s)
    sender.values["DeadMan"] = 1
    sender.send("LeverState", late_s=0.3)
    # Commands carry what the gateway said last, from this moment on.
    assert sender.receiver.stamp_s == pytest.approx((sender.now_s + 39.7) % 65.536, abs=0.02)
    sender.go(0.1, late_s=late_s)
    seen = sender.seen()
    assert seen.joints_age_s < 0.02 and seen.status_age_s < 0.03 and seen.trusted


def test_other_descriptions_and_machines_are_noticed(sender: Sender) -> None:
    assert sender.seen().described is True
    for name in ("DescriptionHash", "MachineHash"):
        sender.send("GatewayIdentity", **{name: BUS.identity[name] ^ 1})
        assert sender.seen().described is False
        sender.send("GatewayIdentity")
    assert Sender().seen().described is None


def test_the_newest_stamp_of_the_gateway_goes_into_commands(sender: Sender) -> None:
    sender.send("JointPos3")
    assert sender.receiver.stamp_s == pytest.approx((sender.now_s + 40.0) % 65.536, abs=1e-3)
    before = sender.receiver.stamp_s
    sender.send("LeverState")
    sender.send("ValveFeedback")
    assert sender.receiver.stamp_s == before, "those of others are coarser"


@pytest.mark.parametrize("name", sorted(set(PERIODS_S) - {"ValveFeedback", "GatewayIdentity"}))
def test_two_wrong_messages_of_a_needed_name_cost_the_trust(sender: Sender, name: str) -> None:
    for number in range(2):
        assert sender.seen().trusted
        frame = sender.build(name)
        wrong = replace(frame, data=bytes([frame.data[0] ^ 1, *frame.data[1:]]))
        assert sender.receiver.take(wrong, sender.now_s) is MessageFault.CRC
        assert sender.state().refused == number + 1
    assert not sender.seen().trusted and not sender.state().trusted
    sender.go(25 * PERIODS_S[name] - 0.02)
    assert not sender.seen().trusted
    sender.go(0.04)
    assert sender.seen().trusted


def test_every_message_that_is_asked_for_is_received_and_valve_commands_of_others(
    sender: Sender,
) -> None:
    ids = {BUS.layouts[name].frame_id for name in PERIODS_S}
    assert set(sender.receiver.frame_ids) == ids | {BUS.command.frame_id}
    heartbeat = BUS.layouts["PcHeartbeat"]
    before = sender.state().frames
    assert sender.receiver.take(CanFrame(heartbeat.frame_id, b""), sender.now_s) is None
    assert sender.state().frames == before and sender.seen().alone


def test_a_refused_message_is_not_used_but_counted(sender: Sender) -> None:
    frame, before = sender.build("MachineStatus", EStop=1), sender.state()
    short = replace(frame, data=frame.data[:-1])
    assert sender.receiver.take(short, sender.now_s) is MessageFault.LENGTH
    sender.counters["MachineStatus"] -= 2
    assert sender.send("MachineStatus", EStop=1) is MessageFault.REPEATED
    after = sender.state()
    assert not after.estop and after.refused == 2 and after.frames == before.frames + 2


def test_lost_messages_of_all_channels_are_counted(sender: Sender) -> None:
    sender.counters["JointPos1"] += 2
    sender.counters["LeverState"] += 1
    sender.now_s += 0.02
    assert sender.send("JointPos1") is None and sender.send("LeverState") is None
    assert sender.state().lost == 3


def test_another_commander_is_remembered_for_a_second_and_own_commands_are_known(
    sender: Sender,
) -> None:
    receiver = sender.receiver
    own = [BUS.encode("ValveCmd", {"CommandMode": 1}, number) for number in range(10)]
    for data in own:
        receiver.note_own_command(data, sender.now_s)
    for data in own[2:]:
        receiver.take(CanFrame(BUS.command.frame_id, data), sender.now_s)
    assert sender.seen().alone
    receiver.take(CanFrame(BUS.command.frame_id, own[1]), sender.now_s)
    assert not sender.seen().alone and not sender.state().alone, "a late copy of an own command"
    sender.go(0.99)
    assert not sender.seen().alone
    sender.go(0.03)
    assert sender.seen().alone and sender.state().alone


def test_the_state_is_a_copy(sender: Sender) -> None:
    state = sender.state()
    before = state.q.copy(), state.flow_sum.copy()
    sender.go(0.05)
    sender.send("JointPos1", Position_q1=HOME["Position_q1"] + 0.001)
    sender.send("ValveFeedback", Flow_q1=0.5)
    assert (state.q == before[0]).all() and (state.flow_sum == before[1]).all()


def _build_bus(tmp_path: Any, *lines: str) -> BusDescription:
    """Return the example bus without the signals that stand in `lines`."""
    kept = [text for text in DBC_TEXT.splitlines() if not any(line in text for line in lines)]
    return build_other_bus(tmp_path, "\n".join(kept))


def test_a_bus_without_stamps_counts_ages_from_arrival(tmp_path: Any) -> None:
    sender = Sender(_build_bus(tmp_path, " SG_ Stamp ", "RoundTrip"))
    sender.go(0.5)
    sender.go(0.1, late_s=dict.fromkeys(PERIODS_S, 0.4))
    seen = sender.seen()
    assert seen.joints_age_s == seen.levers_age_s == seen.status_age_s == 0.0
    assert seen.round_trip_s == 0.0 and seen.trusted
    assert sender.state().flow_t_s == sender.now_s and sender.receiver.stamp_s == 0.0


def test_a_message_without_protection_is_taken_as_it_comes(tmp_path: Any) -> None:
    sender = Sender(_build_bus(tmp_path, '"E2EDataId" BO_ 2365592835 '))
    sender.go(0.3)
    assert "ValveFeedback" not in sender.receiver.channels
    assert sender.state().flow_number == 15 and sender.seen().trusted
    short = replace(sender.build("ValveFeedback"), data=b"")
    assert sender.receiver.take(short, sender.now_s) is MessageFault.LENGTH
    assert sender.state().refused == 1 and sender.seen().trusted


def test_channels_that_are_not_needed_cost_no_trust(sender: Sender, tmp_path: Any) -> None:
    bus = _build_bus(tmp_path, " SG_ OilTemperature ")
    other = Sender(bus)
    other.go(0.1)
    assert math.isnan(other.state().oil_c)
    receiver = sender.receiver
    assert set(receiver.channels) == set(PERIODS_S)
    assert all(one.trust is ChannelTrust.VALID for one in receiver.channels.values())
    assert np.isfinite(receiver.q).all()


def test_a_clock_that_is_slewed_makes_no_message_late() -> None:
    sender = Sender()
    # Three minutes of the fastest slew that the kernel allows, 500 ppm.
    for number in range(1800):
        sender.now_s += 0.1
        slewed_s = sender.now_s + 5e-4 * 0.1 * number
        frame = sender.build("MachineStatus")
        assert sender.receiver.take(frame, slewed_s, sender.now_s) is None
    assert sender.receiver.held_up_s < 0.01
    assert sender.receiver.status_t_s == pytest.approx(slewed_s, abs=0.01)
