"""Reaction times, with real processes on a multicast bus, and on SocketCAN where the kernel has `vcan`.

A few faults; the whole catalogue is tried on a clock of its own (`test_deploy_faults.py`).
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from composed import MACHINE, option
from conftest import Note
from desk import NO_VCAN, VCAN, Desk

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
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[Desk]:
    with pytest.MonkeyPatch.context() as patch:
        folders = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        patch.setenv("PYTHONPATH", os.pathsep.join(folders))
        limits, folder = option("guard", "default"), tmp_path_factory.mktemp("desk")
        with Desk(MACHINE, limits, folder, kind=request.param) as made:
            for name in ("twin", "bus", "page", "commander"):
                made.start(name)
            made.wait_for_state()
            yield made


@pytest.mark.parametrize(
    ("fault", "message", "limit_s"),
    [("estop", "", 0.02), ("drop", "JointPos1", 0.15), ("second_remote", "", 0.1)],
)
def test_a_fault_stops_the_machine_in_time(
    desk: Desk, fault: str, message: str, limit_s: float
) -> None:
    desk.set_moving()
    since_s = desk.fault(fault, message)
    found_s = desk.still_after(since_s, 0.6).flow_s
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


@pytest.mark.parametrize("name", ["commander", "bus", "page"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_process_that_dies_or_hangs_stops_the_machine(
    desk: Desk, name: str, number: signal.Signals, record_property: Note
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
