"""The operator's page as a person has it before them: in a real browser, against a real server."""

from __future__ import annotations

import io
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browser import (
    READING,
    SHOWN,
    SIZE,
    STATE,
    TOKEN,
    Scripted,
    change_state,
    eventually,
    lever,
    opening,
    served,
    until,
)  # fmt: skip
from conftest import Note
from PIL import Image

from brokk_rl.signals import Frame
from deploy.kernel.guard import GuardState, GuardTrip
from deploy.page.protocol import OperatorRequest, RecordingStatus, SourceAge

TRAVEL = 95.0
NOT_CONFIRMED = "document.getElementById('answer').textContent.startsWith('STOP NOT CONFIRMED')"
FAILED = RecordingStatus(on=False, seconds=0.0, dropped=0, failed=True)


@pytest.fixture
def opened(browser: Any) -> Iterator[Callable[..., Any]]:
    with opening(browser, "() => window.measured.allowed !== null") as found:
        yield found


@pytest.fixture
def page(port: int, opened: Callable[..., Any]) -> Any:
    """A page that shows the feed."""
    return opened(port)


def drawn(page: Any) -> dict[str, tuple[float, float]]:
    """Returns where each mark is drawn, of full travel: psi to the right, theta up."""
    text = page.evaluate(
        """() => Object.fromEntries(["left", "right"].flatMap(side => ["own", "advised"].map(what =>
        [`${side} ${what}`, document.querySelector(`#${side} > g.${what}`).getAttribute("transform")])))"""
    )
    found = {}
    for name, transform in text.items():
        x, y = map(float, re.findall(r"-?[\d.]+", transform))
        found[name] = (x / TRAVEL, -y / TRAVEL)
    return found


def test_levers_are_drawn_where_they_are_and_should_be(feed: Scripted, page: Any) -> None:
    feed.now = replace(feed.now, state=replace(STATE, lever=lever(0.5, -0.25, -1.0, 1.0)))
    feed.advise(2, left_theta=-0.75, left_psi=1.0, right_theta=0.1, right_psi=-0.6)
    eventually(lambda: drawn(page)["left advised"] != (0.0, 0.0))
    found = drawn(page)
    assert found["left own"] == pytest.approx((-0.25, 0.5), abs=1e-3)
    assert found["left advised"] == pytest.approx((1.0, -0.75), abs=1e-3)
    assert found["right own"] == pytest.approx((1.0, -1.0), abs=1e-3)
    assert found["right advised"] == pytest.approx((-0.6, 0.1), abs=1e-3)


def test_the_button_is_announced_and_then_green(feed: Scripted, page: Any) -> None:
    button = page.locator("#button")
    assert button.inner_text().strip() == "", "no instruction where there is none"
    feed.now = change_state(SHOWN, button_right=True)
    page.wait_for_selector("#button.wrong")
    assert button.inner_text().strip() == "Arm 1: Release button"
    feed.now = SHOWN
    feed.advise(2, due_s=1.2)
    page.wait_for_selector("#button.due")
    assert "1.2 s" in button.inner_text()
    began_s = time.monotonic()
    feed.advise(3, due_s=0.0, button_right=True, right_theta=0.5)
    page.wait_for_selector("#button.now")
    assert time.monotonic() - began_s < 2.0
    assert button.evaluate("node => getComputedStyle(node).backgroundColor") == "rgb(0, 117, 43)"
    assert "HOLD" in button.inner_text()
    # the shared axis bears the name of the joint that is meant
    assert page.locator("#right text", has_text="Arm 1").count() == 1


def test_what_is_stale_is_grey_and_says_so(feed: Scripted, page: Any) -> None:
    feed.advise(2, due_s=0.0, button_right=True, right_theta=0.5)
    page.wait_for_selector("#button.now")
    old = tuple(
        replace(one, age_s=0.4, limit_s=0.15) if one.name == "advice" else one
        for one in SHOWN.streams
    )
    feed.now = replace(feed.now, streams=old)
    page.wait_for_selector("#left.stale")
    page.wait_for_selector("#button.stale:not(.now)")
    target = page.locator("#left .advised .target")
    stroke = target.evaluate("node => getComputedStyle(node).stroke")
    assert stroke == "rgb(118, 118, 118)"
    assert page.locator("#streams li.stale").get_attribute("data-stream") == "advice"
    own = page.locator("#right .own circle").evaluate("node => getComputedStyle(node).fill")
    assert own == "rgb(10, 75, 209)", "the rest stays"


