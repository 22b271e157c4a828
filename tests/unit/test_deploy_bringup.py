"""Bring-up: what a joint's answer says, and the whole checklist with real processes and a scripted operator."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from composed import MACHINE
from conftest import Brokk
from desk import DBC, build_twin, free_port, wire

from actuators.excite.player import NominalMachine
from brokk_rl.errors import ConfigError
from deploy.bringup import JointResponse, _StateChecks, describe_joint, find_pushes
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import BusDescription
from deploy.twin.rehearsal import RehearsalBench, ScriptedPerson
from deploy.twin.remote import RadioRemote

T_S = np.arange(0, 40, 0.01)


def sample_machine(dead_s: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and flow of a machine whose valves are pushed one after the other, both ways."""
    flow = np.zeros((len(T_S), MACHINE.num_joints))
    for joint in range(MACHINE.num_joints):
        since_s = T_S - 8.0 * joint
        flow[(since_s > 1) & (since_s < 1.6), joint] = 0.5
        flow[(since_s > 4) & (since_s < 4.6), joint] = -0.5
    q = np.zeros_like(flow)
    for joint, speed in enumerate(MACHINE.max_speed):
        late = np.interp(T_S - dead_s, T_S, flow[:, joint])
        q[:, joint] = np.cumsum(speed * late) * 0.01 + 0.0003 * np.sin(97 * T_S)
    return q, flow


def describe(q: np.ndarray, flow: np.ndarray) -> dict[str, JointResponse | None]:
    pushes, names = find_pushes(T_S, q, flow, MACHINE), MACHINE.joint_names
    return {name: describe_joint(pushes, j, names) for j, name in enumerate(names)}


@pytest.mark.parametrize("dead_s", [0.1, 0.55])
def test_a_sound_machine_has_no_faults_and_its_dead_time_is_measured(dead_s: float) -> None:
    for joint, found in enumerate(describe(*sample_machine(dead_s)).values()):
        assert found is not None and not found.faults
        assert found.dead_time_s == pytest.approx(dead_s, abs=0.03)
        assert found.speed == pytest.approx(0.5 * MACHINE.max_speed[joint], rel=0.05)
        assert found.ratio == pytest.approx(1.0, abs=0.05)


def swap_sensors(q: np.ndarray) -> None:
    q[:, [0, 4]] = q[:, [4, 0]]


def turn_sensor(q: np.ndarray) -> None:
    q[:, 2] *= -1


def double_sensor(q: np.ndarray) -> None:
    q[:, 3] *= 2


def repeat_sensor(q: np.ndarray) -> None:
    q[:, 3] = q[:, 2] + q[:, 3]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (swap_sensors, {"q1": "the valve of q1 moves q5", "q5": "the valve of q5 moves q1"}),
        (turn_sensor, {"q3": "q3 is turned: it moves against its flow"}),
        (double_sensor, {"q4": "q4 is doubled: it moves 2.0 times as fast as the machine's file"}),
        (repeat_sensor, {"q3": "the valve of q3 moves q3 and q4"}),
    ],
)
def test_swapped_turned_and_doubled_joints_are_named_and_no_others(
    spoil: Callable[[np.ndarray], None], told: dict[str, str]
) -> None:
    q, flow = sample_machine()
    spoil(q)
    for name, found in describe(q, flow).items():
        assert found is not None and len(found.faults) == (name in told), found
        if name in told:
            assert found.faults[0].startswith(told[name])


def test_a_joint_that_moved_one_way_only_or_not_at_all_says_nothing() -> None:
    q, flow = sample_machine()
    pushed = describe(q[:350], flow[:350])
    assert set(pushed.values()) == {None}
    assert not find_pushes(T_S, np.zeros_like(q), flow, MACHINE)
    assert not find_pushes(T_S[:50], q[:50], flow[:50], MACHINE)


def test_valves_that_are_pushed_together_say_nothing() -> None:
    q, flow = sample_machine()
    assert not find_pushes(T_S[:700], q[:700], flow[:700] + flow[:700, :1], MACHINE)


@pytest.mark.parametrize(("offset", "told"), [(0.1, "q3 has an offset of +0.100"), (0.02, None)])
def test_an_offset_to_the_pose_measured_by_hand_is_named(offset: float, told: str | None) -> None:
    pose = tuple(MACHINE.home.tolist())
    checklist = SimpleNamespace(pose=pose, pose_error=0.03)
    checks = _StateChecks(checklist, MACHINE, SimpleNamespace(memory=None), print)  # type: ignore[arg-type]
    found = checks._list_offsets(np.add(MACHINE.home, [0, 0, offset, 0, 0]))
    assert found == ([told] if told else [])


