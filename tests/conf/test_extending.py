"""The example package installs, passes its own tests and trains by the command of `docs/extending.md`."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from composed import MACHINE, option
from conftest import Brokk
from packages import install_example

from brokk_rl.checks import check_actuator, check_task

ROOT = Path(__file__).parents[2]
PROJECT = ROOT / "examples/my_package"
PAGE = (ROOT / "docs/extending.md").read_text()
TRAINING = next(line for line in PAGE.splitlines() if line.startswith("brokk experiment="))
SHORT = ("rl.num_envs=8", "rl.num_starts=64", "rl.budget.max_seconds=3", "evaluation.episodes=16")
"""Changes of the page's training for a test: some seconds instead of a minute."""


@pytest.fixture
def site(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the example package, installed."""
    return install_example(tmp_path_factory.mktemp("site"), monkeypatch)


def test_the_package_passes_its_own_tests(site: Path) -> None:
    path = os.pathsep.join((str(site), str(ROOT)))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(PROJECT / "tests")],
        cwd=site,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert "12 passed" in done.stdout


def test_the_parts_work_with_the_shipped_machine_too(site: Path) -> None:
    check_actuator(option("actuator", "my_rubber"), MACHINE)
    check_task(option("task", "my_trace"), MACHINE)


def test_all_of_it_trains_together(site: Path, brokk: Brokk, tmp_path: Path) -> None:
    """A number of its own reward reaches the training from the command line, and so do its words."""
    done = brokk(*shlex.split(TRAINING)[1:], *SHORT, "task.reward.closeness.params.scale_m=0.2")
    assert "on the line" in done.out and "paper" not in done.out and "insert" not in done.out
    evaluation = json.loads((tmp_path / "runs/mine/evaluation.json").read_text())
    assert evaluation["episodes"] == 16 and "success_strict" in evaluation
    endings = evaluation["terminations"]
    assert list(endings) == ["joint_limit", "strayed", "fault", "time_limit"]
    assert sum(endings.values()) == 16
    contract = json.loads((tmp_path / "runs/mine/policy.json").read_text())
    assert contract["task"]["name"] == "my_trace" and contract["observation"]["size"] == 22
    example = [sys.executable, str(ROOT / "examples/run_policy.py"), "runs/mine"]
    out = subprocess.run(example, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert float(out.split()[-1]) < 1e-4
