"""Floors, doors, names, words and the picture of the packages, read from the sources without importing them."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from house import rules

ROOT = Path(__file__).parents[2]
PACKAGES = ("brokk_rl", "conf", *rules.ROOMS, *rules.EXTENSIONS)
GROUND = "brokk_rl"
PARTS = ("brokk_rl.modes", "brokk_rl.sim", "brokk_rl.rl", "brokk_rl.play", GROUND)
ARROW = re.compile(r"^  (\S+) --> (\S+)$", re.M)


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


SOURCES = {
    module_name(path): path.read_text()
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}


@pytest.mark.parametrize(
    "rule",
    [
        rules.floors,
        rules.doors,
        rules.vague_names,
        rules.docstrings,
        rules.units,
        rules.unique_classes,
        rules.circles,
    ],
)
def test_the_sources_keep(rule: Callable[[Mapping[str, str]], list[str]]) -> None:
    assert rule(SOURCES) == []


def find_package(module: str) -> str | None:
    packages = (*PARTS, *rules.ROOMS, *rules.EXTENSIONS)
    return next((name for name in packages if rules.within(module, name)), None)


def test_the_picture_in_contributing_shows_the_imports() -> None:
    found = set()
    for module, tree in rules.read_trees(SOURCES):
        package = find_package(module)
        for entry in rules.imports(tree):
            other = find_package(entry.name)
            if package not in (None, other) and other not in (None, GROUND):
                found.add((package, other))
    assert set(ARROW.findall((ROOT / "CONTRIBUTING.md").read_text())) == found


NOUNS = ("spec",)
"""Functions that are no verbs: the decorator of specs."""
QUANTITIES = ("tasks.terms",)
"""Terms, which are named by their quantity: users type these names."""


def test_functions_begin_with_a_verb() -> None:
    found = rules.verb_names(SOURCES, NOUNS)
    assert [line for line in found if not line.startswith(QUANTITIES)] == []


def test_no_module_is_long() -> None:
    assert [module for module, text in SOURCES.items() if text.count("\n") > 500] == []


def test_numbers_of_the_configuration_are_explained() -> None:
    texts = {}
    for folder in ("conf", "exam/conf"):
        for path in sorted((ROOT / folder).rglob("*.yaml")):
            if "hydra" not in path.parts:  # settings of Hydra's own plugins
                texts[str(path.relative_to(ROOT))] = path.read_text()
    assert rules.uncommented_numbers(texts) == []


@pytest.mark.parametrize(
    ("rule", "module", "text"),
    [
        (rules.floors, "brokk_rl.machine", "from brokk_rl.sim import model"),
        (rules.floors, "brokk_rl.rl.runner", "def f():\n    import brokk_rl.modes.train"),
        (rules.floors, "actuators.models.lag", "import diagnosis.answer"),
        (rules.doors, "diagnosis.answer", "import mujoco"),
        (rules.doors, "brokk_rl.modes.list", "from omegaconf import OmegaConf"),
        (rules.doors, "deploy.runtime", "from brokk_rl.sim import scene"),
        (rules.doors, "deploy.kernel.guard", "import torch"),
        (rules.vague_names, "brokk_rl.rl.utils", ""),
        (rules.docstrings, "brokk_rl.a", '"""A."""\nclass B:\n    """B."""\n    def c(self): pass'),
        (rules.units, "brokk_rl.a", "tilt_deg: float = 1.0"),
        (rules.units, "brokk_rl.a", "def f(n_envs): pass"),
        (rules.verb_names, "brokk_rl.a", "def distance(a): pass"),
        (rules.uncommented_numbers, "a.yaml", "# A file.\ngain: 1.0"),
        (rules.uncommented_numbers, "a.yaml", "a:  # m\n  b: 1\nc: [0, 1]"),
    ],
)
def test_a_planted_violation_is_found(
    rule: Callable[[Mapping[str, str]], list[str]], module: str, text: str
) -> None:
    assert len(rule({module: text})) == 1


def test_no_file_names_the_workplace_it_was_written_at() -> None:
    # put together here, so that this file does not name them either
    places = [
        "/" + "work/",
        ".." + "/shared",
        "shared" + "/notes",
        "/opt" + "/wheels",
        "/opt" + "/pypi",
    ]
    words = ["git", "-C", str(ROOT), "ls-files", "-z"]
    listed = subprocess.run(words, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no checkout")
    found = []
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        text = path.read_bytes().decode(errors="ignore") if path.is_file() else ""
        found += [f"{name}: {place}" for place in places if place in text]
    assert found == []