@pytest.mark.parametrize(("dead_s", "passed"), [(0.64, True), (0.66, False)])
def test_a_dead_time_beyond_the_commands_of_the_history_fails_the_check(
    dead_s: float, passed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # 13 commands of 50 ms: the oldest began 0.65 s before the newest position.
    checks = _StateChecks(SimpleNamespace(), MACHINE, SimpleNamespace(memory=None), print)  # type: ignore[arg-type]
    found = {}
    for name in MACHINE.joint_names:
        found[name] = JointResponse(name, (name,), True, 0.5, 0.2, 1.0)
    found["q2"] = replace(found["q2"], dead_time_s=dead_s)
    monkeypatch.setattr(checks, "_watch_joints", lambda: found)
    assert checks._check_joints().passed is passed


def test_a_remote_is_silent_until_it_has_heard_the_gateway() -> None:
    """Its stamps would jump at the first message it hears, and look like those of late copies."""
    description = BusDescription(DBC, MACHINE)
    remote = RadioRemote(description, MACHINE)
    status = description.layouts[description.message_of("EStop")]
    assert not remote.is_ready
    remote.hear(CanFrame(status.frame_id, bytes(8)))
    assert not remote.is_ready  # its CRC is wrong
    # A gateway whose clock is set back gets the stamp that it has sent last, and goes on.
    for stamp_s in (1.9, 0.9):
        told = description.encode(status.name, {"Stamp": stamp_s}, 0)
        remote.hear(CanFrame(status.frame_id, told))
        assert remote.is_ready
        values = description.decode(remote._layout, remote.build_frame().data)
        assert values["Stamp"] == pytest.approx(stamp_s, abs=0.01)


def sample_person(fails: str | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A round of the scripted person: commands, dead-man and emergency stop every 20 ms."""
    person = ScriptedPerson(MACHINE, fails, 1.0, 43210)
    times = np.arange(0.0, person.round_s, 0.02)
    held = [[person.holds(name, t_s) for t_s in times] for name in ("dead-man", "e-stop")]
    return np.array([person.command(t_s) for t_s in times]), *map(np.array, held)


def test_a_scripted_person_does_all_that_the_checklist_asks() -> None:
    commands, deadman, estop = sample_person(None)
    assert (commands.max(0) > 0.5).all() and (commands.min(0) < -0.5).all()
    # Upwards first: positive commands lower the arm, and home is near the ground.
    assert (commands[np.argmax(commands != 0, axis=0), range(5)] < 0).all()
    # Each joint moves alone, and nothing moves while a switch is pressed.
    moves = commands != 0
    assert (moves.sum(1) <= 1).all()
    assert deadman.any() and estop.any() and not (deadman | estop)[moves.any(1)].any()
    # At rest for a second before each motion, as long as the slowest answer.
    begins = np.flatnonzero(moves.any(1)[1:] & ~moves.any(1)[:-1]) + 1
    for begin in begins:
        assert not moves[begin - 50 : begin].any()
    person = ScriptedPerson(MACHINE, None, 1.0, 43210)
    assert not person.command(-1.0).any() and not person.holds("dead-man", -person.round_s + 0.5)
    remote = RadioRemote(BusDescription(DBC, MACHINE), MACHINE)
    person.move(remote, 2.2 + 1.2)
    assert min(remote.levers) == pytest.approx(-0.6) and not remote.button_right
    person.move(remote, 2.2 + 4.8 + 1.2)
    assert remote.button_right and sum(one != 0 for one in remote.levers) == 1
    person.move(remote, 0.5)
    assert remote.deadman and not any(remote.levers)


def test_a_rehearsal_without_remote_fault_port_or_check_is_refused() -> None:
    twin = build_twin(wire("udp"), remote=False, fault_port=43210)
    bench = RehearsalBench(twin=twin, plant=NominalMachine(), rest_s=1.0, fails=None)  # type: ignore[arg-type]
    found = bench.companions(MACHINE, None)  # type: ignore[arg-type]
    assert [one.name for one in found] == ["twin", "operator"]
    for change in ({"twin": replace(twin, remote=True)}, {"twin": replace(twin, fault_port=None)}):
        with pytest.raises(ConfigError, match=r"twin\.remote=false and a twin\.fault_port"):
            replace(bench, **change)
    with pytest.raises(ConfigError, match="there is no check 'estop'"):
        replace(bench, fails="estop")


@pytest.mark.slow
@pytest.mark.parametrize("fails", [None, "e-stop"])
def test_the_checklist_finds_a_sound_machine_and_a_check_that_fails(
    brokk: Brokk, tmp_path: Path, fails: str | None
) -> None:
    brokk(
        "mode=bringup", "bus=udp", "bus.channel=239.74.163.78", f"bus.port={free_port()}", "bench=operator",
        f"bench.twin.fault_port={free_port()}", f"bench.fails={fails or 'null'}", "bench.rest_s=3", "link=nominal",
        "bringup.listen_s=1", "bringup.shadow_s=3", "bringup.patience_s=60", "bringup.quiet=1", "bringup.rate=0.5",
        "bringup.realtime=false", "guard.observer=null",  # its file is of the hydraulic plant
        "session.out=report", code=2 if fails else 0,
    )  # fmt: skip
    report = json.loads((tmp_path / "report/bringup.json").read_text())
    findings = {one["check"]: one for one in report["findings"]}
    assert list(findings) == ["bus", "positions", "dead-man", "e-stop", "joints", "shadow"]
    failed = [name for name, one in findings.items() if not one["passed"]]
    assert failed == ([fails] if fails else [])
    joint = findings["joints"]["values"]["q1"]
    assert joint["dead_time_s"] == pytest.approx(MACHINE.dead_time_s, abs=0.1)
