"""Bad input gets a message that says what to change, exit code 2, and leaves nothing behind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

COMPARE = ("mode=compare", "compare.runs=nowhere")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("mode=lst",), ("there is no mode=lst", "did you mean 'list'?", "doctor")),
        (("mode=list", "task=borehole_insertion"), ("'task'", "mode=list does not use")),
        (("mode=list", "list.groop=task"), ("'list.groop'", "did you mean 'group'?")),
        (("mode=list", "list.group=actuatr"), ("did you mean 'actuator'?",)),
        (("mode=list", "session.seed=1"), ("'mode=list' has no 'session'",)),
        (("mode=list", "mode.x=["), ("input",)),
        (("mode=list", "list.group=a,b"), ("--multirun",)),
        (("mode=list", "experiment=nothing"), ("there is no", "experiment")),
        (
            (*COMPARE, "session.seed=abc"),
            ("Session.seed", "expected a whole number", "'abc'", "session.<field>="),
        ),
        ((*COMPARE, "session.seed=-1"), ("session.seed", "0 or more")),
        ((*COMPARE, "session.device=gpu"), ("session.device", "cpu", "'gpu'")),
        ((*COMPARE, "+session.sed=1"), ("no field 'sed'", "did you mean 'seed'?")),
        ((*COMPARE, "session=other"), ("there is no session=other", "default")),
        (COMPARE, ("compare.runs", "nowhere")),
        (("mode=compare",), ("compare.runs=<value>",)),
        (("-m", "mode=lst,list"), ("there is no mode=lst",)),
        (("-m", "mode=compare", "compare.runs=a,b"), ("compare.runs", "'a'")),
        (
            ("mode=perceive", "perception.filter.forget_s=3"),
            ("'perception.filter.forget_s' is now 'tracker.forget_s'",),
        ),
        (("mode=perceive", "perception.filter.gate=3"), ("'perception.filter' is now 'tracker'",)),
        (
            ("mode=perceive", "perception/filter=fusion"),
            ("'perception/filter' is now 'perception/tracker@tracker'",),
        ),
        (
            ("mode=deploy", "camera=pictures", "deploy.camera.forget_s=3"),
            ("'deploy.camera.forget_s' is now 'deploy.camera.tracker.forget_s'",),
        ),
        (
            ("effect=[backlash]", "effect.backlash.width=1"),
            ("'effect.backlash' has no 'width'", "gap_rad"),
        ),
        (("task=goal_pose", "task.hole.radius_m=1"), ("'task' has no 'hole'", "tolerance")),
        (
            ("mode=perceive", "perception/segmenter=onnx", "perception.segmenter.wrong=1"),
            ("'perception.segmenter' has no 'wrong'", "choices: gate, margin, threads, weights"),
        ),
        (
            ("-m", "effect=[backlash],[lag]", "effect.backlash.width=1"),
            ("'effect.backlash' has no 'width'",),
        ),
        (("mode=null",), ("must be a string",)),
        (("mode=study", "study.do=report", "study.folder=x"), ("x holds no study",)),
        (("mode=board", "board.rows=0"), ("expected 2 or more columns and rows, got",)),
        (("--config-dir", "nowhere", "mode=list"), ("nowhere",)),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_the_message_says_what_to_change(
    arguments: tuple[str, ...], told: tuple[str, ...], brokk: Callable[..., Any], tmp_path: Path
) -> None:
    done = brokk(*arguments)
    assert done.code == 2
    assert sum(line.startswith("error: ") for line in done.err.splitlines()) == 1
    for part in told:
        assert part in done.err
    assert "Traceback" not in done.err
    assert list(tmp_path.iterdir()) == []


def test_the_traceback_comes_on_request(
    brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BROKK_TRACE", "1")
    assert "Traceback" in brokk("mode=lst").err


def test_tab_completes_options(brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMP_LINE", "brokk mode=ide")
    monkeypatch.setenv("COMP_POINT", "14")
    assert "mode=identify" in brokk("-sc", "query=bash").out


def test_help_is_short_and_says_how_to_begin(brokk: Callable[..., Any]) -> None:
    done = brokk("--help")
    assert done.code == 0
    for part in ("brokk mode=list", "brokk mode=doctor", "-m", "session.out"):
        assert part in done.out
    assert len(done.out.splitlines()) < 25


def test_windows_is_refused_with_the_way_that_works(
    brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "win32")
    done = brokk("mode=list")
    assert done.code == 2 and "WSL 2" in done.err
