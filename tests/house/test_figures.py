"""Figures of the documentation are those of the files that measured them."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


def load_figures() -> ModuleType:
    """Return `benchmarks/figures.py`, which is a program and in no package."""
    spec = importlib.util.spec_from_file_location("figures", ROOT / "benchmarks/figures.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["figures"] = module
    spec.loader.exec_module(module)
    return module


figures = load_figures()


@pytest.mark.parametrize("claim", figures.read_claims(), ids=lambda claim: claim.name)
def test_a_page_holds_the_figures_of_its_files(claim) -> None:
    assert figures.find_drift(claim) is None


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A project with one page, one file and one claim."""
    (tmp_path / "benchmarks/figures").mkdir(parents=True)
    (tmp_path / "benchmarks/speed.json").write_text(json.dumps({"ms": 62.5047, "rows": [{"n": 1}]}))
    (tmp_path / "benchmarks/figures/page.yaml").write_text(
        "page: page.md\nclaims:\n  speed: {sources: {speed: speed.json}, commit: abc, rests_on: one,"
        " command: run, measures: [x],\n    text: 'A frame takes {{ speed.ms | f(1) }} ms of 60.'}\n"
    )
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "CLAIMS", tmp_path / "benchmarks/figures")
    figures.read_claims.cache_clear()
    figures.read_source.cache_clear()
    yield tmp_path
    figures.read_claims.cache_clear()
    figures.read_source.cache_clear()


def test_a_figure_that_drifted_is_told_and_written(place: Path) -> None:
    page = place / "page.md"
    page.write_text("# Speed\n\nA frame takes 61.9 ms of 60. So it is.\n")
    (claim,) = figures.read_claims()
    drift = figures.find_drift(claim)
    assert "61.9 ms" in drift and "62.5 ms" in drift
    assert figures.write_page(claim.page, [claim]) == 1
    assert page.read_text() == "# Speed\n\nA frame takes 62.5 ms of 60. So it is.\n"
    assert figures.find_drift(claim) is None
    assert figures.count_figures(claim.page) == (1, 1)


@pytest.mark.parametrize(
    "text",
    [
        "A frame took 62.5 ms of 60.",  # other words
        "A frame takes 62.5 ms of 50.",  # a number that the template holds fixed
        "A frame takes 62.5 ms of 60. A frame takes 61.0 ms of 60.",  # twice
    ],
)
def test_a_passage_that_is_not_there_once_is_an_error(place: Path, text: str) -> None:
    (place / "page.md").write_text(text)
    (claim,) = figures.read_claims()
    assert "expected the passage once in page.md" in figures.find_drift(claim)
    with pytest.raises(figures.FigureError):
        figures.write_page(claim.page, [claim])
    assert (place / "page.md").read_text() == text
