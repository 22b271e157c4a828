"""The bus process: what it does with bus, clock and shared memory around its logic."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE, option
from desk import DBC

from brokk_rl.errors import LinkError
from deploy.bus.can_bus import CanFrame
from deploy.kernel import bus_process
from deploy.kernel.bus_logic import BusInputs, BusLogic
from deploy.kernel.bus_process import FRAME, BusProcess, BusProcessConfig
from deploy.kernel.guard import NOTHING_OBSERVED, GuardDecision, GuardState, GuardTrip, Observation
from deploy.kernel.protection import MessageFault
from deploy.kernel.target_check import SeenTarget
from deploy.runtime.operator_state import OperatorControls, PageSignal, RequestedCommand
from deploy.runtime.shm_layout import TEXT, LoopMemory

LIMITS = option("guard", "default")
STILL = GuardDecision(GuardState.READY, (0.0,) * 5, GuardTrip.DEADMAN, GuardTrip.NONE)
BEGIN_S, CYCLE_S, SLEWED_S = 5000.0, 0.01, 0.5
FRAMES = [CanFrame(0x100 + number, bytes([number])) for number in range(4)]


class Wire:
    """A bus: frames that arrive at given times, and what was sent."""

    interface, channel = "virtual", "air"

    def __init__(self, clock: Clock) -> None:
        self.clock, self.arriving = clock, list[tuple[float, CanFrame]]()
        self.sent: list[CanFrame] = []
        self.opened: list[float] = []
        self.closed: list[float] = []
        self.is_missing = self.is_mute = self.is_deaf = False
        self.frame_ids: Any = None

    def open(self, frame_ids: Any) -> Wire:
        self.opened.append(self.clock.now_s)
        if self.is_missing:
            raise LinkError("no such bus")
        self.frame_ids = frame_ids
        return self

    def recv(self, timeout_s: float) -> CanFrame | None:
        assert timeout_s > 0
        if self.is_deaf:
            raise LinkError("bus-off")
        due_s, frame = self.arriving[0] if self.arriving else (math.inf, None)
        if due_s > self.clock.now_s + timeout_s:
            self.clock.now_s += timeout_s
            return None
        self.clock.now_s = max(self.clock.now_s, due_s)
        del self.arriving[0]
        return frame

    def send(self, frame: CanFrame) -> None:
        if self.is_mute:
            raise LinkError("cannot send")
        self.sent.append(frame)

    def close(self) -> None:
        self.closed.append(self.clock.now_s)


class Clock:
    def __init__(self) -> None:
        self.now_s = BEGIN_S

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class Logic:
    """Notes what it is asked, and answers what a test says."""

    def __init__(self, logic: BusLogic) -> None:
        self.receiver, self.decision = logic.receiver, None
        self.after, self.frames = STILL, list[CanFrame]()
        self.inputs: list[tuple[float, bool, BusInputs, int]] = []
        self.taken: list[tuple[float, CanFrame]] = []
        self.fault: MessageFault | None = None
        self.is_urgent, self.ended = False, list[tuple[float, int]]()

    def take(
        self, frame: CanFrame, now_s: float, steady_s: float
    ) -> tuple[MessageFault | None, bool]:
        assert steady_s == now_s - SLEWED_S
        self.taken.append((now_s, frame))
        return self.fault, self.is_urgent

    def decide(self, *asked: Any) -> list[CanFrame]:
        self.inputs.append(asked)
        self.decision = self.after
        return self.frames

    def build_state(self, now_s: float, bus_up: bool, missed: int) -> Any:
        return self.receiver.build_state(now_s, bus_up, STILL, GuardTrip.NONE, missed)

    def end(self, now_s: float, missed: int) -> list[CanFrame]:
        self.ended.append((now_s, missed))
        return FRAMES[:1]


class Rig:
    """A bus process whose bus, clock and logic are a test's."""

    def __init__(self, commands: bool = True) -> None:
        self.clock = Clock()
        self.memory = LoopMemory(MACHINE.num_joints, commands)
        self.wire = Wire(self.clock)
        limits = replace(LIMITS, observer=None)
        config = BusProcessConfig(self.wire, DBC, MACHINE, limits, needs_page=True)  # type: ignore[arg-type]
        self.process = BusProcess(config, self.memory)
        assert self.process._logic._needs_page and self.process._logic._commands is commands
        self.logic = Logic(self.process._logic)
        self.process._logic = self.logic  # type: ignore[assignment]

    def cycle(self) -> None:
        self.process.receive()
        self.process._timer.begin()
        self.process.run_cycle()

    def read_log(self) -> tuple[list[tuple[Any, bytes]], list[dict[str, Any]]]:
        """Return the frames, each with its header, and the texts that went to the log."""
        frames, texts = [], []
        for entry in self.memory.bus_log.take():
            kind, data = entry[:1], entry[1:]
            if kind == TEXT:
                texts.append(json.loads(data))
                continue
            while data:
                header = FRAME.unpack_from(data)
                end = FRAME.size + header[3]
                frames.append((header, data[FRAME.size : end]))
                data = data[end:]
        return frames, texts


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    clock: list[Clock] = []
    monkeypatch.setattr(time, "monotonic", lambda: clock[0].now_s if clock else BEGIN_S)
    monkeypatch.setattr(time, "clock_gettime", lambda clock_id: clock[0].now_s - SLEWED_S)
    monkeypatch.setattr(time, "sleep", lambda seconds: clock[0].sleep(seconds))
    made = Rig()
    clock.append(made.clock)
    yield made
    made.memory.close()


