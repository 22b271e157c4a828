"""The results page: rendered from the JSON files, with a mark where the code has changed since."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
AGE = re.compile(r"\*\*Older than its code\.\*\*|Today's code\.|\b(today's|older)\|$", re.M)


@pytest.fixture(scope="module")
def benchmarks() -> Iterator[Any]:
    """The program `benchmarks/run.py`, which is in no package."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        yield importlib.import_module("run")
        for name in [name for name in sys.modules if name.split(".")[0] in ("run", "rooms")]:
            del sys.modules[name]


def test_the_page_shows_the_files(benchmarks: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page is rendered from the results. The mark of old figures is left out: it changes with commits."""
    page = (ROOT / "docs/results.md").read_text()
    monkeypatch.setattr(benchmarks, "is_current", lambda result: True)
    assert AGE.sub("", page) == AGE.sub("", benchmarks.render_page()), "make results"


def find_row(readme: str, title: str) -> str:
    """Returns the row of README that links to a result of this title."""
    anchor = re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")
    (line,) = [row for row in readme.splitlines() if f"#{anchor})" in row]
    return line


def list_numbers(text: str) -> set[str]:
    return {number.replace(",", "").rstrip(".") for number in re.findall(r"\d[\d,.]*", text)}


def test_readme_shows_the_figures_of_the_files_and_no_others(benchmarks: Any) -> None:
    """Strict figures and baselines stand in README; each of its numbers stands in that file."""
    readme = (ROOT / "README.md").read_text()
    table = readme[readme.index("| claim |") : readme.index("## Go on")]
    known = benchmarks.list_measurements()
    for name in {one.result: None for one in benchmarks.HEADLINES}:
        line = find_row(table, known[name].title)
        result = json.loads((ROOT / f"benchmarks/results/{name}.json").read_text())
        rests_on = benchmarks.render_result(known[name], result)
        for one in benchmarks.HEADLINES:
            if one.result == name:
                figure, baseline = one.read(result["rows"]), one.baseline(result["rows"])
                told = [figure, *re.findall(r"[\d.]+ %", baseline)]
                assert [part for part in told if part not in line] == [], one.claim
                rests_on += f" {figure} {baseline}"
        for share in re.findall(r"\b[01]\.\d+\b", rests_on):
            rests_on += f" {100 * float(share):.0f} {100 * float(share):.1f}"
        said = re.sub(r"\]\([^)]*\)", "", line)
        assert list_numbers(said) <= list_numbers(rests_on), name


def test_each_result_says_what_it_rests_on(benchmarks: Any) -> None:
    known = benchmarks.list_measurements()
    for path in sorted((ROOT / "benchmarks/results").glob("*.json")):
        result = json.loads(path.read_text())
        assert path.stem in known
        assert all(result[key] for key in ("machine", "commit", "date", "code", "rows")), path


def test_changed_code_makes_a_figure_old_and_a_changed_comment_does_not(
    benchmarks: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = next(iter(benchmarks.list_measurements().values()))
    result = {"commands": [], "machine": "m", "commit": "c", "date": "d", "rows": []}
    result["code"] = ["brokk_rl/errors.py"]
    result["code_sha256"] = benchmarks.hash_code(result["code"])
    source = (ROOT / "brokk_rl/errors.py").read_bytes()
    monkeypatch.setattr("pathlib.Path.read_bytes", lambda self: source + b"# a remark\n")
    assert "Today's code." in benchmarks.render_result(one, result)
    monkeypatch.setattr("pathlib.Path.read_bytes", lambda self: source + b"x = 1\n")
    assert "Older than its code." in benchmarks.render_result(one, result)


def test_benchmarks_stay_small() -> None:
    size = sum(path.stat().st_size for path in (ROOT / "benchmarks").rglob("*") if path.is_file())
    assert size < 4e6


def test_every_ingredient_of_the_ablation_is_still_there() -> None:
    text = (ROOT / "benchmarks/diagnosis/ingredients.yaml").read_text()
    for targets in yaml.safe_load(text).values():
        for target in targets:
            with patch(f"diagnosis.{target.removesuffix('()')}", None):
                pass