def test_a_stream_that_stops_grows_old_by_itself(
    feed: Scripted, port: int, opened: Callable[..., Any]
) -> None:
    feed.now = replace(feed.now, streams=(SourceAge("positions", 0.0, 0.1), *SHOWN.streams[1:]))
    page = opened(port)
    page.wait_for_selector("#streams li[data-stream=positions]:not(.stale)")
    # a clock that gains 0.2 s whenever it is asked: whatever came is that old when it is drawn
    page.evaluate(
        "performance.now = ((real, ahead) => () => real() + (ahead += 200))(performance.now.bind(performance), 0)"
    )
    page.wait_for_selector("body.lost, #streams li.stale[data-stream=positions]")


def test_the_page_comes_back_after_the_server_was_away(
    feed: Scripted, opened: Callable[..., Any]
) -> None:
    with served(feed) as port:
        page = opened(port)
        page.wait_for_selector("body:not(.lost)")
    page.wait_for_selector("body.lost")
    assert page.locator("#connection").inner_text() == "NO CONNECTION"
    feed.advise(7, left_psi=0.9)
    with served(feed, port):
        page.wait_for_selector("body:not(.lost)")
        eventually(lambda: drawn(page)["left advised"] == pytest.approx((0.9, 0.0), abs=1e-3))
        # Until then it says that it has no connection.
        eventually(lambda: page.keyboard.press("g") or feed.requests)
        assert set(feed.requests) == {OperatorRequest("start", "")}


def list_alarms(page: Any) -> list[str]:
    """Return the names of the alarms that the page shows."""
    texts = page.locator("#alarms .alarm").all_inner_texts()
    return [one.partition(":")[0].partition(" ·")[0] for one in texts]


def test_a_stop_at_a_hung_or_dead_server_is_not_confirmed_and_nothing_old_is_shown(
    feed: Scripted,
    opened: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
    record_property: Note,
) -> None:
    active = change_state(SHOWN, guard=GuardState.ACTIVE, trip=GuardTrip.NONE)
    feed.now = replace(active, commands=True)
    with served(feed) as port:
        page = opened(port)
        page.wait_for_selector("body:not(.lost)")
        assert page.locator("#safety").inner_text() == "COMMANDS VALVES – all is well"
        # The server hangs for two seconds: its one thread waits for the feed.
        monkeypatch.setattr(feed, "submit", lambda request: time.sleep(2.0) or True)
        page.keyboard.press("Escape")
        pressed_s = time.monotonic()
        until(page, NOT_CONFIRMED, 1.0)
        told_s = round(time.monotonic() - pressed_s, 2)
        record_property("page: STOP at a hung server; NOT CONFIRMED after, s", told_s)
        page.wait_for_selector("body.lost", timeout=1500)
        assert time.monotonic() - pressed_s < 1.0
        assert page.locator("#safety").inner_text() == "Unknown"
        assert page.locator("#deadman").inner_text() == "Unknown"
        assert page.locator("#scene").is_hidden() and page.locator("#left").is_hidden()
        # The list is drawn a few times a second, the answer at once.
        eventually(lambda: list_alarms(page) == ["STOP NOT CONFIRMED", "NO CONNECTION"])
        monkeypatch.undo()
        page.wait_for_selector("body:not(.lost)")
        page.keyboard.press("Escape")
        eventually(lambda: page.locator("#answer").inner_text() == "")
    page.wait_for_selector("body.lost")
    page.keyboard.press("Escape")
    until(page, NOT_CONFIRMED, 1.0)


def test_words_follow_the_mode(feed: Scripted, page: Any, record_property: Note) -> None:
    start, advice = page.locator("#start b"), page.locator("#advice")
    assert (start.inner_text(), advice.inner_text()) == ("Guide me", "Bring your levers to green")
    feed.now = replace(SHOWN, commands=True)
    eventually(lambda: start.inner_text() == "Arm")
    assert advice.inner_text() == "The machine moves by itself: hands off the levers"
    words = f"{start.inner_text()}; {advice.inner_text()}"
    record_property("page: auto; its button and words", words)
    feed.now = replace(SHOWN, commands=True, guiding=False)
    eventually(lambda: advice.inner_text() == "Nothing is sent")