def test_frames_are_taken_until_the_deadline_and_logged_with_their_time(rig: Rig) -> None:
    rig.wire.arriving = [(BEGIN_S + 0.003, FRAMES[0]), (BEGIN_S + 0.007, FRAMES[1])]
    rig.wire.arriving += [(BEGIN_S + 0.011, FRAMES[2])]
    rig.cycle()
    assert rig.wire.opened == [BEGIN_S] and rig.wire.frame_ids == rig.logic.receiver.frame_ids
    first, second = pytest.approx(BEGIN_S + 0.003), pytest.approx(BEGIN_S + 0.007)
    times = [(first, FRAMES[0]), (second, FRAMES[1])]
    assert rig.logic.taken == times
    assert rig.clock.now_s == pytest.approx(BEGIN_S + CYCLE_S)
    frames, texts = rig.read_log()
    assert [(header[0], header[1], header[2]) for header, _ in frames] == [
        (pytest.approx(BEGIN_S + 0.003), 0x100, 0),
        (pytest.approx(BEGIN_S + 0.007), 0x101, 0),
    ]
    assert [data for _, data in frames] == [FRAMES[0].data, FRAMES[1].data]
    assert [one["topic"] for one in texts] == ["guard"]
    rig.cycle()
    assert len(rig.logic.taken) == 3 and len(rig.logic.inputs) == 2 and rig.wire.opened == [BEGIN_S]


def test_a_frame_that_ends_a_motion_is_decided_on_at_once_and_its_fault_is_logged(rig: Rig) -> None:
    rig.logic.is_urgent, rig.logic.fault = True, MessageFault.CRC
    rig.wire.arriving = [(BEGIN_S + 0.003, FRAMES[0])]
    rig.process.receive()
    ((now_s, bus_up, _, missed),) = rig.logic.inputs
    assert now_s == pytest.approx(BEGIN_S + 0.003) and bus_up is True and missed == 0
    _, texts = rig.read_log()
    fault = {"topic": "fault", "t_s": pytest.approx(now_s), "frame_id": 0x100, "fault": "wrong CRC"}
    assert fault in texts


