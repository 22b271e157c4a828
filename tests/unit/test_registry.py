"""Registries and the modes that show them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import brokk_rl
from brokk_rl.modes import doctor
from brokk_rl.modes.doctor import Doctor, DoctorFinding, DoctorLimits


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
    healthy.setattr(doctor, "check_packages", lambda: DoctorFinding("fail", "too old"))
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
    for topic in ("packages", "torch", "Warp", "rendering", "disk", "import names"):
        assert topic in done.out
