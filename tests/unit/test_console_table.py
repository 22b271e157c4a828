"""One whole table: in a file as wide as it is, on a terminal wrapped between words."""

from __future__ import annotations

import pytest

from brokk_rl.console_table import print_table, print_text

HEADINGS = ["policy", *(f"quantity {k}" for k in range(20))]


def test_a_file_gets_every_row_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    print_table(HEADINGS, [[name, *(f"{k}.5" for k in range(20))] for name in ("a[b]", "c")])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["policy", "a[b]", "c"]
    assert lines[1].split()[1:] == [f"{k}.5" for k in range(20)]


def test_missing_values_are_dashes_and_text_is_no_markup(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_table([], [["a", None], ["b", 1.5]], title="[bold]")
    print_text("position[foot] " * 20)
    out = capsys.readouterr().out
    assert "–" in out and "1.5" in out and "[bold]" in out
    assert "position[foot] " * 20 in out
