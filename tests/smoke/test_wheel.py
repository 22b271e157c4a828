"""Wheel and source distribution in empty environments, without the checkout: they evaluate, play, and take a package."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import urllib.request
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples/my_package"
SHORT = (
    "rl.num_envs=8", "rl.num_starts=64", "rl.budget.max_seconds=3", "evaluation.episodes=8",
    "evaluation.video=false",
)  # fmt: skip
"""A training of some seconds."""
LONGEST_S = 300
OUTSIDE = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

pytestmark = pytest.mark.slow


def run_in(home: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Runs a program of the environment, away from the checkout."""
    return subprocess.run(
        [home / "env/bin" / words[0], *words[1:]],
        cwd=home / "desk",
        env=OUTSIDE,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )


def run_pip(*words: str) -> None:
    pip = [sys.executable, "-m", "pip", "--no-input", "--disable-pip-version-check", "-q"]
    done = subprocess.run([*pip, *words], capture_output=True, text=True)
    if "Could not find a version" in done.stderr:
        pytest.skip("the build backend is not installed and cannot be downloaded")
    assert done.returncode == 0, done.stderr


def install(home: Path, source: Path) -> None:
    """Installs a wheel, a source distribution or a project without its dependencies."""
    run_pip("--python", str(home / "env/bin/python"), "install", "--no-deps", str(source))


def make_home(home: Path) -> Path:
    """Makes the environment `env`, and the empty folder `desk` to work in."""
    (home / "desk").mkdir()
    venv.create(home / "env", symlinks=True)
    (site,) = (home / "env/lib").glob("python*/site-packages")
    # The dependencies are those of this environment. Its own .pth files, which add the checkout,
    # are not read there.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    uv = shutil.which("uv") or str(Path(sys.executable).with_name("uv"))
    done = subprocess.run([uv, "build", "-o", folder], cwd=ROOT, capture_output=True, text=True)
    if "Failed to resolve requirements" in done.stderr:
        pytest.skip("the build backend is not installed and cannot be downloaded")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def home(dist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an environment that holds the wheel."""
    home = make_home(tmp_path_factory.mktemp("home"))
    (wheel,) = dist.glob("*.whl")
    install(home, wheel)
    return home


def test_the_source_distribution_installs_and_lists_the_same(
    dist: Path, home: Path, tmp_path: Path
) -> None:
    other = make_home(tmp_path)
    (archive,) = dist.glob("*.tar.gz")
    install(other, archive)
    listed = run_in(other, "brokk", "mode=list")
    assert listed.returncode == 0, listed.stderr
    assert listed.stdout == run_in(home, "brokk", "mode=list").stdout
    assert str(tmp_path) in run_in(other, "python", "-c", "import conf; print(conf)").stdout


def test_it_evaluates_the_policy_that_ships(home: Path) -> None:
    done = run_in(
        home, "brokk", "mode=evaluate", "evaluation.episodes=16", "evaluation.video=false",
        "session.out=evaluated",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads((home / "desk/evaluated/evaluation.json").read_text())
    assert found["episodes"] == 16 and found["success_strict"]["mean"] > 0.8


def test_its_page_opens_and_closes(home: Path) -> None:
    process = subprocess.Popen(
        [home / "env/bin/brokk", "mode=play", "play.port=18219"],
        cwd=home / "desk",
        stderr=subprocess.PIPE,
        text=True,
        env=OUTSIDE | {"COLUMNS": "200"},
    )
    told = ""
    try:
        for line in process.stderr:
            told += line
            if address := re.search(r"http://\S+", line):
                break
        assert address, told
        with urllib.request.urlopen(address[0], timeout=LONGEST_S) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode in (0, 130) and "Traceback" not in told + rest


@pytest.mark.skipif(not EXAMPLE.exists(), reason="the example package is not in this checkout")
def test_a_package_beside_it_is_listed_and_trains(home: Path) -> None:
    install(home, EXAMPLE)
    assert "my_trace" in run_in(home, "brokk", "mode=list").stdout
    done = run_in(home, "brokk", "experiment=my_trace", *SHORT, "session.out=mine")
    assert done.returncode == 0, done.stderr
    assert (home / "desk/mine/policy.onnx").exists()
