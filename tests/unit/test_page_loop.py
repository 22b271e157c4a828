"""The page beside the loop: what it shows is what stands in the slots, and wishes become controls."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from composed import option

from brokk_rl.session import Session
from deploy.guard.guard import State
from deploy.page.from_loop import Beside, LoopFeed
from deploy.page.protocol import Drawn, Levers, Wish
from deploy.policy.adviser import REASONS, Advised
from deploy.runtime.bus_process import TEXT, TRIPS
from deploy.runtime.operator_requests import Recorder, Wanted
from deploy.runtime.shm_layout import Exchange
from deploy.runtime.target import FileTarget, TargetSelector

MACHINE = option("machine", "brokk170")
FULL_RAD = 0.35


@pytest.fixture
def exchange() -> Iterator[Exchange]:
    found = Exchange.new(MACHINE.num_joints, commands=True)
    yield found
    found.close()


@pytest.fixture
def feed(exchange: Exchange, tmp_path: Path) -> LoopFeed:
    session = Session(out=str(tmp_path), seed=1, device="cpu")
    return LoopFeed(
        Beside(
            option("page", "local"),
            MACHINE,
            option("guidance", "machine"),
            session,
            0.15,
            0.15,
            600.0,
        ),
        exchange,
    )


def say(exchange: Exchange, **changes: Any) -> None:
    """Publishes a state in which all is well, with `changes`."""
    record, now_s = exchange.state.new(), time.monotonic()
    record["t_s"] = record["q_t_s"] = record["levers_t_s"] = now_s
    record["q"], record["lever"] = MACHINE.home, [0.1, -0.2, 0.3, -0.4]
    record["q_plausible"] = record["trusted"] = record["alone"] = record["bus_up"] = record[
        "deadman"
    ] = True
    record["guard"], record["trip"] = State.SILENT.value, TRIPS.index(TRIPS[0])
    for name, value in changes.items():
        record[name] = value
    exchange.state.write(record)


def advise(exchange: Exchange, reason: Advised = Advised.VALID, **changes: Any) -> None:
    record = exchange.advice.new()
    record["t_s"], record["number"], record["reason"] = time.monotonic(), 5, REASONS.index(reason)
    for name, value in changes.items():
        record[name] = value
    exchange.advice.write(record)


def test_before_anything_came_everything_is_missing(feed: LoopFeed) -> None:
    shown = feed.shown()
    assert not shown.alive and shown.advice is None and shown.own is None and shown.q is None
    assert all(stream.stale for stream in shown.streams)
    assert not shown.deadman
    assert json.dumps(shown.plain())


def test_levers_are_parts_of_full(exchange: Exchange, feed: LoopFeed) -> None:
    say(exchange)
    advise(exchange, lever_rad=[FULL_RAD, -FULL_RAD / 2, 0.0, FULL_RAD / 4])
    shown = feed.shown()
    assert shown.own == Levers(0.1, -0.2, 0.3, -0.4, False)
    assert shown.advice is not None
    assert shown.advice.levers == Levers(1.0, -0.5, 0.0, 0.25, False)
    assert (shown.advice.valid, shown.advice.number) == (True, 5)
    assert shown.alive and shown.deadman


def test_the_button_is_announced_while_the_levers_go_through_neutral(
    exchange: Exchange, feed: LoopFeed
) -> None:
    say(exchange)
    wants_q2 = [0.0, 0.7, 0.0, 0.0, 0.0]
    advise(exchange, u=wants_q2, lever_rad=[0.3, 0.0, 0.0, 0.0])
    advice = feed.shown().advice
    assert advice is not None and advice.button_due_s == pytest.approx(0.3 / 2.0)  # at 2 rad/s
    advise(exchange, u=wants_q2, lever_rad=[0.0, 0.0, 0.1, 0.0], button_right=True)
    advice = feed.shown().advice
    assert advice is not None and advice.button_due_s == 0.0
    advise(exchange, u=[0.3, 0.0, 0.0, 0.0, 0.0])
    advice = feed.shown().advice
    assert advice is not None and advice.button_due_s is None


def test_old_things_are_old(exchange: Exchange, feed: LoopFeed) -> None:
    now_s = time.monotonic()
    say(exchange, q_t_s=now_s - 0.2, levers_t_s=now_s - 0.3)
    advise(exchange, t_s=now_s - 1.0)
    target = exchange.target.new()
    target["t_s"], target["center_in_base_m"] = now_s - 700.0, [2.6, 0.0, 0.75]
    exchange.target.write(target)
    assert {stream.name for stream in feed.shown().streams if stream.stale} == {
        "positions",
        "levers",
        "advice",
        "borehole",
    }
    assert not feed.shown().deadman, "a dead-man of which nothing was heard is not held"


def test_the_borehole_and_the_way_to_it(exchange: Exchange, feed: LoopFeed) -> None:
    say(exchange)
    target = exchange.target.new()
    target["t_s"], target["center_in_base_m"], target["std_m"] = (
        time.monotonic(),
        [2.6, 0.0, 0.75],
        0.003,
    )
    exchange.target.write(target)
    shown = feed.shown()
    assert shown.targets[0].center_in_base_m == (2.6, 0.0, 0.75) and shown.targets[0].std_m == 0.003
    assert shown.path_in_base_m[-1] == pytest.approx((2.6, 0.0, 0.65))
    assert feed.wish(Wish("target", shown.targets[0].name))
    assert not feed.wish(Wish("target", "another"))
    feed.wish(Wish("stop", ""))
    stopped = feed.shown()
    assert not stopped.guiding and stopped.path_in_base_m == ()


def test_what_was_wished_and_drawn_is_recorded(exchange: Exchange, feed: LoopFeed) -> None:
    feed.drawn(Drawn(7, 12.5, 0.002, 1))
    feed.wish(Wish("record", "on"))
    said = [json.loads(data.removeprefix(TEXT)) for data in exchange.page_log.take()]
    assert [one["topic"] for one in said] == ["drawn", "wish"]
    assert (said[0]["advice"], said[0]["at_s"]) == (7, 12.5)


@dataclass
class Process:
    """A log process that only remembers what was asked of it."""

    folder: Path
    code: int | None = None
    asked: bool = False
    pid: int = 4711

    def ask_to_stop(self) -> None:
        self.asked = True

    def end(self, patience_s: float) -> int:
        return 0


def wanted(
    exchange: Exchange, tmp_path: Path, commands: bool = True
) -> tuple[Wanted, list[Process]]:
    started: list[Process] = []

    def start(folder: Path) -> Any:
        started.append(Process(folder))
        return started[-1]

    aim = TargetSelector(
        FileTarget(path=str(tmp_path / "none.json")).build(), exchange.target, exchange.holes
    )
    return Wanted(
        exchange, Recorder(exchange, tmp_path, start), aim, armed=False, commands=commands
    ), started


def controls(exchange: Exchange) -> Any:
    found = exchange.controls.read()
    assert found is not None
    return found


def test_start_arms_and_stop_disarms(exchange: Exchange, feed: LoopFeed, tmp_path: Path) -> None:
    supervisor, _ = wanted(exchange, tmp_path)
    supervisor.refresh()
    assert not controls(exchange)["armed"]
    for kind, armed in (("start", True), ("stop", False), ("start", True)):
        feed.wish(Wish(kind, ""))
        supervisor.refresh()
        assert controls(exchange)["armed"] == armed
    feed.wish(Wish("start", ""))
    feed.wish(Wish("stop", ""))
    supervisor.refresh()
    assert not controls(exchange)["armed"], "the last word counts"


def test_nothing_is_armed_where_nothing_is_ever_sent(
    exchange: Exchange, feed: LoopFeed, tmp_path: Path
) -> None:
    supervisor, _ = wanted(exchange, tmp_path, commands=False)
    feed.wish(Wish("start", ""))
    supervisor.refresh()
    assert not controls(exchange)["armed"]


def test_recordings_begin_and_end_one_at_a_time(
    exchange: Exchange, feed: LoopFeed, tmp_path: Path
) -> None:
    supervisor, started = wanted(exchange, tmp_path)
    exchange.bus_log.put(b"old")
    supervisor.refresh()
    assert exchange.bus_log.waiting == 0, "what nobody records does not pile up"
    feed.wish(Wish("record", "on"))
    supervisor.refresh()
    assert [one.folder for one in started] == [tmp_path]
    assert feed.shown().recording.on
    feed.wish(Wish("record", "off"))
    feed.wish(Wish("record", "on"))
    feed.wish(Wish("record", "off"))
    supervisor.refresh()
    assert started[0].asked and not feed.shown().recording.on
    feed.wish(Wish("record", "on"))
    supervisor.refresh()
    assert len(started) == 1, "the first still writes its last words"
    started[0].code = 0
    supervisor.refresh()
    assert [one.folder for one in started] == [tmp_path, tmp_path / "recording_2"]
    assert feed.shown().recording.on


def test_a_log_that_died_is_not_started_again_in_secret(
    exchange: Exchange, feed: LoopFeed, tmp_path: Path
) -> None:
    supervisor, started = wanted(exchange, tmp_path)
    feed.wish(Wish("record", "on"))
    supervisor.refresh()
    started[0].code = -9
    supervisor.refresh()
    supervisor.refresh()
    assert len(started) == 1 and not feed.shown().recording.on


def test_other_lever_patterns_have_their_own_full_angles(
    exchange: Exchange, tmp_path: Path
) -> None:
    session = Session(out=str(tmp_path), seed=1, device="cpu")
    guidance = option("guidance", "iso")
    wide = replace(
        guidance, levers=tuple(replace(one, max_angle_rad=0.5) for one in guidance.levers)
    )
    feed = LoopFeed(
        Beside(option("page", "local"), MACHINE, wide, session, 0.15, 0.15, 600.0), exchange
    )
    say(exchange)
    advise(exchange, lever_rad=[0.25, 0.0, 0.0, 0.0])
    advice = feed.shown().advice
    assert advice is not None and advice.levers.left_theta == pytest.approx(0.5)
