"""The computer on the machine needs the extra `deploy` alone, and a missing package names its extra."""

from __future__ import annotations

import ast
import configparser
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import hydra
import pytest

from brokk_rl import extras
from deploy.recorder import capture_reader
from deploy.runtime.process_group import BUS_PRIORITY

ROOT = Path(__file__).parents[2]
ROOMS = ("brokk_rl", "tasks", "actuators", "perception", "deploy", "diagnosis", "exam", "study")


def _state_requirements() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = list(project["dependencies"])
    for extra, requirements in project["optional-dependencies"].items():
        lines += [f"{one}; extra == '{extra}'" for one in requirements]
    return lines


STATED = extras.read_extras(_state_requirements())


def _list_modules(*names: str) -> set[str]:
    """Returns the modules of the packages of some extras."""
    modules = {dist: module for module, dist in extras.DISTRIBUTION_NAMES.items()}
    found = set()
    for name in names:
        for one in STATED[name]:
            found.add(modules.get(one.name, one.name.replace("-", "_")))
    return found


@pytest.fixture
def light(tmp_path: Path) -> dict[str, str]:
    """Environment in which packages of every extra but `deploy` cannot be imported, in children too."""
    blocked = _list_modules("all") - _list_modules("", "deploy") | {"rsl_rl", "warp", "torch"}
    assert {"torch", "mujoco", "mujoco_warp", "wandb", "scipy", "pyarrow"} <= blocked
    (tmp_path / "sitecustomize.py").write_text(
        f"import sys\nsys.modules.update(dict.fromkeys({sorted(blocked)!r}))\n"
    )
    about = tmp_path / "brokk_rl-0.dist-info"
    about.mkdir()
    lines = [f"Requires-Dist: {one}" for one in _state_requirements()]
    about.joinpath("METADATA").write_text("\n".join(["Name: brokk-rl", "Version: 0", *lines]))
    # None in sys.modules raises ModuleNotFoundError, as for a package that is not installed.
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    return os.environ | {"PYTHONPATH": path, "COLUMNS": "400"}


def _run(environment: dict[str, str], folder: Path, *words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-P", "-m", "brokk_rl", *words, f"session.out={folder}"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)


def test_the_loop_runs_and_records_with_the_extra_deploy_alone(
    light: dict[str, str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    port = 20000 + os.getpid() % 20000
    bench = ("preset=bench", "link=nominal", f"bus.port={port}", "page.port=0")
    done = _run(light, run, *bench, "deploy.seconds=5")
    assert done.returncode == 0, done.stderr
    messages = capture_reader.read_capture(run / "capture.mcap").messages
    assert messages["advice"] and messages["guard"]


def test_bring_up_is_imported_with_the_extra_deploy_alone(light: dict[str, str]) -> None:
    subprocess.run(
        [sys.executable, "-P", "-c", "import deploy.modes.bringup"], env=light, check=True
    )


@pytest.mark.parametrize(
    ("module", "importer", "extra"),
    [
        ("torch", "brokk_rl.modes.train.Train", "train"),
        ("torch", "diagnosis.modes.diagnose.Diagnose", "diagnose"),
        ("mujoco.mjx", "deploy.runtime.supervisor", "train"),
        ("aiortc", "this run", "video"),
        ("pyzed", "perception.sources", None),
    ],
)
def test_a_missing_package_names_the_extra_of_the_work_that_needs_it(
    module: str, importer: str, extra: str | None
) -> None:
    assert extras.find_extra(module, importer, STATED) == extra


def test_the_command_names_the_extra_that_is_missing(light: dict[str, str], tmp_path: Path) -> None:
    done = _run(light, tmp_path / "run", "mode=evaluate")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "brokk_rl.modes.evaluate.Evaluate needs the package" in done.stderr
    assert "pip install 'brokk-rl[train]'" in done.stderr


def test_every_foreign_package_of_the_code_comes_with_an_extra() -> None:
    # The last two come with a camera, not from a package index.
    known = {*sys.stdlib_module_names, *ROOMS, "conf", "pyzed", "pyrealsense2"}
    brought = _list_modules(*STATED)
    # These come with the packages that stand in pyproject.toml.
    brought |= {"hydra", "omegaconf", "yaml", "PIL", "tensordict", "rsl_rl", "warp"}
    brought |= {"aiortc", "aioice", "av", "pydantic_core", "annotated_types", "typing_extensions"}
    missing = set()
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.level == 0:
                    names = [str(node.module)]
                missing |= {name.partition(".")[0] for name in names} - known - brought
    assert not missing


def test_a_restarted_service_is_never_armed_by_itself_and_has_no_privileges() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(ROOT / "docs/brokk.service")
    service = unit["Service"]
    words = service["ExecStart"].split()[1:]
    with hydra.initialize_config_module("conf", version_base="1.3"):
        commanding = hydra.compose("config", overrides=[*words, "deploy=auto"]).deploy
    assert commanding.commands and not commanding.armed
    assert int(service["LimitRTPRIO"]) >= BUS_PRIORITY
    assert service["Restart"] == "on-failure" and int(unit["Unit"]["StartLimitBurst"]) > 0
    assert service["User"] != "root" and service["NoNewPrivileges"] == "yes"
    assert service["CapabilityBoundingSet"] == ""
