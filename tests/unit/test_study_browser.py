"""The study's pages in a real browser: NASA-TLX by click and by key, in both languages, gone on with after either side crashed."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import SHOWN, Scripted, opening, served, until
from composed import MACHINE
from sitting import Arm, agreed, conductor, done, plan

from study import tlx
from study.conductor import Conductor
from study.sitting import StudyFeed, StudyPages


@pytest.fixture
def lead(tmp_path: Path) -> Conductor:
    plan(tmp_path)
    return conductor(tmp_path, Arm())


@pytest.fixture
def asked(lead: Conductor) -> Conductor:
    """Everything before the first questionnaire is done, before a server also lets time go by."""
    agreed(lead)
    for _ in range(2):
        done(lead, lead._stage)  # type: ignore[arg-type]
    return lead


@pytest.fixture
def port(lead: Conductor) -> Iterator[int]:
    with served(StudyFeed(Scripted(SHOWN), lead), extensions=(StudyPages(lead),)) as found:
        yield found


@pytest.fixture
def opened(browser: Any) -> Iterator[Callable[..., Any]]:
    with opening(browser, "() => Boolean(window.sitting())", has_touch=True) as found:
        yield found


def at(page: Any, screen: int) -> None:
    until(page, f"() => window.sitting().at === {screen}")


def answers(place: Path) -> dict[str, Any]:
    return json.loads((place / "questionnaires" / "P01_1.json").read_text())


def test_a_sitting_is_walked_through_by_touch(
    tmp_path: Path, lead: Conductor, port: int, opened: Callable[..., Any]
) -> None:
    page = opened(port)
    page.locator("#study .people button", has_text="P01").tap()
    until(page, "() => window.sitting().kind === 'consent'")
    assert "You may stop at any time." in page.locator("#study .screen").inner_text()
    page.locator("#study .primary").tap()
    until(page, "() => window.sitting().kind === 'trial'")
    condition = lead.view()["condition"]
    title = "With guidance" if condition == "guided" else "Without guidance"
    assert page.locator("#study h1").inner_text() == title
    assert page.locator("#study .joints .there").count() == 5
    page.locator("#begin").tap()
    until(page, "() => window.sitting().phase === 'countdown'")
    arm: Any = lead._stage
    arm.now_s += 5.0
    until(page, "() => window.sitting().phase === 'running'")
    # the operator's page is seen then, and its levers follow the condition
    assert page.locator("#left").is_visible()
    assert page.locator("#study").get_attribute("class") == "bar"
    assert not page.locator("#record").is_visible() and page.locator("#stop").is_visible()
    until(page, f"() => document.body.classList.contains('lost') || {str(condition == 'guided').lower()} === "
                "(document.querySelector('#advice').textContent !== 'Guidance is off')")  # fmt: skip
    arm.now_s += 3.0
    arm.q = MACHINE.home
    until(page, "() => window.sitting().phase === 'settling'")
    arm.now_s += 1.0
    until(page, "() => window.sitting().phase === 'over'")
    assert page.locator("#study h1").inner_text().startswith("Inserted: ")
    page.keyboard.press("Enter")
    until(page, "() => window.sitting().done === 1")
    assert json.loads((tmp_path / "trials" / "P01_1_01.json").read_text())["outcome"] == "inserted"


def test_the_whole_questionnaire_by_key_in_german(
    tmp_path: Path, asked: Conductor, port: int, opened: Callable[..., Any]
) -> None:
    page = opened(port, query="?lang=de")
    at(page, 0)
    assert page.locator("#study h1").inner_text() == "Geistige Anforderung"
    assert page.evaluate("document.documentElement.lang") == "de"
    for screen in range(6):
        at(page, screen)
        for key in ("ArrowRight", *["ArrowRight"] * screen, "ArrowLeft"):
            page.keyboard.press(key)
        rating = f"window.sitting().ratings[window.sitting().scales[{screen}]]"
        until(page, f"() => {rating} === {45 + 5 * screen}")
        page.keyboard.press("Enter")
    at(page, 6)
    page.keyboard.press("Backspace")
    at(page, 5)
    page.keyboard.press("Enter")
    at(page, 6)
    assert page.locator("#study h1").inner_text() == "Alle Fragen sind beantwortet"
    page.keyboard.press("Enter")
    until(page, "() => window.sitting().kind === 'trial'")
    found = answers(tmp_path)
    assert list(found["ratings"].values()) == [45, 50, 55, 60, 65, 70]
    assert tlx.compute_scores(found)[0]["raw"] == 57.5


def test_stopping_takes_two_presses_and_is_kept(
    tmp_path: Path, asked: Conductor, port: int, opened: Callable[..., Any]
) -> None:
    page = opened(port)
    page.locator("#study .leave").click()
    assert asked.view()["kind"] == "questionnaire"
    page.locator("#study .leave", has_text="Really stop").click()
    until(page, "() => window.sitting().kind === 'stopped'")
    assert json.loads((tmp_path / "participants" / "P01.json").read_text())["stopped"] is True
    assert len(list((tmp_path / "trials").iterdir())) == 2
