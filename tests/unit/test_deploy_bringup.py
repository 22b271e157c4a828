"""Bring-up: what a joint's answer says, and the whole checklist with real processes and a scripted operator."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from composed import option
from desk import DBC, free_port

from actuators.excite.player import NominalMachine
from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from deploy.bringup import BringupResult, JointResponse, _StateChecks, measure_joint_response
from deploy.bus.can_bus import CanBus, CanFrame
from deploy.bus.description import BusDescription
from deploy.kernel.protection import MessageFault
from deploy.modes.bringup import BringupMode
from deploy.runtime.process import ChildProcess, CycleTimer
from deploy.twin.faults import ActiveFaults, request_fault
from deploy.twin.rehearsal import CHECKS, ROUND_S, RehearsalBench, ScriptedPerson
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


@pytest.mark.parametrize(("dead_s", "passed"), [(0.64, True), (0.66, False)])
def test_a_dead_time_beyond_the_commands_of_the_history_fails_the_check(
    dead_s: float, passed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # 13 commands of 50 ms: the oldest began 0.65 s before the newest position.
    machine = option("machine", "brokk170")
    checks = _StateChecks(SimpleNamespace(), machine, SimpleNamespace(memory=None), print)  # type: ignore[arg-type]
    found = {name: JointResponse(True, 0.5, 0.2) for name in machine.joint_names}
    found["q2"] = JointResponse(True, dead_s, 0.2)
    monkeypatch.setattr(checks, "_watch_joints", lambda: found)
    assert checks._check_joints().passed is passed


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
            # First q1, q3, q4 and q5 together, then q2 with the button.
            t_s = (time.monotonic() - begun_s) % 9.6
            remote.deadman = 0.5 < t_s % 2 < 1.0
            if int(t_s) % 4 == 1 and not asked:
                with contextlib.suppress(TimeoutError):
                    request_fault(port, {"fault": "estop", "seconds": 0.3})
            asked = int(t_s) % 4 == 1
            part, remote.button_right = t_s % 4.8, t_s >= 4.8
            pushed = (0.6 if part < 2.0 else -0.6) if 1.0 < part < 1.6 or 3.4 < part < 4.0 else 0.0
            remote.levers = (0.0, 0.0, pushed, 0.0) if remote.button_right else (pushed,) * 4
            if remote.is_ready:
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
        def run(self, machine: Any, session: Any, say: Any, companions: Any) -> list[BringupResult]:
            return results

    mode = object.__new__(BringupMode)
    for name, value in (
        ("session", Session(out=str(tmp_path), seed=0, device="cpu")),
        ("machine", None),
        ("bringup", Checklist()),
        ("bench", None),
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


def test_a_remote_is_silent_until_it_has_heard_the_gateway() -> None:
    """Its stamps would jump at the first message it hears, and look like those of late copies."""
    machine = option("machine", "brokk170")
    description = BusDescription(DBC, machine)
    remote = RadioRemote(description)
    status = description.layouts[description.message_of("EStop")]
    assert not remote.is_ready
    remote.hear(CanFrame(status.frame_id, bytes(8)), 1.0)
    assert not remote.is_ready  # its CRC is wrong
    remote.hear(CanFrame(status.frame_id, description.encode(status.name, {"Stamp": 0.9}, 0)), 1.0)
    assert remote.is_ready
    values = description.decode(remote._layout, remote.build_frame().data)
    assert not isinstance(values, MessageFault)
    assert values["Stamp"] == pytest.approx(0.9, abs=0.01)


def sample_person(fails: str | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A round of the scripted person: commands, dead-man and emergency stop every 20 ms."""
    person = ScriptedPerson(option("machine", "brokk170"), fails)
    times = np.arange(0.0, ROUND_S, 0.02)
    held = [[person.holds(name, t_s) for t_s in times] for name in ("dead-man", "e-stop")]
    return np.array([person.command(t_s) for t_s in times]), *map(np.array, held)