def test_what_is_decided_is_sent_published_and_logged(rig: Rig) -> None:
    rig.logic.frames = FRAMES[1:3]
    rig.cycle()
    assert rig.wire.sent == FRAMES[1:3]
    frames, _ = rig.read_log()
    assert [(header[1], header[2]) for header, _ in frames] == [(0x101, 1), (0x102, 1)]
    state = rig.memory.state.read()
    assert state is not None and state.bus_up and state.t_s == pytest.approx(BEGIN_S + CYCLE_S)
    assert state.guard is GuardState.READY and state.missed == 0
    rig.read_log()
    rig.logic.frames = []
    rig.cycle()
    assert rig.memory.bus_log.waiting == 0, "nothing is logged twice, nor that there was nothing"


def test_the_records_of_the_others_reach_the_logic(rig: Rig) -> None:
    memory = rig.memory
    controls = OperatorControls(1.0, True, 2.0, False, 0.0, False)
    request, page = RequestedCommand(3.0, np.full(5, 0.1)), PageSignal(4.0, 5.0, 6.0)
    rig.process.run_cycle()
    empty = rig.logic.inputs[-1][2]
    assert empty == BusInputs(None, None, None, None)
    memory.controls.write(controls)
    memory.page.write(page)
    memory.request.write(request)
    target = memory.target.new()
    target["t_s"], target["center_in_base_m"] = BEGIN_S - 7.0, (2.5, 0.1, 0.8)
    memory.target.write(target)
    holes = memory.holes.new()
    holes["count"] = 4
    for number, age_s in enumerate((0.0, LIMITS.target.seen_s, LIMITS.target.seen_s + 0.1)):
        holes["holes"][number]["t_s"] = BEGIN_S - age_s
        holes["holes"][number]["center_in_base_m"] = (2.0, number, 0.7)
    holes["holes"][3]["t_s"] = BEGIN_S
    holes["holes"][3]["center_in_base_m"] = (2.0, math.nan, 0.7)  # shows no face
    memory.holes.write(holes)
    rig.process.run_cycle()
    found = rig.logic.inputs[-1][2]
    assert (found.controls, found.page) == (controls, page)
    assert found.request is not None and found.request.u.tolist() == [0.1] * 5
    seen_m = ((2.0, 0.0, 0.7), (2.0, 1.0, 0.7))
    assert found.target == SeenTarget((2.5, 0.1, 0.8), 7.0, seen_m)


def test_memory_that_cannot_be_read_is_a_stop_and_a_borehole_that_is_no_place(rig: Rig) -> None:
    rig.memory.page.write(PageSignal(1.0, 0.0, 0.0))
    rig.memory.target.write(rig.memory.target.new())
    for slot in (rig.memory.page, rig.memory.target):
        slot.memory.bytes[8:] = bytes(one ^ 0x5A for one in slot.memory.bytes[8:])
    rig.process.run_cycle()
    found = rig.logic.inputs[-1][2]
    assert found.page == PageSignal(BEGIN_S, BEGIN_S, 0.0)
    assert found.target is not None and np.isnan(found.target.center_in_base_m).all()
    assert found.target.age_s == 0.0 and len(found.target.center_in_base_m) == 3


def test_where_nothing_is_ever_sent_there_is_no_request() -> None:
    made = Rig(commands=False)
    made.process.run_cycle()
    assert made.logic.inputs[-1][2].request is None and made.memory.request is None
    made.memory.close()


def test_a_change_of_the_guard_is_logged_once_with_its_joint(rig: Rig) -> None:
    rig.cycle()
    rig.read_log()
    latched = replace(STILL, state=GuardState.LATCHED, trip=GuardTrip.JOINT_STILL)
    rig.logic.after = replace(latched, cause=GuardTrip.JOINT_STILL)
    rig.logic.receiver.observation = Observation(GuardTrip.JOINT_STILL, 0)
    for _ in range(3):
        rig.cycle()
    _, (text,) = rig.read_log()
    value = GuardTrip.JOINT_STILL.value
    assert text.pop("t_s") == pytest.approx(BEGIN_S + 2 * CYCLE_S)
    expected = {"topic": "guard", "state": "LATCHED", "trip": value, "cause": value, "joint": "q1"}
    assert text == expected
    # Another reason in the same state is a change, too, and so is another state.
    rig.logic.receiver.observation = NOTHING_OBSERVED
    for after in (replace(latched, trip=GuardTrip.ESTOP), replace(STILL, trip=GuardTrip.ESTOP)):
        rig.logic.after = after
        rig.cycle()
        _, (text,) = rig.read_log()
        assert "joint" not in text and text["state"] == after.state.name


