"""A recorded session is shown as it was, and its timeline moves along it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import TOKEN, served, talk, until
from composed import MACHINE, option
from desk import DBC

from brokk_rl.errors import RecordingError
from deploy.bus.description import BusDescription
from deploy.kernel.bus_process import FRAME, FRAMES
from deploy.kernel.guard import GuardState, GuardTrip
from deploy.page.protocol import OperatorRequest
from deploy.page.replay import CaptureReplay, ReplayFeed
from deploy.recorder.capture import MCAP, CaptureConfig, CaptureWriter
from deploy.recorder.capture_reader import read_capture
from deploy.runtime.shm_layout import TEXT

BEGIN_S = 500.0
CENTER_M = [2.6, 0.1, 0.75]


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now_s = 9000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds: q1 turns by 0.1 rad/s, the dead-man comes at 2 s, the guard latches at 4 s and the levers end at 8 s."""
    folder = tmp_path_factory.mktemp("capture")
    bus = BusDescription(DBC, MACHINE)

    def pack(name: str, values: dict[str, float], k: int) -> bytes:
        payload = bus.encode(name, values, k)
        header = FRAME.pack(BEGIN_S + 0.1 * k, bus.layouts[name].frame_id, 0, len(payload))
        return header + payload

    with CaptureWriter(CaptureConfig(folder, DBC, MACHINE, {"source": "test"}, 0.0)) as log:

        def say(topic: str, at_s: float, **values: Any) -> None:
            log.add(TEXT + json.dumps({"topic": topic, "t_s": BEGIN_S + at_s, **values}).encode())

        say("guard", 0.0, state="READY", trip="nothing", cause="nothing")
        for k in range(101):
            q = {f"Position_q{j}": float(j == 1) * 0.01 * k for j in range(1, 6)}
            q |= {f"Valid_q{j}": 1 for j in range(1, 6)}
            log.add(FRAMES + b"".join(pack(f"JointPos{n}", q, k) for n in (1, 2, 3)))
            log.add(FRAMES + pack("MachineStatus", {"OilTemperature": 30}, k))
            if k <= 80:
                remote = {"Lever_left_theta": 0.5, "DeadMan": k >= 20, "RemoteOn": 1}
                log.add(FRAMES + pack("LeverState", remote, k))
            if k == 40:
                cause = GuardTrip.JOINTS_STALE.value
                say("guard", 4.0, state="LATCHED", trip=cause, cause=cause, joint="q3")
            say(
                "advice",
                0.1 * k,
                reason="valid",
                u=[0.0] * 5,
                lever_rad=[0.0, 0.1, 0.0, 0.0],
                button_right=False,
                target_in_base_m=CENTER_M,
                infer_s=0.001,
            )
        hole = {"name": 7, "center_in_base_m": CENTER_M, "std_m": 0.002, "score": 0.9}
        say("holes", 3.0, holes=[hole | {"axis_in_base": [0.0, 0.1, 0.995], "radius_m": 0.06}])
        say("wish", 6.0, kind="start", value="", taken=True, asked_s=BEGIN_S + 6.0)
    return folder


def read_settings(folder: Path) -> CaptureReplay:
    """Returns the shipped settings for a capture."""
    return option("feed", "replay", capture=folder)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def feed(capture: Path, clock: Clock) -> ReplayFeed:
    replay: CaptureReplay = read_settings(capture)
    return ReplayFeed(replay, MACHINE, read_capture(capture / MCAP), clock)


def test_the_state_is_that_of_the_recording_at_the_time_on_the_timeline(
    feed: ReplayFeed, clock: Clock
) -> None:
    for at_s, deadman, guard in ((1.0, False, GuardState.READY), (4.5, True, GuardState.LATCHED)):
        clock.now_s = 9000.0 + at_s
        shown = feed.read_state()
        assert shown.replay.position_s == pytest.approx(at_s)
        assert shown.state.q[0] == pytest.approx(0.1 * at_s, abs=0.011)
        assert shown.state.lever[0] == pytest.approx(0.5, abs=0.01)
        assert (shown.deadman, shown.state.guard) == (deadman, guard)
        assert shown.alive and shown.commands and shown.advice is not None
    assert shown.state.cause is GuardTrip.JOINTS_STALE and shown.state.observed_joint == 3
    assert shown.insertion is not None and len(shown.targets) == 1
    hole = shown.targets[0]
    assert (hole.name, hole.chosen, hole.radius_m) == ("7", True, 0.06)
    assert hole.center_in_base_m == pytest.approx(CENTER_M)
    json.dumps(shown.to_plain())