def test_a_touch_answers_the_question_whether_somebody_is_there(feed: Scripted, page: Any) -> None:
    page.click("#levers")
    feed.now = change_state(SHOWN, prompt=True)
    eventually(lambda: "Still there?" in page.locator("#alarms").inner_text())
    assert feed.requests == []
    page.click("#levers")
    eventually(lambda: feed.requests == [OperatorRequest("present", "")])


def test_safety_and_connection_are_told_apart_in_words(feed: Scripted, page: Any) -> None:
    assert page.locator("#safety.good").inner_text() == "Listens only"
    latched = change_state(SHOWN, guard=GuardState.LATCHED, trip=GuardTrip.CHANNEL_INVALID)
    feed.now = replace(latched, commands=True)
    page.wait_for_selector("#safety.bad")
    told = "LATCHED – messages corrupted or from two senders"
    assert page.locator("#safety").inner_text() == told
    feed.now = change_state(SHOWN, estop=True, trip=GuardTrip.ESTOP)
    until(page, "document.getElementById('safety').textContent.includes('EMERGENCY STOP')")
    page.wait_for_selector("#deadman.careful")
    feed.now = replace(SHOWN, alive=False)
    page.wait_for_selector("#connection.bad")
    assert page.locator("#left.stale").count() == 1


def test_alarms_are_listed_by_gravity_and_stay_a_while_after_they_have_passed(
    feed: Scripted, page: Any
) -> None:
    assert page.locator("#alarms").is_hidden()
    dead = (SourceAge("camera", 3.0, 1.0), *SHOWN.streams)
    health = replace(SHOWN.health, delay_s=0.09, supervisor_silent=True)
    feed.now = replace(SHOWN, streams=dead, recording=FAILED, health=health)
    page.wait_for_selector("#alarms .alarm")
    lines = page.locator("#alarms li")
    eventually(lambda: lines.count() == 4)
    assert [text.partition(" ·")[0] for text in lines.all_inner_texts()] == [
        "Too old: Camera",
        "Supervisor silent: no recording, no start",
        "RECORDING HAS FAILED",
        "Messages arrive late: 90 ms",
    ]
    assert lines.nth(3).get_attribute("class") == "caution"
    until(page, "() => window.measured.signals.filter(name => name === 'alarm').length === 1")
    feed.now = SHOWN
    page.wait_for_selector("#alarms li.over")
    assert page.locator("#alarms .alarm").count() == 0


def test_depth_lateral_distance_and_angle_are_shown_and_inserted_is_said(
    feed: Scripted, page: Any
) -> None:
    assert page.locator("#insertion").is_hidden(), "nothing is measured yet"
    feed.now = replace(SHOWN, insertion=READING)
    page.wait_for_selector("#insertion:not([hidden])")
    numbers = page.locator("#insertion dd").all_inner_texts()
    assert numbers == ["-120 mm", "34 mm", "2.9°"]
    assert page.locator("#insertion .inserted").inner_text() == "Over the hole"
    # the rim lies where the reading says, right and up, on the same scale as its radius
    rim = page.locator(".along .rim")
    x, y = map(float, re.findall(r"translate\((\S+) (\S+)\)", rim.get_attribute("transform"))[0])
    scale = float(rim.get_attribute("ry")) / 0.05
    assert (x / scale, -y / scale) == pytest.approx((0.03, 0.016), abs=1e-3)
    deep = replace(READING, depth_m=0.13, lateral_m=0.01, inserted=True)
    feed.now = replace(SHOWN, insertion=deep)
    page.wait_for_selector("#insertion.in")
    assert page.locator("#insertion .inserted").inner_text() == "INSERTED"
    assert "inserted" in page.evaluate("window.measured.signals")
    tip = page.locator(".depth .tip").get_attribute("transform")
    wanted = float(page.locator(".depth .wanted").get_attribute("y1"))
    assert float(re.findall(r"[\d.]+", tip)[1]) > wanted, "the tip lies below the mark"
    old = tuple(replace(one, age_s=1.0, limit_s=0.1) for one in SHOWN.streams)
    feed.now = replace(feed.now, streams=old)
    page.wait_for_selector("#insertion.stale:not(.in)")


