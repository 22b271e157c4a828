"""The page beside the loop: what it shows is what stands in the slots, and wishes become controls."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE
from desk import build_feed

from brokk_rl.errors import LinkError
from deploy.guidance import LeverPositions
from deploy.kernel.guard import GuardState
from deploy.page.loop_feed import LoopFeed
from deploy.page.protocol import OperatorRequest
from deploy.recorder.capture import CaptureConfig
from deploy.runtime.operator_requests import RecordingControl, RequestHandler
from deploy.runtime.process_group import ProcessGroup
from deploy.runtime.shm_layout import TEXT, LoopMemory
from deploy.runtime.target import FileTarget, TargetSelector

FULL_RAD = 0.35


@pytest.fixture
def memory() -> Iterator[LoopMemory]:
    found = LoopMemory(MACHINE.num_joints, commands=True)
    yield found
    found.close()


@pytest.fixture
def feed(memory: LoopMemory, tmp_path: Path) -> LoopFeed:
    return build_feed(memory, tmp_path)


def say(memory: LoopMemory, **changes: Any) -> None:
    """Publishes a state in which all is well, with `changes`."""
    now_s = time.monotonic()
    state = replace(
        memory.state.new(),
        t_s=now_s,
        q_t_s=now_s,
        levers_t_s=now_s,
        q=MACHINE.home,
        lever=np.array([0.1, -0.2, 0.3, -0.4]),
        q_plausible=True,
        trusted=True,
        alone=True,
        bus_up=True,
        deadman=True,
        guard=GuardState.SILENT,
    )
    memory.state.write(replace(state, **changes))


def advise(memory: LoopMemory, **changes: Any) -> None:
    advice = replace(memory.advice.new(), t_s=time.monotonic(), number=5)
    memory.advice.write(replace(advice, **changes))


def test_before_anything_came_everything_is_missing(feed: LoopFeed) -> None:
    shown = feed.read_state()
    assert not shown.alive and shown.advice is None and shown.own is None and shown.q is None
    assert all(stream.stale for stream in shown.streams)
    assert not shown.deadman
    assert json.dumps(shown.to_plain())


def test_levers_are_parts_of_full(memory: LoopMemory, feed: LoopFeed) -> None:
    say(memory)
    advise(memory, lever_rad=[FULL_RAD, -FULL_RAD / 2, 0.0, FULL_RAD / 4])
    shown = feed.read_state()
    assert shown.own == LeverPositions(0.1, -0.2, 0.3, -0.4, False)
    assert shown.advice.levers == LeverPositions(1.0, -0.5, 0.0, 0.25, False)
    assert (shown.advice.valid, shown.advice.number) == (True, 5)
    assert shown.alive and shown.deadman


def test_the_button_is_announced_while_the_levers_go_through_neutral(
    memory: LoopMemory, feed: LoopFeed
) -> None:
    say(memory)
    wants_q2 = [0.0, 0.7, 0.0, 0.0, 0.0]
    advise(memory, u=wants_q2, lever_rad=[0.3, 0.0, 0.0, 0.0])
    advice = feed.read_state().advice
    assert advice is not None and advice.button_due_s == pytest.approx(0.3 / 2.0)  # at 2 rad/s
    advise(memory, u=wants_q2, lever_rad=[0.0, 0.0, 0.1, 0.0], button_right=True)
    advice = feed.read_state().advice
    assert advice is not None and advice.button_due_s == 0.0
    advise(memory, u=[0.3, 0.0, 0.0, 0.0, 0.0])
    advice = feed.read_state().advice
    assert advice is not None and advice.button_due_s is None


def test_old_things_are_old(memory: LoopMemory, feed: LoopFeed) -> None:
    now_s = time.monotonic()
    say(memory, q_t_s=now_s - 0.2, levers_t_s=now_s - 0.3)
    advise(memory, t_s=now_s - 1.0)
    target = memory.target.new()
    target["t_s"], target["center_in_base_m"] = now_s - 700.0, [2.6, 0.0, 0.75]
    memory.target.write(target)
    stale = {stream.name for stream in feed.read_state().streams if stream.stale}
    assert stale == {"positions", "levers", "advice", "borehole"}
    assert not feed.read_state().deadman, "a dead-man of which nothing was heard is not held"


def test_the_borehole_and_the_way_to_it(memory: LoopMemory, feed: LoopFeed) -> None:
    say(memory)
    target = memory.target.new()
    target["t_s"], target["std_m"] = time.monotonic(), 0.003
    target["center_in_base_m"] = [2.6, 0.0, 0.75]
    memory.target.write(target)
    shown = feed.read_state()
    assert shown.targets[0].center_in_base_m == (2.6, 0.0, 0.75) and shown.targets[0].std_m == 0.003
    assert shown.path_in_base_m[-1] == pytest.approx((2.6, 0.0, 0.65))
    assert feed.submit(OperatorRequest("target", shown.targets[0].name))
    assert not feed.submit(OperatorRequest("target", "another"))
    feed.submit(OperatorRequest("stop", ""))
    stopped = feed.read_state()
    assert not stopped.guiding and stopped.path_in_base_m == ()


def test_what_was_wished_is_recorded(memory: LoopMemory, feed: LoopFeed) -> None:
    feed.submit(OperatorRequest("record", "on"))
    (said,) = [json.loads(data.removeprefix(TEXT)) for data in memory.page_log.take()]
    assert (said["topic"], said["kind"], said["value"]) == ("wish", "record", "on")


@dataclass
class Process:
    """A log process that only remembers what was asked of it."""

    folder: Path
    code: int | None = None
    asked_to_stop: bool = False

    def ask_to_stop(self) -> None:
        self.asked_to_stop = True


def wanted(
    memory: LoopMemory, tmp_path: Path, commands: bool = True
) -> tuple[RequestHandler, list[Process]]:
    started: list[Process] = []

    def start(name: str, target: str, arguments: tuple[CaptureConfig]) -> Any:
        started.append(Process(arguments[0].folder))
        return started[-1]

    file = FileTarget(path=str(tmp_path / "none.json")).build()
    aim = TargetSelector(file, memory.target, memory.holes)
    group: Any = SimpleNamespace(memory=memory, start=start)
    recorder = RecordingControl(group, CaptureConfig(tmp_path, "", MACHINE, {}, 0.0), False)
    return RequestHandler(memory, recorder, aim, armed=False, commands=commands), started


def ask(feed: LoopFeed, supervisor: RequestHandler, request: OperatorRequest) -> None:
    feed.submit(request)
    supervisor.refresh()


def controls(memory: LoopMemory) -> Any:
    return memory.controls.read()


def test_start_arms_and_stop_disarms(memory: LoopMemory, feed: LoopFeed, tmp_path: Path) -> None:
    supervisor, _ = wanted(memory, tmp_path)
    supervisor.refresh()
    assert not controls(memory).armed
    for kind, armed in (("start", True), ("stop", False), ("start", True)):
        feed.submit(OperatorRequest(kind, ""))
        supervisor.refresh()
        assert controls(memory).armed == armed
    feed.submit(OperatorRequest("start", ""))
    ask(feed, supervisor, OperatorRequest("stop", ""))
    assert not controls(memory).armed, "the last word counts"


def test_a_stop_goes_straight_to_the_bus_process_and_is_confirmed_by_the_guard(
    memory: LoopMemory, feed: LoopFeed
) -> None:
    say(memory, guard=GuardState.ACTIVE)
    assert memory.page.read() is None and not feed.confirms_stop()
    begun_s = time.monotonic()
    assert feed.submit(OperatorRequest("stop", ""))
    asked = memory.page.read()
    assert asked is not None and begun_s <= asked.stopped_s <= time.monotonic()
    assert not feed.confirms_stop(), "it was active before the stop"
    say(memory, guard=GuardState.LATCHED)
    assert not feed.confirms_stop(), "latched still sends"
    say(memory, guard=GuardState.SILENT, t_s=asked.stopped_s)
    assert not feed.confirms_stop(), "decided before"
    say(memory, guard=GuardState.SILENT)
    assert feed.confirms_stop()


def test_a_start_that_was_asked_for_before_a_stop_does_not_undo_it(
    memory: LoopMemory, feed: LoopFeed, tmp_path: Path
) -> None:
    supervisor, _ = wanted(memory, tmp_path)
    ask(feed, supervisor, OperatorRequest("start", ""))
    feed.submit(OperatorRequest("stop", ""))
    asked = memory.page.read()  # the supervisor hangs, and still says "armed"
    assert asked is not None and controls(memory).armed_t_s < asked.stopped_s
    ask(feed, supervisor, OperatorRequest("start", ""))
    assert controls(memory).armed and controls(memory).armed_t_s > asked.stopped_s


def test_a_loop_that_sends_nothing_has_nothing_to_confirm(tmp_path: Path) -> None:
    memory = LoopMemory(MACHINE.num_joints, commands=False)
    feed = build_feed(memory, tmp_path)
    assert feed.submit(OperatorRequest("stop", "")) and feed.confirms_stop()
    memory.close()


def test_nothing_is_armed_where_nothing_is_ever_sent(
    memory: LoopMemory, feed: LoopFeed, tmp_path: Path
) -> None:
    supervisor, _ = wanted(memory, tmp_path, commands=False)
    ask(feed, supervisor, OperatorRequest("start", ""))
    assert not controls(memory).armed


def test_recordings_begin_and_end_one_at_a_time(
    memory: LoopMemory, feed: LoopFeed, tmp_path: Path
) -> None:
    supervisor, started = wanted(memory, tmp_path)
    memory.bus_log.put(b"old")
    supervisor.refresh()
    assert memory.bus_log.waiting == 0, "what nobody records does not pile up"
    ask(feed, supervisor, OperatorRequest("record", "on"))
    assert [one.folder for one in started] == [tmp_path]
    assert feed.read_state().recording.on
    feed.submit(OperatorRequest("record", "off"))
    feed.submit(OperatorRequest("record", "on"))
    ask(feed, supervisor, OperatorRequest("record", "off"))
    assert started[0].asked_to_stop and not feed.read_state().recording.on
    ask(feed, supervisor, OperatorRequest("record", "on"))
    assert len(started) == 1, "the first still writes its last words"
    started[0].code = 0
    supervisor.refresh()
    assert [one.folder for one in started] == [tmp_path, tmp_path / "recording_2"]
    assert feed.read_state().recording.on


def test_a_log_that_died_is_not_started_again_in_secret(
    memory: LoopMemory, feed: LoopFeed, tmp_path: Path
) -> None:
    supervisor, started = wanted(memory, tmp_path)
    ask(feed, supervisor, OperatorRequest("record", "on"))
    started[0].code = -9
    supervisor.refresh()
    supervisor.refresh()
    assert len(started) == 1 and not feed.read_state().recording.on
    assert feed.read_state().recording.failed, "an alarm, and not as if nobody wanted one"
    ask(feed, supervisor, OperatorRequest("record", "on"))
    assert feed.read_state().recording.on and not feed.read_state().recording.failed


@pytest.mark.parametrize(("optional", "asked"), [({}, False), ({"log": "it"}, False), ({}, True)])
def test_a_run_goes_on_without_an_optional_process_or_one_that_was_to_end(
    memory: LoopMemory, optional: dict[str, str], asked: bool
) -> None:
    log: Any = SimpleNamespace(name="log", code=1, asked_to_stop=asked)
    group = ProcessGroup(memory, False, optional, [log])
    with nullcontext() if optional or asked else pytest.raises(LinkError, match="log process"):
        group.check()
