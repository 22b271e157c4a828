"""The package of `docs/extending.md` works as the page says: every file of it is written and used."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from composed import option
from packages import install_package

from brokk_rl import extensions
from brokk_rl.checks import check_actuator, check_effect, check_finder, check_task
from brokk_rl.machine import Machine

PAGE = (Path(__file__).parents[2] / "docs/extending.md").read_text()
FILES = dict(re.findall(r"^`mine/(\S+)`:\n\n```\w+\n(.*?)^```", PAGE, re.M | re.S))
TRAINING = next(line for line in PAGE.splitlines() if line.startswith("brokk mode=train "))


@pytest.fixture(autouse=True)
def package(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package `mine`, installed."""
    folder = tmp_path_factory.mktemp("site")
    install_package(folder, "mine", FILES, monkeypatch)
    extensions.register_options([])


def test_the_page_has_all_kinds_of_parts() -> None:
    groups = {path.split("/")[1] for path in FILES if path.startswith("conf/")}
    assert groups == {"actuator", "effect", "perception", "machine", "task"}


def test_the_checkers_accept_each_part(machine: Machine) -> None:
    two_links = option("machine", "two_links")
    for some in (machine, two_links):
        check_actuator(option("actuator", "rubber"), some)
        check_task(option("task", "hold"), some)
    check_effect(option("effect", "sag"), machine)
    check_finder(option("perception", "darkest"))


def test_its_options_are_listed(brokk: Callable[..., Any]) -> None:
    out = brokk("mode=list").out
    for text in ("rubber", "sag", "darkest", "two_links", "hold", "A planar arm of two links."):
        assert text in out


def test_all_of_it_trains_together(brokk: Callable[..., Any], tmp_path: Path) -> None:
    done = brokk(*shlex.split(TRAINING)[1:])
    assert done.code == 0, done.err
    evaluation = json.loads((tmp_path / "runs/mine/evaluation.json").read_text())
    assert evaluation["episodes"] == 16 and "success_strict" in evaluation
