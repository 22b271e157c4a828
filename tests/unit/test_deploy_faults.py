"""The fault catalogue against every mode: what must stop the machine, what takes the advice away, and what nobody notices.

On a stage with a clock of its own; `test_deploy_processes.py` and `benchmarks/deploy/reactions.py`
do the same with real processes.
"""

from __future__ import annotations

import errno
import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from composed import MACHINE
from stage import DBC, Mode, Stage

from brokk_rl.errors import StorageError
from deploy.recorder import capture_reader
from deploy.recorder.capture import MCAP, CaptureConfig, CaptureWriter
from deploy.recorder.capture import run as record
from deploy.runtime.shm_layout import LoopMemory

MODES = get_args(Mode)
COMMANDING = ("collect", "auto")


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Stage]]:
    # Space and motion of the arm are other tests: here they would take a third of the time.
    found = {
        mode: Stage(MACHINE, mode, tmp_path_factory.mktemp(mode), watched=False) for mode in MODES
    }
    yield found
    for stage in found.values():
        stage.close()


MESSAGES = ("JointPos1", "JointPos2", "LeverState", "MachineStatus", "ValveFeedback", "JointPos3")
LOST, UNTRUSTED, UNLIKELY, AT_ONCE = 0.15, 0.1, 0.04, 0.02
STOPS: list[tuple[str, str, float]] = [
    *((fault, message, LOST) for fault in ("drop", "wrong_id", "delay") for message in MESSAGES),
    *((fault, message, UNTRUSTED) for fault in ("corrupt", "short", "masquerade", "freeze_counter") for message in MESSAGES),
    ("silent", "", LOST),
    ("jump", "", UNLIKELY), ("out_of_range", "", UNLIKELY), ("sign", "", UNLIKELY), ("invalid", "", AT_ONCE),
    ("estop", "", AT_ONCE), ("deadman_released", "", AT_ONCE), ("remote_off", "", AT_ONCE), ("second_sender", "", AT_ONCE),
    ("second_remote", "", UNTRUSTED),
]  # fmt: skip
"""Faults that end a motion, and within which time."""
HARMLESS = [*itertools.product(("drop_some", "duplicate", "reorder"), MESSAGES), ("flood", "")]
"""Faults that are borne, or end in zero; what is wrong is never used."""
OPERATORS = {"deadman_released", "estop", "remote_off", "second_sender", "lever"}
"""Faults that say nothing against the positions: an advice goes on."""


def against(rows: list[Any], *modes: str) -> list[Any]:
    """Returns all rows against all modes; those of the first mode, each fault with one message, are for the normal suite."""
    found, seen = [], set()
    for mode in modes:
        for row in rows:
            kind = row[0].split()[0]
            found.append(pytest.param(mode, *row, marks=[pytest.mark.slow] * (kind in seen)))
            seen.add(kind)
    return found


@pytest.mark.parametrize(("mode", "fault", "message", "limit_s"), against(STOPS, *COMMANDING))
def test_what_must_stop_the_machine_stops_it_in_time_and_for_good(
    stages: dict[str, Stage], mode: str, fault: str, message: str, limit_s: float
) -> None:
    stage = stages[mode]
    stage.get_going()
    stage.fault(fault, message)
    assert stage.stops_within_s() <= limit_s + 0.011  # the twin takes a fault up in its next cycle
    state = stage.view.state
    assert state.guard.name == "LATCHED" or fault == "deadman_released"
    assert not any(state.sent)
    stage.fault("none")
    stage.go(0.3)
    if fault != "deadman_released":
        # nothing moves again before somebody has released the dead-man and pressed it
        assert not stage.moves


@pytest.mark.parametrize(("mode", "fault", "message", "limit_s"), against(STOPS, "listen"))
def test_what_speaks_against_the_positions_takes_the_advice_away_and_nothing_is_ever_sent(
    stages: dict[str, Stage], mode: str, fault: str, message: str, limit_s: float
) -> None:
    stage = stages[mode]
    stage.get_going()
    stage.fault(fault, message)
    stage.go(limit_s + 0.061)  # the policy's period
    is_missing = fault in ("drop", "wrong_id", "delay")
    elsewhere = is_missing and message in ("LeverState", "MachineStatus")
    assert stage.advised == (fault in OPERATORS or elsewhere)
    assert not stage.air.sent


