"""A table that is wider than the terminal is split; no cell is wrapped or lost."""

from __future__ import annotations

import io

import pytest
from rich.console import Console
from rich.table import Table

from brokk_rl.console_table import print_table, split_table

HEADINGS = ("policy", *(f"quantity {k}" for k in range(8)))


def table() -> Table:
    made = Table(*HEADINGS)
    for name in ("trained", "classical"):
        made.add_row(name, *(f"{name} {k}" for k in range(8)))
    return made


def rendered(width: int) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width)
    for part in split_table(table(), 1, console):
        console.print(part)
    return out.getvalue()


def test_a_wide_table_is_split_and_no_line_is_wider_than_the_terminal() -> None:
    text = rendered(80)
    assert max(map(len, text.splitlines())) <= 80
    for k in range(8):
        for words in (f"quantity {k}", f"trained {k}", f"classical {k}"):
            assert text.count(words) == 1
    assert text.count("policy") == 2, "each part repeats what a row is"


def test_a_table_that_fits_stays_one() -> None:
    assert len(split_table(table(), 1, Console(width=200))) == 1


def test_a_pipe_has_120_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(table())
    assert 80 < max(map(len, capsys.readouterr().out.splitlines())) <= 120
