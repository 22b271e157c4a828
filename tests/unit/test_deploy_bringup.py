"""Bring-up: what a joint's answer says, and the whole checklist with real processes and a scripted operator."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from desk import DBC, free_port

from actuators.excite.player import NominalMachine
from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from deploy.bringup import BringupResult, measure_joint_response
from deploy.bus.can_bus import CanBus
from deploy.bus.description import BusDescription
from deploy.modes.bringup import BringupMode
from deploy.runtime.process import ChildProcess, CycleTimer
from deploy.twin.faults import request_fault
from deploy.twin.remote import RadioRemote
from deploy.twin.twin import Twin

T_S = np.arange(0, 12, 0.01)


def answer(sign: float, dead_s: float, speed: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and flow of a joint that is pushed one way and then the other, two seconds each."""
    flow = 0.5 * ((T_S > 1) & (T_S < 3)) - 0.5 * ((T_S > 7) & (T_S < 9))
    late = np.interp(T_S - dead_s, T_S, flow)
    return np.cumsum(sign * speed / 0.5 * late) * 0.01 + 0.0005 * np.sin(97 * T_S), flow


@pytest.mark.parametrize("dead_s", [0.1, 0.55])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sign_dead_time_and_speed_of_a_joint_are_found(sign: float, dead_s: float) -> None:
    q, flow = answer(sign, dead_s)
    found = measure_joint_response(T_S, q, flow, travel=2.0)
    assert found is not None and found.agrees is (sign > 0)
    assert found.dead_time_s == pytest.approx(dead_s, abs=0.02) and found.speed == pytest.approx(
        0.2, abs=0.02
    )


def test_a_joint_that_moved_one_way_only_or_not_at_all_says_nothing() -> None:
    q, flow = answer(1.0, 0.5)
    assert measure_joint_response(T_S[:600], q[:600], flow[:600], 2.0) is None
    assert measure_joint_response(T_S, np.zeros_like(q), flow, 2.0) is None


def operator(stop: threading.Event, wire: CanBus, port: int, machine: Machine) -> None:
    """Does what the checklist asks for: dead-man, emergency stop, then each joint both ways."""
    remote = RadioRemote(BusDescription(DBC, machine))
    begun_s, asked = time.monotonic(), False
    with wire.open(remote.frame_ids) as bus:
        pace = CycleTimer(remote.period_s)
        while not stop.is_set():
            while (left_s := pace.next_s - time.monotonic()) > 0:
                frame = bus.recv(left_s)
                if frame is not None:
                    remote.hear(frame, time.monotonic())
            pace.begin()
            t_s = (
                time.monotonic() - begun_s
            ) % 9.6  # first q1, q3, q4 and q5 together, then q2 with the button
            remote.deadman = 0.5 < t_s % 2 < 1.0
            if int(t_s) % 4 == 1 and not asked:
                with contextlib.suppress(TimeoutError):
                    request_fault(port, {"fault": "estop", "seconds": 0.3})
            asked = int(t_s) % 4 == 1
            part, remote.button_right = t_s % 4.8, t_s >= 4.8
            pushed = (0.6 if part < 2.0 else -0.6) if 1.0 < part < 1.6 or 3.4 < part < 4.0 else 0.0
            remote.levers = (0.0, 0.0, pushed, 0.0) if remote.button_right else (pushed,) * 4
            bus.send(remote.build_frame())


@pytest.mark.slow
def test_the_checklist_runs_with_an_operator_and_finds_a_sound_machine(
    brokk: Callable[..., Any], machine: Machine, tmp_path: Path
) -> None:
    bus_port, port = free_port(), free_port()
    wire = CanBus(
        interface="udp_multicast", channel="239.74.163.77", bitrate=None, port=bus_port, hops=0
    )
    twin = Twin(
        wire=wire,
        dbc=DBC,
        remote=False,
        deadman=False,
        again_s=None,
        fault_port=port,
        seconds=None,
        realtime=False,
    )
    session, stop = Session(out=str(tmp_path / "twin"), seed=0, device="cpu"), threading.Event()
    child = ChildProcess(
        "twin", "deploy.twin.twin:run", (twin, machine, NominalMachine(), session), (), 60
    )
    time.sleep(2.0)
    hands = threading.Thread(target=operator, args=(stop, wire, port, machine))
    hands.start()
    try:
        done = brokk(
            "mode=bringup", "bus=udp", "bus.channel=239.74.163.77", f"bus.port={bus_port}", "bringup.listen_s=1",
            "bringup.shadow_s=3", "bringup.patience_s=60", "bringup.quiet=1", "bringup.rate=0.8", "session.out=report",
        )  # fmt: skip
    finally:
        stop.set()
        hands.join()
        child.end(3.0)
    assert done.code == 0
    findings = {
        one["check"]: one
        for one in json.loads((tmp_path / "report/bringup.json").read_text())["findings"]
    }
    assert list(findings) == ["bus", "positions", "dead-man", "e-stop", "joints", "shadow"]
    failed = {name: one["text"] for name, one in findings.items() if not one["passed"]}
    assert not failed
    assert findings["joints"]["values"]["q1"]["dead_time_s"] == pytest.approx(
        machine.dead_time_s, abs=0.1
    )


@pytest.mark.parametrize("passed", [True, False])
def test_a_check_that_fails_is_an_error_of_the_command(tmp_path: Path, passed: bool) -> None:
    results = [
        BringupResult("bus", True, "fine", {}),
        BringupResult("dead-man", passed, "not seen", {}),
    ]

    class Checklist:
        def run(self, machine: Any, session: Any, say: Any) -> list[BringupResult]:
            return results

    mode = object.__new__(BringupMode)
    for name, value in (
        ("session", Session(out=str(tmp_path), seed=0, device="cpu")),
        ("machine", None),
        ("bringup", Checklist()),
    ):
        object.__setattr__(mode, name, value)
    if passed:
        assert mode.run() == 0.0
        return
    with pytest.raises(LinkError, match=r"1 of 2 checks failed: dead-man"):
        mode.run()


@pytest.mark.slow
def test_a_twin_says_what_it_does(brokk: Callable[..., Any], tmp_path: Path) -> None:
    port = free_port()
    done = brokk(
        "mode=twin", "link=nominal", f"bus.port={port}", "twin.seconds=0.2", "twin.realtime=false",
        "session.out=twin",
    )  # fmt: skip
    assert done.code == 0 and "twin of brokk170 on udp_multicast" in done.err
