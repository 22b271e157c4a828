"""Registries, help and the comments of composed values, as the command shows them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import hydra
import pandas as pd
import pytest
from conftest import Brokk
from omegaconf import OmegaConf

import brokk_rl
from brokk_rl.help import MAIN_MODES, collect_comments
from brokk_rl.modes import doctor
from brokk_rl.modes.doctor import Doctor, DoctorFinding


def test_the_version_needs_no_configuration(brokk: Brokk) -> None:
    done = brokk("--version")
    assert done.out.strip() == f"brokk {brokk_rl.__version__}"


def test_a_reader_that_stops_early_causes_no_traceback() -> None:
    command = [sys.executable, "-m", "brokk_rl", "mode=list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout and process.stderr
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(timeout=60) != 0


def test_the_list_can_be_narrowed_to_a_group(brokk: Brokk) -> None:
    done = brokk("mode=list", "list.group=perception")
    assert "truth" in done.out
    assert "borehole_insertion" not in done.out


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
    Doctor().run()
    lines = capsys.readouterr().out.splitlines()
    (broken,) = (line for line in lines if "Warp" in line)
    assert broken.startswith("warn") and "OSError: no such library" in broken
    assert sum(line.startswith("ok") for line in lines) == len(lines) - 1


def test_the_doctor_leaves_with_1_when_something_essential_fails(
    healthy: pytest.MonkeyPatch,
) -> None:
    healthy.setattr(doctor, "check_packages", lambda: DoctorFinding("fail", "too old"))
    with pytest.raises(SystemExit) as left:
        Doctor().run()
    assert left.value.code == 1


def test_a_full_disk_is_a_warning(tmp_path: Path) -> None:
    assert doctor.check_disk(tmp_path, 0.0).level == "ok"
    assert doctor.check_disk(tmp_path, 1e9).level == "warn"


@pytest.mark.parametrize("name", ["train", "export", "deploy", "study"])
def test_every_value_of_a_mode_is_listed(name: str, brokk: Brokk) -> None:
    done = brokk(f"mode={name}", "--help")
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", [f"mode={name}", *(["policy=trained"] * (name == "export"))])
    values = pd.json_normalize(OmegaConf.to_container(cfg))
    keys = [key for key in values if key.rpartition(".")[2] not in ("_target_", "run")]
    listed = {key for key in keys if f"  {key}=" in done.out}
    assert {key for key in keys if not key.startswith("policy.")} <= listed


@pytest.mark.parametrize("words", [(), ("--help",)], ids=str)
def test_the_command_alone_says_how_to_begin_and_starts_nothing(
    words: tuple[str, ...], brokk: Brokk, tmp_path: Path
) -> None:
    done = brokk(*words)
    assert not list(tmp_path.iterdir())
    for name in MAIN_MODES:
        assert f"brokk mode={name} " in done.out
    assert len(done.out.splitlines()) < 25


def test_values_that_bear_the_name_of_a_group_are_values(brokk: Brokk) -> None:
    told = brokk("mode=bench", "--help").out
    assert "bench.num_envs=[128,256]" in told and "bench=[" not in told


def test_comments_are_found_beside_and_above_their_values(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(
        "# Head of the file.\nx: 1   # m\ninner:   # of two\n  # s\n  y: {z: 2, w: '#3'}   # rad\nlist: [1]\n"
    )
    comments = collect_comments([("node", tmp_path / "a.yaml")])
    assert comments == {"node.x": "m", "node.inner": "of two", "node.inner.y": "rad"}