def test_what_had_not_come_yet_or_came_no_more_is_not_shown_as_fresh(
    feed: ReplayFeed, clock: Clock
) -> None:
    clock.now_s += 2.0
    shown = feed.read_state()
    assert [one.name for one in shown.streams if one.stale] == ["borehole"]
    assert shown.targets[0].name == "+"  # the advice had a target before a camera saw one
    clock.now_s += 7.0
    shown = feed.read_state()
    assert [one.name for one in shown.streams if one.stale] == ["levers"]
    assert not shown.deadman


def test_the_timeline_plays_stands_jumps_and_ends(feed: ReplayFeed, clock: Clock) -> None:
    def wish(kind: Any, value: str) -> None:
        assert feed.submit(OperatorRequest(kind, value))

    wish("seek", "6.5")
    assert feed.position_s == pytest.approx(6.5)
    clock.now_s += 1.0
    assert feed.position_s == pytest.approx(7.5)
    wish("play", "off")
    clock.now_s += 50.0
    assert feed.position_s == pytest.approx(7.5)
    wish("play", "0.25")
    clock.now_s += 4.0
    assert feed.position_s == pytest.approx(8.5)
    wish("play", "16")
    clock.now_s += 4.0
    assert feed.position_s == pytest.approx(10.0)  # its end
    wish("play", "1")
    assert feed.position_s == pytest.approx(0.0)  # from the beginning again
    wish("seek", "99999")
    assert feed.position_s == pytest.approx(10.0)
    assert not feed.submit(OperatorRequest("start", ""))


def test_marks_stand_where_something_happened(feed: ReplayFeed) -> None:
    replay = feed.read_state().replay
    assert replay is not None and replay.duration_s == pytest.approx(10.0)
    assert [(round(mark.t_s, 2), mark.kind, mark.name) for mark in replay.marks] == [
        (0.0, "state", "READY"),
        (4.0, "alarm", GuardTrip.JOINTS_STALE.value),
        (6.0, "request", "start"),
    ]


def test_a_recording_takes_no_requests_to_a_machine(feed: ReplayFeed) -> None:
    said = [json.dumps({"token": TOKEN})]
    words = ("start ", "stop ", "record on", "seek 2.5", "seek -1", "play off", "play nan")
    for kind, value in (word.split(" ") for word in words):
        said.append(json.dumps({"kind": kind, "value": value}))
    with served(feed) as port:
        answers = talk(port, "/control", said)[1:]
    refused = [one.get("refused", "") for one in answers]
    assert refused == ["replay", "replay", "replay", "", "malformed", "", "malformed"]
    assert feed.position_s == pytest.approx(2.5)


@pytest.mark.parametrize("name", ["nothing", "mini_excavator"])
def test_a_recording_that_cannot_be_shown_is_refused(
    capture: Path, tmp_path: Path, name: str
) -> None:
    replay: CaptureReplay = read_settings(capture)
    if name == "nothing":
        with pytest.raises(RecordingError, match="no such capture"):
            replace(replay, capture=str(tmp_path)).build(MACHINE)
    else:
        with pytest.raises(RecordingError, match="machine"):
            replay.build(option("machine", name))


def test_a_recording_without_guard_page_and_camera_can_be_shown(
    tmp_path: Path, clock: Clock
) -> None:
    bus = BusDescription(DBC, MACHINE)
    with CaptureWriter(CaptureConfig(tmp_path, DBC, MACHINE, {}, 0.0)) as log:
        for k in range(5):
            payload = bus.encode("JointPos1", {"Position_q1": 0.2, "Valid_q1": 1}, k)
            frame_id = bus.layouts["JointPos1"].frame_id
            header = FRAME.pack(BEGIN_S + 0.1 * k, frame_id, 0, len(payload))
            log.add(FRAMES + header + payload)
    found = read_settings(tmp_path)
    shown = ReplayFeed(found, MACHINE, read_capture(tmp_path / MCAP), clock).read_state()
    assert shown.state is not None and shown.state.q[0] == pytest.approx(0.2, abs=1e-3)
    assert shown.insertion is None and shown.targets == () and not shown.commands
    assert np.isfinite(shown.state.q).all()
    json.dumps(shown.to_plain())


def test_the_page_draws_the_timeline_and_moves_along_it(feed: ReplayFeed, browser: Any) -> None:
    feed.submit(OperatorRequest("play", "off"))
    with served(feed) as port:
        page = browser.new_page()
        page.goto(f"http://localhost:{port}/#token={TOKEN}")
        until(page, "window.measured?.allowed && document.querySelector('#marks i') !== null")
        assert page.locator("#stop").is_hidden() and page.locator("#start").is_hidden()
        assert page.locator("#marks i").count() == 3
        page.locator("#position").fill("5")
        until(page, "document.querySelector('#timeline output').textContent.startsWith('0:05.0')")
        assert feed.position_s == pytest.approx(5.0)
        page.keyboard.press("Space")
        until(page, "document.querySelector('#play').getAttribute('aria-pressed') === 'true'")