@pytest.mark.parametrize(("mode", "fault", "message"), against(HARMLESS, *MODES))
def test_what_a_bus_does_now_and_then_is_borne_or_ends_in_zero(
    stages: dict[str, Stage], mode: str, fault: str, message: str
) -> None:
    stage = stages[mode]
    stage.get_going()
    stage.fault(fault, message)
    stage.go(0.5)
    seen = stage.view
    assert seen.state is not None and seen.state.q_plausible
    assert stage.moves or seen.state.guard.name in ("LATCHED", "SILENT")
    assert mode != "listen" or not stage.air.sent


def test_a_full_disk_ends_the_log_says_so_and_leaves_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = LoopMemory(MACHINE.num_joints, commands=False)
    capture = CaptureConfig(tmp_path, DBC, MACHINE, {"source": "test"}, 0.0)
    sync, flush, count = os.fsync, CaptureWriter.flush, [0]

    def full(file: int) -> None:
        count[0] += 1
        if count[0] > 2:  # both files once
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(file)

    def often(self: CaptureWriter) -> None:
        memory.policy_log.put(b'J{"topic": "advice", "t_s": 1.0}')
        flush(self)

    memory.policy_log.put(b'J{"topic": "advice", "t_s": 0.5}')
    monkeypatch.setattr(os, "fsync", full)
    monkeypatch.setattr(CaptureWriter, "flush", often)
    monkeypatch.setattr("deploy.recorder.capture.FLUSH_S", 0.0)
    with pytest.raises(StorageError, match=r"No space left.*nothing more is recorded"):
        record(lambda: False, capture, memory)
    assert capture_reader.read_capture(tmp_path / MCAP).messages["advice"][0][0] == 0.5
    memory.close()


BRIDGE: list[tuple[str, dict[str, Any], float]] = [
    *((f"half {name}", {"half": name}, UNTRUSTED) for name in (*MESSAGES, "ValveCmd")),
    *((f"late {name}", {"delay_s": {name: 0.2}}, LOST) for name in (*MESSAGES, "ValveCmd")),
    *((f"late {way}", {"delay_s": {way: 0.2}}, LOST) for way in ("to_pc", "to_gateway")),
    *((f"copies of {name}", {"echo_s": {name: 0.26}}, 0.26 + UNTRUSTED) for name in (*MESSAGES, "ValveCmd")),
    *((f"second remote, {k} ahead", {"second_remote": True, "remote_offset": k}, UNTRUSTED) for k in range(5)),
    ("foreign commands", {"foreign": {"Command_q3": 0.5, "CommandMode": 1}}, UNTRUSTED),
    ("growing delay", {"delay_s": {"to_pc": lambda since_s: 0.1 * since_s}}, 1.5 + 0.02),
]  # fmt: skip
"""Faults of a bridge between gateway and PC: name, settings, longest time until the motion ends, s."""


@pytest.mark.parametrize(("mode", "name", "faults", "limit_s"), against(BRIDGE, *COMMANDING))
def test_what_a_bridge_does_ends_the_motion_in_time_and_for_good(
    stages: dict[str, Stage], mode: str, name: str, faults: dict[str, Any], limit_s: float
) -> None:
    stage = stages[mode]
    stage.get_going()
    stage.bridge.begun_ms = stage.ms
    for name_, value in faults.items():
        setattr(stage.bridge, name_, value)
    assert stage.stops_within_s(max(0.6, limit_s + 0.3)) <= limit_s + 0.011
    state = stage.view.state
    assert state is not None and state.guard.name == "LATCHED"


@pytest.mark.parametrize(("mode", "way"), [("collect", "to_pc"), ("auto", "to_gateway")])
def test_a_delay_that_was_always_there_is_measured_and_nothing_moves(
    tmp_path: Path, mode: Any, way: str
) -> None:
    stage = Stage(MACHINE, mode, tmp_path)
    stage.bridge.delay_s = {way: 0.2}
    for _ in range(3):
        stage.fault("none")
        stage.go(1.2)
        stage.fault("deadman_released")
        stage.go(0.3, lambda: stage.moves)
        assert not stage.moves
    state = stage.view.state
    assert state is not None and state.round_trip_s >= 0.2
    assert state.trip.value == "way to the gateway and back unknown or too long"
    stage.close()