def test_the_night_is_dark_and_can_be_read(page: Any) -> None:

    def luminance(name: str, what: str) -> float:
        text = page.locator(name).first.evaluate(f"node => getComputedStyle(node).{what}")
        parts = np.array([float(part) / 255 for part in re.findall(r"[\d.]+", text)[:3]])
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    assert luminance("body", "backgroundColor") == pytest.approx(1.0)
    page.keyboard.press("n")
    page.wait_for_selector(":root.night")
    paper = luminance("body", "backgroundColor")
    assert paper < 0.01
    for name in ("body", "#safety", "#streams li", "#deadman", "#targets button"):
        # contrast of WCAG 2
        assert (luminance(name, "color") + 0.05) / (paper + 0.05) >= 4.5, name
    text, behind = luminance("#stop", "color"), luminance("#stop", "backgroundColor")
    assert (text + 0.05) / (behind + 0.05) >= 4.5
    page.reload()
    page.wait_for_selector(":root.night")


def test_everything_is_done_by_keys_and_by_gloves(
    feed: Scripted, port: int, opened: Callable[..., Any]
) -> None:
    page = opened(port, query="?lang=de")
    for key, wish in (
        ("g", OperatorRequest("start", "")),
        ("Escape", OperatorRequest("stop", "")),
        ("r", OperatorRequest("record", "on")),
        ("2", OperatorRequest("target", "B")),
    ):
        page.keyboard.press(key)
        eventually(lambda wish=wish: feed.requests[-1:] == [wish])
    for name, wish in (
        ("#start", OperatorRequest("start", "")),
        ("#stop", OperatorRequest("stop", "")),
        ("#record", OperatorRequest("record", "on")),
    ):
        page.click(name)
        eventually(lambda wish=wish: feed.requests[-1] == wish)
    for button in page.locator("button:visible").all():
        box = button.bounding_box()
        # 15 mm by CSS.
        assert min(box["width"], box["height"]) >= 15 / 25.4 * 96, button.inner_text()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= SIZE["width"]
        assert box["y"] + box["height"] <= SIZE["height"]
    reached = set()
    for _ in range(13):
        page.keyboard.press("Tab")
        focus = "document.activeElement"
        reached.add(page.evaluate(f"{focus}.id || {focus}.dataset.target"))
    assert {"language", "scene", "A", "B", "start", "stop", "record"} <= reached
    assert {"along", "sound", "night"} <= reached


def test_without_dead_man_or_token_nothing_is_done_and_the_page_says_why(
    feed: Scripted, port: int, opened: Callable[..., Any]
) -> None:
    feed.now = change_state(SHOWN, deadman=False)
    page = opened(port)
    page.click("#start")
    until(page, "document.getElementById('answer').textContent === 'Refused: hold the dead-man'")
    assert feed.requests == []
    page.click("#stop")
    eventually(lambda: feed.requests == [OperatorRequest("stop", "")])
    feed.now = SHOWN
    for token in ("wrong", None):
        stranger = opened(port, token=token)
        stranger.click("#start")
        until(stranger, "document.getElementById('answer').textContent.startsWith('No access')")
        stranger.click("#stop")
        until(stranger, NOT_CONFIRMED)
    time.sleep(0.2)
    assert len(feed.requests) == 1


def test_the_token_leaves_the_address_bar(page: Any) -> None:
    assert TOKEN not in page.url
    page.reload()
    until(page, "() => window.measured?.allowed === true")
    page.keyboard.press("Escape")
    until(page, "document.getElementById('answer').textContent === ''")


def test_the_scene_shows_machine_points_and_picture(
    feed: Scripted, port: int, opened: Callable[..., Any]
) -> None:
    color = np.zeros((90, 160, 3), np.uint8)
    color[:] = (230, 20, 200)  # nothing else on the page is magenta
    pose = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.6], [0, 0, 0, 1.0]])
    matrix = np.array([[120.0, 0, 79.5], [0, 120.0, 44.5], [0, 0, 1.0]])
    feed.now = replace(SHOWN, streams=(*SHOWN.streams, SourceAge("camera", 0.0, 1e6)))
    page = opened(port, scene=True)
    until(page, "window.measured.frames === 0")
    feed.picture = Frame(color, np.full((90, 160), 3.0, np.float32), matrix, pose, 1.0)
    until(page, "window.measured.frames >= 1 && window.measured.points === 14400")
    eventually(lambda: _share(page, "#scene", [230, 20, 200]) > 0.05, 20)
    assert _share(page, "#scene", [190, 130, 10], 60) > 0.005, "the machine's paint"
    assert _share(page, "#picture", [230, 20, 200]) > 0.8
    assert page.locator("#noscene").is_hidden()


