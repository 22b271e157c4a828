"""Pages of the documentation keep their bounds."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
RENDERED = "results.md"
DECIMAL = re.compile(r"(?<![\w.])\d*\.\d+(?![\w.])")
MOST_WORDS, MOST_WORDS_OF_A_PAGE, MOST_DECIMALS = 24_000, 1_500, 300
"""Bounds; decimals stand on the results page, which is rendered from files and may be longer."""


def count_words(path: Path) -> int:
    return len(path.read_text().split())


def test_the_pages_are_short() -> None:
    assert sum(map(count_words, PAGES)) <= MOST_WORDS
    long = {page.name: count_words(page) for page in PAGES}
    too_long = {name for name, words in long.items() if words > MOST_WORDS_OF_A_PAGE}
    assert too_long <= {RENDERED}


def test_figures_stand_on_the_results_page() -> None:
    written = [page for page in PAGES if page.name != RENDERED]
    found = [len(DECIMAL.findall(page.read_text())) for page in written]
    assert sum(found) <= MOST_DECIMALS