def test_a_computer_that_slept_drops_what_waited(rig: Rig, caplog: Any) -> None:
    rig.cycle()
    rig.clock.now_s = rig.process._timer.next_s + LIMITS.gap_s
    rig.process.receive()
    assert rig.wire.closed == []
    rig.process._timer.begin()
    rig.clock.now_s = rig.process._timer.next_s + LIMITS.gap_s + 0.001
    rig.process.receive()
    assert len(rig.wire.closed) == 1 and len(rig.wire.opened) == 2
    assert "time stood still for 0.2 s" in caplog.text


def test_a_bus_that_is_missing_is_tried_again_and_said_once(rig: Rig, caplog: Any) -> None:
    rig.wire.is_missing = True
    for _ in range(41):
        rig.cycle()
    apart_s = np.diff(rig.wire.opened)
    assert len(rig.wire.opened) == 3 and apart_s == pytest.approx(0.2, abs=0.011)
    assert caplog.text.count("no such bus") == 1 and rig.logic.inputs[-1][1] is False
    _, texts = rig.read_log()
    downs = [one for one in texts if one["topic"] == "bus"]
    assert [one["down"] for one in downs] == ["no such bus"]
    assert downs[0]["t_s"] == BEGIN_S
    rig.wire.is_missing = False
    for _ in range(21):
        rig.cycle()
    assert rig.logic.inputs[-1][1] is True and rig.wire.closed == []
    # Down once more: said once more.
    rig.wire.is_deaf = True
    rig.cycle()
    assert caplog.text.count("bus-off") == 1 and len(rig.wire.closed) == 1
    assert rig.logic.inputs[-1][1] is False


def test_a_frame_that_cannot_be_sent_takes_the_others_with_it(rig: Rig) -> None:
    rig.cycle()
    rig.logic.frames, rig.wire.is_mute = FRAMES[:3], True
    rig.process.run_cycle()
    assert rig.wire.sent == [] and len(rig.wire.closed) == 1
    frames, texts = rig.read_log()
    assert len(frames) == 1 and texts[-1]["down"] == "cannot send"
    rig.wire.is_mute = False
    rig.process.run_cycle()
    assert rig.wire.sent == [] and len(rig.wire.opened) == 1
    state = rig.memory.state.read()
    assert state is not None and not state.bus_up


def test_at_the_end_zero_is_sent_the_timing_reported_and_the_bus_closed(rig: Rig) -> None:
    turns = iter((False, False, True))
    rig.process.run(lambda: next(turns))
    assert len(rig.logic.inputs) == 2 and rig.wire.sent == FRAMES[:1]
    assert rig.logic.ended == [(pytest.approx(BEGIN_S + 2 * CYCLE_S), 0)]
    (report,) = [json.loads(one) for one in rig.memory.reports.take()]
    assert report["process"] == "bus" and report["cycles"] == 2
    assert len(rig.wire.closed) == 1
    frames, _ = rig.read_log()
    assert frames[-1][0][:3] == (pytest.approx(BEGIN_S + 2 * CYCLE_S), 0x100, 1)


def test_at_the_end_of_a_process_without_a_bus_there_is_none_to_close(rig: Rig) -> None:
    rig.wire.is_missing = True
    config = BusProcessConfig(rig.wire, DBC, MACHINE, LIMITS, False)  # type: ignore[arg-type]
    bus_process.run(lambda: True, config, rig.memory)
    rig.process.run(lambda: True)
    assert rig.wire.closed == [] and rig.wire.sent == []