def _share(page: Any, name: str, color: list[int], within: int = 25) -> float:
    shot = Image.open(io.BytesIO(page.locator(name).screenshot()))
    picture = np.asarray(shot.convert("RGB")).astype(int)
    return float((np.abs(picture - color) < within).all(-1).mean())


def test_a_touch_in_the_picture_is_a_place_in_it_whatever_its_size(
    feed: Scripted, page: Any
) -> None:
    feed.now = replace(SHOWN, streams=(*SHOWN.streams, SourceAge("camera", 0.0, 1e6)))
    until(page, "!document.getElementById('camera').hidden")
    box = page.locator("#picture").bounding_box()
    page.locator("#picture").click(position={"x": 0.25 * box["width"], "y": 0.6 * box["height"]})
    eventually(lambda: bool(feed.requests))
    wish = feed.requests[-1]
    assert wish.kind == "point"
    assert [float(part) for part in wish.value.split(",")] == pytest.approx([0.25, 0.6], abs=0.01)


AREAS = ("#view", "#insertion", "aside", "#levers")
SIZES = [(640, 400), (800, 600), (1100, 700), (1280, 800), (1600, 900), (1920, 1080), (768, 1024)]
SIZES += [(640, 1000), (390, 844)]
WINDOWS = [("de", size) for size in SIZES] + [("en", (640, 400)), ("en", (390, 844))]
"""German words are the longer ones."""


@pytest.mark.parametrize(("language", "size"), WINDOWS, ids=str)
def test_nothing_overlaps_and_stop_stays_in_sight(
    feed: Scripted,
    port: int,
    opened: Callable[..., Any],
    size: tuple[int, int],
    language: str,
    record_property: Note,
) -> None:
    streams = (*SHOWN.streams, SourceAge("camera", 0.0, 1e6))
    failed = replace(SHOWN, commands=True, streams=streams, recording=FAILED, insertion=READING)
    # the longest words that the header has to hold
    feed.now = change_state(failed, guard=GuardState.LATCHED, trip=GuardTrip.ROUND_TRIP)
    feed.now = change_state(feed.now, cause=GuardTrip.ROUND_TRIP)
    page = opened(port, query=f"?lang={language}")
    page.set_viewport_size({"width": size[0], "height": size[1]})
    until(page, "!document.getElementById('camera').hidden")
    stop = page.locator("#stop").bounding_box()
    assert stop["x"] >= 0 and stop["x"] + stop["width"] <= size[0]
    assert stop["y"] >= 0 and stop["y"] + stop["height"] <= size[1]
    for name in ("#start", "#record"):
        other = page.locator(name).bounding_box()
        aside = max(other["x"] - stop["x"] - stop["width"], stop["x"] - other["x"] - other["width"])
        above = max(
            other["y"] - stop["y"] - stop["height"], stop["y"] - other["y"] - other["height"]
        )
        assert max(aside, above) >= 20
        apart_px = round(max(aside, above))
        record_property("page: STOP; apart from the next button, px", apart_px)
    if size[0] <= 600:
        assert page.locator("#view #along").count() == 0, "it would cover the machine"
    cut = page.evaluate(
        """() => [...document.querySelectorAll("button, dl, .inserted, #levers, #middle, #advice, #boreholes, header, header > *")]
        .filter(node =>
        node.scrollHeight > node.clientHeight + 1 || node.scrollWidth > node.clientWidth + 1)
        .map(node => node.id + node.textContent)"""
    )
    assert cut == []
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    # the rest of a narrow screen scrolls above the buttons
    apart_from_buttons = page.evaluate(
        """() => { const work = document.getElementById("work").getBoundingClientRect();
        const stop = document.getElementById("actions").getBoundingClientRect();
        return work.height === 0 || work.bottom <= stop.top + 1; }"""
    )
    assert apart_from_buttons
    boxes = [page.locator(name).bounding_box() for name in AREAS]
    for number, one in enumerate(boxes):
        for other in boxes[number + 1 :]:
            apart = (
                one["x"] + one["width"] <= other["x"] + 1,
                other["x"] + other["width"] <= one["x"] + 1,
                one["y"] + one["height"] <= other["y"] + 1,
                other["y"] + other["height"] <= one["y"] + 1,
            )
            assert any(apart)
