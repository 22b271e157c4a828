"""A new package installs, passes its own tests and trains; `docs/extending.md` shows its files."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from composed import option
from packages import forget_package, install_package

from brokk_rl import extensions
from brokk_rl.checks import check_actuator, check_task
from brokk_rl.machine import Machine
from brokk_rl.modes.new import NewPackage, PackageRequest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/extending.md").read_text()
SHOWN = dict(re.findall(r"^`mine/(\S+)`:\n\n```\w+\n(.*?)^```", PAGE, re.M | re.S))
TRAINING = next(line for line in PAGE.splitlines() if line.startswith("brokk experiment="))
SHORT = (
    "rl.num_envs=8", "rl.num_starts=64", "rl.budget.max_seconds=3", "evaluation.episodes=16",
)  # fmt: skip
"""Changes of the page's training for a test: some seconds instead of a minute."""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project that `mode=new` writes."""
    folder = tmp_path_factory.mktemp("projects")
    forget_package("mine")
    NewPackage(new=PackageRequest(name="mine", folder=str(folder))).run()
    return folder / "mine"


@pytest.fixture
def site(
    project: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A folder with the package `mine`, installed."""
    folder, package = tmp_path_factory.mktemp("site"), project / "mine"
    files = {}
    for path in package.rglob("*.*"):
        files[str(path.relative_to(package))] = path.read_text()
    install_package(folder, "mine", files, monkeypatch)
    extensions.register_options([])
    return folder


def test_the_page_shows_the_files_of_a_new_package(project: Path) -> None:
    groups = {path.split("/")[1] for path in SHOWN if path.startswith("conf/")}
    assert groups == {"actuator", "effect", "perception", "machine", "task", "experiment"}
    for name, text in SHOWN.items():
        assert (project / "mine" / name).read_text() == text


def test_a_new_package_passes_its_own_tests(project: Path, site: Path) -> None:
    path = os.pathsep.join((str(site), str(ROOT)))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(project / "tests")],
        cwd=project,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert "7 passed" in done.stdout


def test_no_name_of_the_template_is_left(tmp_path: Path) -> None:
    NewPackage(new=PackageRequest(name="ours", folder=str(tmp_path))).run()
    names = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")}
    assert "ours/ours/conf/machine/two_links.xml" in names and "ours/tests/test_parts.py" in names
    for path in tmp_path.rglob("*.*"):
        assert not re.search(r"\bmine\b", path.read_text()), path


@pytest.mark.parametrize(
    ("name", "told"),
    [("torch", "installed already"), ("my-brokk", "a Python package name"), ("class", "name")],
)
def test_a_name_that_cannot_be_one_is_refused(
    name: str, told: str, brokk: Callable[..., Any], tmp_path: Path
) -> None:
    done = brokk("mode=new", f"new.name={name}")
    assert done.code == 2 and told in done.err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_exists_is_left_alone(brokk: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "my_brokk").mkdir()
    done = brokk("mode=new", "new.name=my_brokk")
    assert done.code == 2 and "exists already" in done.err
    assert [path.name for path in tmp_path.rglob("*")] == ["my_brokk"]


def test_the_parts_work_with_the_shipped_machine_too(site: Path, machine: Machine) -> None:
    check_actuator(option("actuator", "rubber"), machine)
    check_task(option("task", "hold"), machine)
    check_task(option("task", "trace"), machine)


def test_its_options_are_listed(site: Path, brokk: Callable[..., Any]) -> None:
    out = brokk("mode=list").out
    for text in ("rubber", "sink", "darkest", "two_links", "hold", "A planar arm of two links."):
        assert text in out


def test_all_of_it_trains_together(site: Path, brokk: Callable[..., Any], tmp_path: Path) -> None:
    done = brokk(*shlex.split(TRAINING)[1:], *SHORT)
    assert done.code == 0, done.err
    evaluation = json.loads((tmp_path / "runs/mine/evaluation.json").read_text())
    assert evaluation["episodes"] == 16 and "success_strict" in evaluation
    endings = evaluation["terminations"]
    assert list(endings) == ["joint_limit", "strayed", "fault", "time_limit"]
    assert sum(endings.values()) == 16
    contract = json.loads((tmp_path / "runs/mine/policy.json").read_text())
    assert contract["task"]["name"] == "trace" and contract["observation"]["size"] == 22
    example = [sys.executable, str(ROOT / "examples/run_policy.py"), "runs/mine"]
    out = subprocess.run(example, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert float(out.split()[-1]) < 1e-4
