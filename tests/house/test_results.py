"""The results page: rendered from the JSON files, with a mark where the code has changed since."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

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


def test_readme_shows_the_figures_of_the_files(benchmarks: Any) -> None:
    """Each row of README links to a result; its strict figures and baselines stand in that file."""
    readme = (ROOT / "README.md").read_text()
    for one in benchmarks.HEADLINES:
        anchor = re.sub(r"[^\w -]", "", benchmarks.list_measurements()[one.result].title.lower())
        (line,) = [row for row in readme.splitlines() if f"#{anchor.replace(' ', '-')})" in row]
        rows = json.loads((ROOT / f"benchmarks/results/{one.result}.json").read_text())["rows"]
        figures = [one.read(rows), *re.findall(r"[\d.]+ %", one.baseline(rows))]
        assert [figure for figure in figures if figure not in line] == [], one.claim


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