def test_a_scripted_person_does_all_that_the_checklist_asks() -> None:
    commands, deadman, estop = sample_person(None)
    assert (commands.max(0) > 0.5).all() and (commands.min(0) < -0.5).all()
    # Upwards first: positive commands lower the arm, and home is near the ground.
    assert (commands[np.argmax(commands != 0, axis=0), range(5)] < 0).all()
    # q2 moves alone, and nothing moves while a switch is pressed.
    moves = commands != 0
    assert not (moves[:, 1] & moves[:, [0, 2, 3, 4]].any(1)).any()
    assert deadman.any() and estop.any() and not (deadman | estop)[moves.any(1)].any()
    # At rest for a second before each motion, as long as the slowest answer.
    begins = np.flatnonzero(moves.any(1)[1:] & ~moves.any(1)[:-1]) + 1
    for begin in begins:
        assert not moves[begin - 50 : begin].any()
    person = ScriptedPerson(option("machine", "brokk170"), None)
    assert not person.command(-1.0).any() and not person.holds("dead-man", -ROUND_S + 0.5)
    remote = RadioRemote(BusDescription(DBC, option("machine", "brokk170")))
    person.move(remote, 2.2 + 1.2)
    assert min(remote.levers) == pytest.approx(-0.6) and not remote.button_right
    person.move(remote, 2.2 + 4.8 + 1.2)
    assert remote.button_right and sum(one != 0 for one in remote.levers) == 1
    person.move(remote, 0.5)
    assert remote.deadman and not any(remote.levers)


@pytest.mark.parametrize("fails", CHECKS)
def test_a_scripted_person_fails_the_chosen_check_alone(fails: str) -> None:
    sound, chosen = sample_person(None), sample_person(fails)
    person = ScriptedPerson(option("machine", "brokk170"), fails)
    late_s = 4 * ROUND_S
    assert chosen[1].any() == (fails != "dead-man") and chosen[2].any() == (fails != "e-stop")
    same = np.array_equal(sound[0], chosen[0])
    assert same == (fails != "joints") and np.array_equal(sound[0][:, :4], chosen[0][:, :4])
    early, late = person.spoil(0.0, 8.0), person.spoil(late_s, 8.0)
    assert (early is not None) == (fails in ("bus", "positions"))
    assert (late is not None) == (fails in ("bus", "positions", "shadow"))
    for fault in (early, late):
        if fault is not None:
            ActiveFaults().request(json.dumps(fault).encode(), 0.0)


def test_a_rehearsal_without_remote_fault_port_or_check_is_refused() -> None:
    twin = Twin(
        wire=CanBus(interface="virtual", channel="x", bitrate=None, port=None, hops=None), dbc=DBC, remote=False, deadman=True,
        again_s=None, fault_port=43210, seconds=None, realtime=False,
    )  # fmt: skip
    bench = RehearsalBench(twin=twin, plant=NominalMachine(), rest_s=1.0, fails=None)  # type: ignore[arg-type]
    assert [one.name for one in bench.companions(option("machine", "brokk170"), None)] == [
        "twin",
        "operator",
    ]  # type: ignore[arg-type]
    for change in ({"twin": replace(twin, remote=True)}, {"twin": replace(twin, fault_port=None)}):
        with pytest.raises(ConfigError, match=r"twin\.remote=false and a twin\.fault_port"):
            replace(bench, **change)
    with pytest.raises(ConfigError, match="there is no check 'estop'"):
        replace(bench, fails="estop")


@pytest.mark.slow
def test_a_rehearsal_that_fails_a_check_ends_with_an_error(
    brokk: Callable[..., Any], tmp_path: Path
) -> None:
    done = brokk(
        "mode=bringup", "bus=udp", "bus.channel=239.74.163.78", f"bus.port={free_port()}", "bench=operator",
        f"bench.twin.fault_port={free_port()}", "bench.fails=e-stop", "bench.rest_s=3", "link=nominal", "bringup.listen_s=1",
        "bringup.shadow_s=3", "bringup.patience_s=30", "bringup.quiet=1", "bringup.rate=0.5", "bringup.realtime=false",
        "session.out=report",
    )  # fmt: skip
    assert done.code != 0 and "1 of 6 checks failed: e-stop" in done.err
