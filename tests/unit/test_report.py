"""The page: whole, escaped, self-contained."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import pytest

from brokk_rl.errors import StorageError
from brokk_rl.report import embed_picture, render_page

matplotlib.use("Agg")
from matplotlib import pyplot

NASTY = "<script>alert('a & b')</script> \"quoted\""


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
        if tag not in ("meta", "img"):
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


TEMPLATE = """{% extends "report.html.jinja" %}
{% from "report_parts.html.jinja" import number, table, picture, details %}
{% block content %}
<p>{{ nasty }}</p>
{% call table([nasty, "b"], 1, nasty) %}<tr><td>{{ nasty }}</td>{{ number(nasty, nasty, true) }}</tr>{% endcall %}
{% call details(nasty) %}{{ picture(address, nasty) }}{% endcall %}
{% endblock %}
"""


@pytest.fixture
def read(tmp_path: Path) -> Reader:
    """A page whose every text is nasty."""
    path = tmp_path / "nasty.html.jinja"
    path.write_text(TEMPLATE)
    values = {"title": NASTY, "nasty": NASTY, "address": embed_picture(figure())}
    return Reader(render_page(path, values))


def test_whatever_is_given_is_text_and_never_markup(read: Reader) -> None:
    assert not {"script", "link", "iframe"} & {tag for tag, _ in read.tags}
    # Once for each place above, and twice for the title.
    assert sum(NASTY in text for text in read.texts) == 10
    assert [attributes["alt"] for tag, attributes in read.tags if tag == "img"] == [NASTY]


def test_a_page_needs_nothing_from_elsewhere(read: Reader) -> None:
    addresses, policies = [], []
    for _, attributes in read.tags:
        addresses += [attributes[key] for key in ("src", "href", "srcset") if key in attributes]
        if attributes.get("http-equiv") == "Content-Security-Policy":
            policies.append(attributes["content"])
    assert addresses and all(value and value.startswith("data:") for value in addresses)
    assert policies and "default-src 'none'" in str(policies[0])


def test_a_picture_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot read picture"):
        embed_picture(tmp_path / "missing.png")
