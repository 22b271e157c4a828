"""The page: whole, escaped, self-contained."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import pytest

from brokk_rl.errors import StorageError
from brokk_rl.report import Cell, Report

matplotlib.use("Agg")
from matplotlib import pyplot

NASTY = "<script>alert('a & b')</script> \"quoted\""
VOID = {"meta", "img"}


class Reader(HTMLParser):
    """Reads a page back: texts, attributes, and whether every tag that opens also closes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def figure() -> pyplot.Figure:
    drawn, axis = pyplot.subplots()
    axis.plot([0, 1], [1, 0])
    pyplot.close(drawn)
    return drawn


def nasty_page() -> Report:
    page = Report(NASTY, NASTY, "good")
    page.add_heading(NASTY)
    page.add_text(NASTY, "bad")
    page.add_list([NASTY])
    page.add_code(NASTY)
    page.add_table([NASTY, "b"], [[NASTY, Cell(NASTY, note=NASTY)]], NASTY)
    with page.add_details(NASTY):
        page.add_picture(figure(), NASTY, NASTY)
    return page


def test_whatever_is_given_is_text_and_never_markup() -> None:
    read = Reader(nasty_page().render())
    assert not {"script", "link", "iframe"} & {tag for tag, _ in read.tags}
    # Once for each place above, and twice for the title.
    assert sum(NASTY in text for text in read.texts) == 14
    assert [attributes["alt"] for tag, attributes in read.tags if tag == "img"] == [NASTY]


def test_a_page_needs_nothing_from_elsewhere() -> None:
    read = Reader(nasty_page().render())
    addresses = [
        value
        for _, attributes in read.tags
        for key, value in attributes.items()
        if key in ("src", "href", "srcset")
    ]
    assert addresses and all(value and value.startswith("data:") for value in addresses)
    policies = [
        attributes["content"]
        for _, attributes in read.tags
        if attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    assert policies and "default-src 'none'" in str(policies[0])


def test_rows_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="expected 2 cells"):
        Report("a").add_table(["a", "b"], [["only one"]])


def test_a_page_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    page = Report("new")
    with pytest.raises(StorageError, match="cannot write"):
        page.write(Path(__file__) / "page.html")
    (tmp_path / "page.html").write_text("old")
    page.write(tmp_path / "page.html")
    assert "new" in (tmp_path / "page.html").read_text() and [
        p.name for p in tmp_path.iterdir()
    ] == ["page.html"]
