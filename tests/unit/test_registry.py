"""Registries and the modes that show them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from composed import option as load_option

import brokk_rl
from brokk_rl import registry
from brokk_rl.errors import ConfigError
from brokk_rl.modes import doctor
from brokk_rl.modes.doctor import Doctor, DoctorFinding, DoctorLimits
from brokk_rl.registry import Option


def option(folder: Path, group: str, text: str) -> Option:
    (folder / "a.yaml").write_text(text)
    return Option(group, "a", "conf", folder / "a.yaml")


def test_an_option_without_a_comment_is_described_by_its_target(tmp_path: Path) -> None:
    text = "_target_: brokk_rl.modes.list.ListOptions\n"
    summary = "List the options of every config group, one line each."
    assert option(tmp_path, "mode", text).summary() == summary
    assert option(tmp_path, "mode", "# Another.\n" + text).summary() == "Another."


def test_the_version_needs_no_configuration(brokk: Callable[..., Any]) -> None:
    done = brokk("--version")
    assert done.code == 0
    assert done.out.strip() == f"brokk {brokk_rl.__version__}"


def test_a_reader_that_stops_early_causes_no_traceback() -> None:
    command = [sys.executable, "-m", "brokk_rl", "mode=list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout and process.stderr
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(timeout=60) != 0


def test_an_override_is_described_by_the_first_sentence_of_its_comment(tmp_path: Path) -> None:
    text = "# @package _global_\n# What happens without\n# a mask. Sweeps 2 seeds.\n# More.\ntask: {}\n"
    assert option(tmp_path, "experiment", text).summary() == "What happens without a mask."


LONGEST_SUMMARY = 58
"""Characters: 80 columns less the longest name (18), its margins (2 + 2)."""


def test_texts_of_the_list_are_short_and_distinct() -> None:
    first: dict[tuple[str, str], str] = {}
    wrong = []
    for option in registry.list_options():
        name, text = f"{option.group}={option.name}", option.summary()
        if not 0 < len(text) <= LONGEST_SUMMARY or "…" in text:
            wrong.append(f"{name}: {len(text)} characters")
        if (other := first.setdefault((option.group, text.lower()), name)) != name:
            wrong.append(f"{name}: same text as {other}")
    assert wrong == []


def test_the_list_cuts_no_text(brokk: Callable[..., Any]) -> None:
    lines = brokk("mode=list").out.splitlines()
    for option in registry.list_options():
        assert any(option.name in line and option.summary() in line for line in lines)


def test_a_spec_that_cannot_be_found_does_not_break_the_list(tmp_path: Path) -> None:
    assert (
        option(tmp_path, "task", "# A comment.\n_target_: nowhere.at.All\n").summary()
        == "A comment."
    )


def test_the_list_can_be_narrowed_to_a_group(brokk: Callable[..., Any]) -> None:
    done = brokk("mode=list", "list.group=perception")
    assert "truth" in done.out
    assert "borehole_insertion" not in done.out


LIMITS = DoctorLimits(folder="runs", min_free_gib=0.0)


@pytest.fixture
def healthy(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Sets checks; all of them find that everything works, at once."""
    for name in dir(doctor):
        if name.startswith("check_"):
            monkeypatch.setattr(doctor, name, lambda *_: DoctorFinding("ok", "works"))
    return monkeypatch


def test_a_check_that_breaks_is_a_warning_and_the_others_go_on(
    healthy: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def break_down() -> DoctorFinding:
        raise OSError("no such library")

    healthy.setattr(doctor, "check_warp", break_down)
    Doctor(doctor=LIMITS).run()
    lines = capsys.readouterr().out.splitlines()
    (broken,) = (line for line in lines if "Warp" in line)
    assert broken.startswith("warn") and "OSError: no such library" in broken
    assert sum(line.startswith("ok") for line in lines) == len(lines) - 1


def test_the_doctor_leaves_with_1_when_something_essential_fails(
    healthy: pytest.MonkeyPatch,
) -> None:
    healthy.setattr(doctor, "check_python", lambda: DoctorFinding("fail", "too old"))
    with pytest.raises(SystemExit) as left:
        Doctor(doctor=LIMITS).run()
    assert left.value.code == 1


def test_a_full_disk_is_a_warning_and_our_import_names_are_ours(tmp_path: Path) -> None:
    assert doctor.check_disk(tmp_path, 0.0).level == "ok"
    assert doctor.check_disk(tmp_path, 1e9).level == "warn"
    assert doctor.check_import_names().level == "ok"


@pytest.mark.slow
def test_the_doctor_runs_here(brokk: Callable[..., Any]) -> None:
    done = brokk("mode=doctor")
    assert done.code == 0, done.out
    for topic in (
        "Python",
        "torch",
        "Warp",
        "kernel cache",
        "rendering",
        "disk",
        "import names",
        "extensions",
    ):
        assert topic in done.out


def test_an_option_that_does_not_exist_is_told_with_the_choices_in_a_program_too() -> None:
    with pytest.raises(
        ConfigError, match=r"no machine=brokk17; did you mean 'brokk170'\? choices: "
    ):
        load_option("machine", "brokk17")
