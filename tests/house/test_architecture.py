"""The picture of the packages in CONTRIBUTING.md shows the imports that there are."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from house import rules

ROOT = Path(__file__).resolve().parents[2]
GROUND = "brokk_rl"
PACKAGES = (
    "brokk_rl.modes", "brokk_rl.sim", "brokk_rl.rl", "brokk_rl.play", GROUND, *rules.ROOMS, *rules.EXTENSIONS,
)  # fmt: skip
ARROW = re.compile(r"^  (\S+) --> (\S+)$", re.M)


def find_package(module: str) -> str | None:
    return next((name for name in PACKAGES if rules.within(module, name)), None)


def test_the_picture_shows_the_imports() -> None:
    found = set()
    for path in (
        path for name in PACKAGES if "." not in name for path in (ROOT / name).rglob("*.py")
    ):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for entry in rules.imports(ast.parse(path.read_text())):
            pair = find_package(module), find_package(entry.name)
            if pair[0] != pair[1] and pair[1] not in (None, GROUND):
                found.add(pair)
    assert set(ARROW.findall((ROOT / "CONTRIBUTING.md").read_text())) == found
