"""The gateway's rules: who gets the valves, and when nobody does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from composed import MACHINE
from sender import BUS, DBC_TEXT, build_other_bus

from deploy.bus.can_bus import CanFrame
from deploy.bus.description import BusDescription
from deploy.twin.gateway import LEVERS, NOBODY, PC, Gateway, GatewayState

U = {"Command_q1": 0.4, "Command_q3": -0.2}
HELD = {"DeadMan": 1, "RemoteOn": 1}


class Around:
    """Remote and PC around a gateway, each with its counter, on one clock."""

    def __init__(self, bus: BusDescription = BUS) -> None:
        self.bus, self.gateway, self.now_s = bus, Gateway(bus, MACHINE), 500.0
        self.counters = {"ValveCmd": 0, "LeverState": 0}
        self.remote: dict[str, float] = dict(HELD)
        self.command: dict[str, float] = U | {"CommandMode": 1}
        self.late_s = {"ValveCmd": 0.0, "LeverState": 0.0}

    def send(self, name: str, skip: int = 1, **values: float) -> None:
        self.counters[name] += skip
        layout, sent_s = self.bus.layouts[name], self.now_s - self.late_s[name]
        # On the grid of the stamp: the delay is this one and up to one step more.
        known: dict[str, float] = {"Stamp": sent_s - sent_s % (layout.stamp_step_s or 1.0)}
        known |= (self.remote if name == "LeverState" else self.command) | values
        data = self.bus.encode(name, known, self.counters[name])
        self.gateway.take(CanFrame(self.bus.layouts[name].frame_id, data), self.now_s)

    def go(self, seconds: float, *left_out: str) -> None:
        """Let both send every 20 ms, but for some."""
        for _ in range(round(seconds * 50)):
            self.now_s += 0.02
            for name in ("LeverState", "ValveCmd"):
                if name not in left_out:
                    self.send(name)

    def get_going(self) -> Around:
        self.command["CommandMode"] = 0
        self.go(0.2)
        self.command["CommandMode"] = 1
        self.go(0.04)
        assert self.flow() == (pytest.approx([0.4, 0.0, -0.2, 0.0, 0.0]), PC, GatewayState.PC)
        return self

    def stops_within_2_ms(self, state: GatewayState) -> None:
        assert self.flow()[1] == PC
        self.now_s += 0.002
        assert self.is_still(state)
        self.go(0.1)
        assert self.is_still(GatewayState.IDLE)
        self.get_going()

    def flow(self) -> tuple[list[float], int, GatewayState]:
        flow, source, state = self.gateway.decide(self.now_s)
        return flow.tolist(), source, state

    def is_still(self, state: GatewayState) -> bool:
        return self.flow() == ([0.0] * 5, NOBODY, state)


@pytest.fixture
def around() -> Around:
    return Around().get_going()


def test_before_anybody_speaks_nothing_flows() -> None:
    assert Around().is_still(GatewayState.STOPPED)


@pytest.mark.parametrize("cause", ["silence", "estop", "levers", "remote", "corrupt"])
@pytest.mark.parametrize(("idle", "state"), [(2, GatewayState.IDLE), (3, GatewayState.PC)])
def test_after_every_interruption_three_idle_commands_are_wanted_anew(
    around: Around, cause: str, idle: int, state: GatewayState
) -> None:
    if cause == "silence":
        around.go(0.1, "ValveCmd")
    elif cause == "corrupt":
        for _ in range(2):
            around.gateway.take(CanFrame(BUS.command.frame_id, bytes(8)), around.now_s)
        # the twenty-fifth good message is the first that is used again
        around.go(0.5)
    else:
        around.gateway.estop = cause == "estop"
        around.remote["Lever_left_theta"] = 0.5 * (cause == "levers")
        around.remote["RemoteOn"] = int(cause != "remote")
        around.go(0.02)
        assert around.flow()[1] != PC
    around.gateway.estop = False
    around.remote |= {"Lever_left_theta": 0, "RemoteOn": 1}
    around.go(0.02)
    assert around.is_still(GatewayState.IDLE)
    around.command["CommandMode"] = 0
    around.go(0.02 * idle)
    around.command["CommandMode"] = 1
    around.go(0.02)
    assert around.flow()[2] is state


def test_numbers_on_the_bus_mean_what_the_description_says() -> None:
    signals = BUS._messages["MachineStatus"]
    states = signals.get_signal_by_name("GatewayState").choices
    sources = signals.get_signal_by_name("FlowSource").choices
    described = {number: str(name) for number, name in states.items()}
    assert {one.value: one.name.lower() for one in GatewayState} == described
    described = {number: str(name) for number, name in sources.items()}
    assert described == {NOBODY: "nobody", LEVERS: "levers", PC: "pc"}


def test_only_commands_measure_the_way_there_and_back(around: Around) -> None:
    around.late_s["LeverState"] = 0.1
    around.send("LeverState")
    assert around.gateway.round_trip_s < 0.017


def test_a_gateway_of_a_bus_without_stamps_knows_no_delay(tmp_path: Path) -> None:
    lines = [line for line in DBC_TEXT.splitlines() if " SG_ Stamp " not in line]
    around = Around(build_other_bus(tmp_path, "\n".join(lines)))
    around.late_s = dict.fromkeys(around.late_s, 0.6)
    around.get_going()
    assert around.gateway.round_trip_s == 0.0


def test_a_released_dead_man_stops(around: Around) -> None:
    around.remote["DeadMan"] = 0
    around.go(0.02)
    assert around.is_still(GatewayState.IDLE)


def test_commands_that_stay_away_stop_and_want_idle_frames_again(around: Around) -> None:
    around.now_s += 0.069
    around.send("LeverState")
    around.stops_within_2_ms(GatewayState.TIMEOUT)


def test_a_remote_that_stays_away_or_is_off_stops_and_wants_idle_frames_again(
    around: Around,
) -> None:
    for _ in range(6):
        around.now_s += 0.02
        around.send("ValveCmd")
    around.now_s += 0.009
    around.stops_within_2_ms(GatewayState.STOPPED)
    around.send("LeverState", RemoteOn=0)
    assert around.is_still(GatewayState.STOPPED)


@pytest.mark.parametrize("deflection", [0.5, -0.5])
def test_the_levers_win_and_the_pc_begins_again(around: Around, deflection: float) -> None:
    around.remote["Lever_left_theta"] = deflection
    around.go(0.02)
    flow, source, state = around.flow()
    moved = np.flatnonzero(flow)
    assert (source, state, len(moved)) == (LEVERS, GatewayState.LEVERS, 1)
    assert abs(flow[moved[0]]) == pytest.approx(0.5, abs=0.01)
    around.remote["Lever_left_theta"] = 0.0
    around.go(0.1)
    assert around.is_still(GatewayState.IDLE)
    around.remote["Lever_left_theta"] = 0.03
    around.get_going()
    around.remote |= {"Lever_left_theta": 0.032, "DeadMan": 0}
    around.go(0.02)
    assert around.flow()[1] == LEVERS, "the levers need no dead-man"


def test_the_right_button_selects_the_exclusive_joint(around: Around) -> None:
    assert not around.gateway.exclusive_selected
    around.remote |= {"Lever_right_theta": 0.5, "ButtonRight": 1}
    around.go(0.02)
    assert around.gateway.exclusive_selected and abs(around.flow()[0][1]) > 0.4


def test_the_exclusive_joint_moves_alone(around: Around) -> None:
    for others in (U, {"Command_q3": 0}):
        around.command |= {"Command_q2": 0.4} | others
        around.go(0.02)
        assert around.is_still(GatewayState.IDLE)
    around.command |= {"Command_q1": 0, "Command_q3": 0}
    around.go(0.02)
    assert around.flow()[:2] == (pytest.approx([0, 0.4, 0, 0, 0]), PC)


@pytest.mark.parametrize("name", ["ValveCmd", "LeverState"])
def test_two_wrong_messages_stop_and_half_a_second_of_good_ones_is_wanted(
    around: Around, name: str
) -> None:
    for _ in range(2):
        assert around.flow()[1] == PC
        around.gateway.take(CanFrame(BUS.layouts[name].frame_id, bytes(8)), around.now_s)
    stopped = GatewayState.TIMEOUT if name == "ValveCmd" else GatewayState.STOPPED
    assert around.is_still(stopped)
    around.command["CommandMode"] = 0
    around.go(0.48)
    assert around.is_still(stopped)
    around.get_going()


@pytest.mark.parametrize(
    ("name", "limit_s", "state"),
    [("ValveCmd", 0.15, GatewayState.TIMEOUT), ("LeverState", 0.13, GatewayState.STOPPED)],
)
def test_messages_with_an_old_stamp_are_refused(
    name: str, limit_s: float, state: GatewayState
) -> None:
    for late_s, is_moving in ((limit_s - 0.02, True), (limit_s + 0.02, False)):
        around = Around()
        around.late_s[name] = late_s
        around.command["CommandMode"] = 0
        around.go(0.6)
        around.command["CommandMode"] = 1
        around.go(0.1)
        assert (around.flow()[1] == PC) == is_moving
        assert is_moving or around.is_still(state)


def test_the_way_there_and_back_is_measured_on_commands(around: Around) -> None:
    gateway = around.gateway
    assert Gateway(BUS, MACHINE).report_round_trip_s(500.0) == 0.51
    around.late_s["ValveCmd"] = 0.1
    around.go(0.02)
    assert gateway.report_round_trip_s(around.now_s) == pytest.approx(0.1, abs=0.017)
    around.late_s["ValveCmd"] = 0.3
    around.go(0.02)
    assert gateway.report_round_trip_s(around.now_s) == pytest.approx(0.3, abs=0.017)
    around.late_s["ValveCmd"] = 0.7
    around.go(0.02)
    assert gateway.report_round_trip_s(around.now_s) == 0.51
    around.late_s["ValveCmd"] = 0.0
    around.go(0.02)
    assert gateway.report_round_trip_s(around.now_s + 1.0) < 0.02
    assert gateway.report_round_trip_s(around.now_s + 1.001) == 0.51


def test_a_stamp_of_this_very_moment_is_not_a_second_old(around: Around) -> None:
    for _ in range(200):
        around.now_s = round(around.now_s + 0.02, 3)
        around.now_s -= around.now_s % 0.016
        around.send("ValveCmd")
        assert around.gateway.round_trip_s < 0.017


def test_the_pc_is_heard_anew_after_a_second_of_silence(around: Around) -> None:
    first_s = around.gateway.heard_s
    assert 500.0 < first_s < 500.1
    around.go(0.5)
    assert around.gateway.heard_s == first_s
    around.go(1.02, "ValveCmd")
    around.go(0.02)
    assert around.gateway.heard_s == around.now_s


def test_messages_of_others_are_not_for_the_gateway(around: Around) -> None:
    for name in ("JointPos1", "MachineStatus", "PcHeartbeat"):
        frame = CanFrame(BUS.layouts[name].frame_id, BUS.encode(name, {"EStop": 1}, 0))
        around.gateway.take(frame, around.now_s)
    around.gateway.take(CanFrame(0x123, b""), around.now_s)
    assert around.flow()[1] == PC
    frame = CanFrame(BUS.command.frame_id, b"")
    around.gateway.take(replace(frame, data=b"\x00"), around.now_s)
    assert around.flow()[1] == PC, "one wrong message is borne"
