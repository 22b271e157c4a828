"""Reaction times, with real processes on a multicast bus, and on SocketCAN where the kernel has `vcan`.

A few trials each; benchmarks/deploy/reactions.py makes sixty.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from composed import option
from desk import COMMAND, NO_VCAN, VCAN, Desk

from brokk_rl.machine import Machine
from deploy.kernel.guard import GuardState

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")
SLACK = 3.0 if os.environ.get("CI") or os.cpu_count() == 2 else 1.0
"""On shared cores a process without real-time priority may be late itself; the figures proper are
the benchmark's."""


BUSES = [
    "udp",
    pytest.param("vcan", marks=pytest.mark.skipif(NO_VCAN, reason=f"this kernel has no {VCAN}")),
]


@pytest.fixture(scope="module", params=BUSES)
def desk(
    machine: Machine, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[Desk]:
    with pytest.MonkeyPatch.context() as patch:
        folders = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        patch.setenv("PYTHONPATH", os.pathsep.join(folders))
        limits, folder = option("guard", "default"), tmp_path_factory.mktemp("desk")
        with Desk(machine, limits, folder, kind=request.param) as made:
            for name in ("twin", "bus", "page", "commander"):
                made.start(name)
            made.wait_for_state()
            yield made


def test_nothing_moves_before_it_is_armed_and_the_dead_man_pressed(desk: Desk) -> None:
    desk.fault("none")
    desk.arm(False)
    time.sleep(0.1)
    assert not desk.moves() and not desk.heard("ValveCmd", 0.2)
    desk.arm()
    time.sleep(0.3)
    assert not desk.moves() and desk.heard("ValveCmd", 0.2)


FAULTS = [  # the whole catalogue; the normal suite tries those without a mark
    ("estop", "", 0.02),
    ("deadman_released", "", 0.02),
    pytest.param("remote_off", "", 0.02, marks=pytest.mark.slow),
    ("drop", "JointPos1", 0.15),
    pytest.param("drop", "LeverState", 0.15, marks=pytest.mark.slow),
    pytest.param("drop", "MachineStatus", 0.15, marks=pytest.mark.slow),
    ("corrupt", "JointPos2", 0.1),
    pytest.param("freeze_counter", "JointPos1", 0.1, marks=pytest.mark.slow),
    pytest.param("masquerade", "MachineStatus", 0.1, marks=pytest.mark.slow),
    pytest.param("short", "LeverState", 0.1, marks=pytest.mark.slow),
    pytest.param("wrong_id", "JointPos1", 0.15, marks=pytest.mark.slow),
    ("delay", "JointPos2", 0.15),
    ("jump", "", 0.03),
    pytest.param("out_of_range", "", 0.03, marks=pytest.mark.slow),
    pytest.param("invalid", "", 0.03, marks=pytest.mark.slow),
    ("second_sender", "", 0.03),
    ("second_remote", "", 0.1),
    pytest.param("silent", "", 0.2, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("fault", "message", "limit_s"), FAULTS)
def test_a_fault_stops_the_machine_in_time(
    desk: Desk, fault: str, message: str, limit_s: float
) -> None:
    desk.set_moving()
    since_s = desk.fault(fault, message)
    found_s = _stopped(desk, fault, since_s)
    # before the fault ends: the twin's person may press again at once
    state = desk.memory.state.read()
    desk.fault("none")
    assert found_s <= limit_s + 0.02 * SLACK
    assert state is not None and state.guard in (GuardState.LATCHED, GuardState.READY)


def test_the_pages_stop_needs_nobody_but_the_bus_process(desk: Desk) -> None:
    desk.set_moving()
    since_s = desk.press_stop()
    assert desk.still_after(since_s, 0.6).flow_s <= 0.02 + 0.02 * SLACK
    state = desk.memory.state.read()
    assert state is not None and state.guard is GuardState.SILENT


def _stopped(desk: Desk, fault: str, since_s: float) -> float:
    if fault == "silent":  # the gateway says nothing either: what the guard sends decides
        while time.monotonic() < since_s + 1.0:
            state = desk.memory.state.read()
            if state is not None and not any(state.sent):
                return time.monotonic() - since_s
            time.sleep(0.001)
    return desk.still_after(since_s, 0.6).flow_s


def test_the_operators_lever_always_wins(desk: Desk) -> None:
    desk.set_moving()
    desk.fault("lever")
    time.sleep(0.1)
    heard, told = desk.heard("ValveFeedback", 0.1), desk.heard("MachineStatus", 0.1)
    desk.fault("none")
    assert heard and all(values["Flow_q1"] == 0 and values["Flow_q4"] > 0.4 for _, values in heard)
    assert told and all(values["FlowSource"] == 1 for _, values in told)
    state = desk.memory.state.read()
    assert state is not None and not state.sent.any()


@pytest.mark.parametrize("fault", ["drop_some", "duplicate"])
def test_what_a_bus_does_now_and_then_is_borne_or_ends_in_zero_but_is_never_used(
    desk: Desk, fault: str
) -> None:
    desk.set_moving()
    desk.fault(fault, "JointPos1", 0.5)
    time.sleep(0.5)
    state = desk.memory.state.read()
    assert state is not None and (state.lost > 0 or state.refused > 0)
    assert bool(state.q_plausible)


@pytest.mark.parametrize("name", ["commander", "bus", "page"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_process_that_dies_or_hangs_stops_the_machine(
    desk: Desk, name: str, number: signal.Signals, record_property: Callable[[str, object], None]
) -> None:
    desk.set_moving()
    since_s = desk.signal(name, number)
    found_s = desk.still_after(since_s).flow_s
    if number == signal.SIGSTOP:
        desk.signal(name, signal.SIGCONT)
        time.sleep(0.2)
        assert not desk.moves()  # what wakes up late begins anew
    else:
        desk.children[name].end(1.0)
        desk.start(name)
        desk.wait_for_state()
    record_property(f"processes: {name} {number.name}; no flow, ms", round(1e3 * found_s, 1))
    assert found_s <= 0.1 + 0.02 * SLACK


def test_what_is_shown_says_who_has_the_valves(desk: Desk) -> None:
    desk.set_moving()
    state = desk.memory.state.read()
    assert (
        state is not None
        and state.guard is GuardState.ACTIVE
        and desk.memory.read_snapshot().commands
    )
    assert [round(abs(u), 3) for u in state.sent] == [round(abs(u), 3) for u in COMMAND]
